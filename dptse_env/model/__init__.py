"""The ARZ traffic model with junctions: a road, its parameters and its dynamics."""

from dptse_env.model.arrays import ARZ, Channels, covered
from dptse_env.model.model import ARZModel
from dptse_env.model.parameters import ARZParameters, Bounds, available_parameters, load_parameters

__all__ = [
    "ARZ",
    "ARZModel",
    "ARZParameters",
    "Bounds",
    "Channels",
    "available_parameters",
    "covered",
    "load_parameters",
]
