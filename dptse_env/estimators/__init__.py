"""Traffic state estimators behind one protocol."""

from dptse_env.estimators.base import Estimate, Estimator, EstimatorSettings, HorizonSettings
from dptse_env.estimators.registry import BACKENDS, ESTIMATORS, check_estimator, make_estimator

__all__ = [
    "BACKENDS",
    "ESTIMATORS",
    "Estimate",
    "Estimator",
    "EstimatorSettings",
    "HorizonSettings",
    "check_estimator",
    "make_estimator",
]
