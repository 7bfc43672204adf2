"""Inputs of the estimator: boundary inputs, errors of detectors, loops, answers put together."""

from dptse_env.measurement.boundary import BOUNDARIES, BoundaryModel, nominal_state
from dptse_env.measurement.fusion import Fusion, FusionSettings
from dptse_env.measurement.loops import LoopReadings
from dptse_env.measurement.replay import Replay
from dptse_env.measurement.sensors import DetectorErrors, Detectors, make_groups

__all__ = [
    "BOUNDARIES",
    "BoundaryModel",
    "DetectorErrors",
    "Detectors",
    "Fusion",
    "FusionSettings",
    "LoopReadings",
    "Replay",
    "make_groups",
    "nominal_state",
]
