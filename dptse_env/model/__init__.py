"""The ARZ traffic model with junctions: a road, its parameters and its dynamics."""

from dptse_env.model.model import ARZModel
from dptse_env.model.network import MeasurementRows
from dptse_env.model.parameters import ARZParameters, Bounds, available_parameters, load_parameters

__all__ = [
    "ARZModel",
    "ARZParameters",
    "Bounds",
    "MeasurementRows",
    "available_parameters",
    "load_parameters",
]
