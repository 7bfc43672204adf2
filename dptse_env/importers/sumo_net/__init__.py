"""Import of roads from SUMO nets: segments, ramps and demand of a path."""

from dptse_env.importers.sumo_net.configuration import Files, read_configuration
from dptse_env.importers.sumo_net.road import ImportedRoad, import_road
from dptse_env.importers.sumo_net.segmentation import PARAMETERS, Segmentation, segment_path

__all__ = [
    "PARAMETERS",
    "Files",
    "ImportedRoad",
    "Segmentation",
    "import_road",
    "read_configuration",
    "segment_path",
]
