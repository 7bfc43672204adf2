"""The ARZ traffic model with junctions: a road, its parameters and its dynamics."""

from dptse_env.model.arz import ARZModel, Bounds
from dptse_env.model.layout import RoadNetwork
from dptse_env.model.parameters import ARZParameters, available_parameters, load_parameters
from dptse_env.model.rows import MeasurementRows

__all__ = [
    "ARZModel",
    "ARZParameters",
    "Bounds",
    "MeasurementRows",
    "RoadNetwork",
    "available_parameters",
    "load_parameters",
]
