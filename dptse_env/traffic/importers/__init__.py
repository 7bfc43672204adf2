"""Import of recorded trajectories: files of points of vehicles become records of a corridor.

`import_trajectories` writes a folder with a road file, on which everything works that works on a
simulated road. Tables are read by pyarrow and JSON by ijson (extra ``corridors``), which are
imported when a file is read.
"""

from dptse_env.traffic.importers.folder import FORMATS, Imported, Split, import_trajectories
from dptse_env.traffic.importers.points import Format, Labels, Points, TrajectoryError
from dptse_env.traffic.importers.recording import Options
from dptse_env.traffic.importers.source import Layout, Part, Source, read_source

__all__ = [
    "FORMATS",
    "Format",
    "Imported",
    "Labels",
    "Layout",
    "Options",
    "Part",
    "Points",
    "Source",
    "Split",
    "TrajectoryError",
    "import_trajectories",
    "read_source",
]
