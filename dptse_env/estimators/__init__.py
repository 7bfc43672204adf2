"""Traffic state estimators with a common protocol."""

from dptse_env.estimators.base import BatchEstimator, Estimate, Estimator, Measurement
from dptse_env.estimators.registry import (
    BACKENDS,
    ESTIMATORS,
    REFERENCES,
    check_demand,
    check_estimate,
    check_estimator,
    check_settings,
    make_estimator,
    settings_type,
)
from dptse_env.estimators.settings import (
    BlendSettings,
    DemandSettings,
    EnsembleSettings,
    EstimatorSettings,
    HorizonSettings,
    RecurrentSettings,
    SigmaPointSettings,
)

__all__ = [
    "BACKENDS",
    "ESTIMATORS",
    "REFERENCES",
    "BatchEstimator",
    "BlendSettings",
    "DemandSettings",
    "EnsembleSettings",
    "Estimate",
    "Estimator",
    "EstimatorSettings",
    "HorizonSettings",
    "Measurement",
    "RecurrentSettings",
    "SigmaPointSettings",
    "check_demand",
    "check_estimate",
    "check_estimator",
    "check_settings",
    "make_estimator",
    "settings_type",
]
