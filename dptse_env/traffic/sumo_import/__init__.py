"""Import of roads from SUMO networks: segments, ramps and demand of a path."""

from dptse_env.traffic.sumo_import.configuration import Files, read_configuration, seconds
from dptse_env.traffic.sumo_import.layout import Layout
from dptse_env.traffic.sumo_import.road import ImportedRoad, find_layout, import_road

__all__ = [
    "Files",
    "ImportedRoad",
    "Layout",
    "find_layout",
    "import_road",
    "read_configuration",
    "seconds",
]
