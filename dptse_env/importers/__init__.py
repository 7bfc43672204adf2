"""Import of recorded trajectories, which become the records of a road.

`import_trajectories` writes a folder with a road file, which is used like that of a simulated road.
polars reads the tables, matplotlib draws the report (extra ``corridors``).
"""

from dptse_env.utils.registry import needed_for

with needed_for("an import"):
    from dptse_env.importers.folder import Imported, Split, import_trajectories
    from dptse_env.importers.recording import Options
    from dptse_env.importers.source import Layout, Source, Strip, TrajectoryError, read_source
    from dptse_env.importers.tables import FORMATS

    import matplotlib  # noqa: F401, isort:skip  (draws the report, when all is read)

__all__ = [
    "FORMATS",
    "Imported",
    "Layout",
    "Options",
    "Source",
    "Split",
    "Strip",
    "TrajectoryError",
    "import_trajectories",
    "read_source",
]
