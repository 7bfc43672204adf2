"""Inputs of the estimator: boundary inputs, errors of fixed sensors, loops, fusion of answers."""

from dptse_env.measurement.boundary import BOUNDARIES, BoundaryModel, nominal_state
from dptse_env.measurement.fusion import Fusion, FusionSettings
from dptse_env.measurement.loops import LoopReadings
from dptse_env.measurement.rewind import Rewind
from dptse_env.measurement.sensors import SensorErrors, SensorSettings, make_groups

__all__ = [
    "BOUNDARIES",
    "BoundaryModel",
    "Fusion",
    "FusionSettings",
    "LoopReadings",
    "Rewind",
    "SensorErrors",
    "SensorSettings",
    "make_groups",
    "nominal_state",
]
