"""The ARZ traffic model with junctions: a road, its parameters and its dynamics."""

from dptse_env.model.arz import ARZModel, Bounds
from dptse_env.model.layout import RoadNetwork
from dptse_env.model.parameters import ARZParameters, available_parameters, load_parameters

__all__ = [
    "ARZModel",
    "ARZParameters",
    "Bounds",
    "RoadNetwork",
    "available_parameters",
    "load_parameters",
]
