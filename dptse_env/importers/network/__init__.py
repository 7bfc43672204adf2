"""Import of roads from SUMO networks: segments, ramps and demand of a path."""

from dptse_env.importers.network.configuration import Files, read_configuration
from dptse_env.importers.network.layout import PARAMETERS, Layout, find_layout
from dptse_env.importers.network.road import ImportedRoad, import_road

__all__ = [
    "PARAMETERS",
    "Files",
    "ImportedRoad",
    "Layout",
    "find_layout",
    "import_road",
    "read_configuration",
]
