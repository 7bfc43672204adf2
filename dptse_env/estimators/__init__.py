"""Traffic state estimators behind one protocol."""

from dptse_env.estimators.base import Estimate, Estimator, EstimatorSettings
from dptse_env.estimators.registry import BACKENDS, ESTIMATORS, make_estimator

__all__ = [
    "BACKENDS",
    "ESTIMATORS",
    "Estimate",
    "Estimator",
    "EstimatorSettings",
    "make_estimator",
]
