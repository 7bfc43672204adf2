"""Fusion: what an estimator is told of answers of connected vehicles beside those of detectors."""

from dptse_env.fusion.fusion import Fusion, FusionSetup
from dptse_env.fusion.settings import FusionSettings

__all__ = ["Fusion", "FusionSettings", "FusionSetup"]
