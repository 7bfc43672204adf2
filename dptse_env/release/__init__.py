"""Release of traffic data: true traffic, release models, and boundary inputs."""

from dptse_env.release.base import Released, ReleaseModel, ReleaseRequest, ReleaseSetup
from dptse_env.release.boundary import BOUNDARIES, BoundaryModel
from dptse_env.release.checks import check_released
from dptse_env.release.gaussian import Capped, Corrected, GaussianRelease, Paper, require_gaussian
from dptse_env.release.mechanism import GaussianMechanism, Mechanism
from dptse_env.release.report import PrivacyReport, QuantityReport
from dptse_env.release.settings import (
    BoundaryInputs,
    CappedSettings,
    PrivacySettings,
    SpeedRelease,
    Unit,
)
from dptse_env.release.traffic_table import TrafficTable
from dptse_env.release.void_reasons import VOID_REASONS
from dptse_env.utils.registry import Registry

RELEASE_MODELS = Registry(
    "privacy.preset",
    {"paper": Paper, "corrected": Corrected, "capped": Capped},
    check=lambda part: (
        None
        if isinstance(part, type) and issubclass(part, ReleaseModel)
        else "be a subclass of dptse_env.release.ReleaseModel"
    ),
    aliases={"guaranteed": "capped"},
)
"""Release models by name: with the noise as printed in the paper, with the noise that its cited
theorem needs, and with capped contributions, which gives a guarantee for every query policy."""

__all__ = [
    "BOUNDARIES",
    "RELEASE_MODELS",
    "VOID_REASONS",
    "BoundaryInputs",
    "BoundaryModel",
    "Capped",
    "CappedSettings",
    "Corrected",
    "GaussianMechanism",
    "GaussianRelease",
    "Mechanism",
    "Paper",
    "PrivacyReport",
    "PrivacySettings",
    "QuantityReport",
    "ReleaseModel",
    "ReleaseRequest",
    "ReleaseSetup",
    "Released",
    "SpeedRelease",
    "TrafficTable",
    "Unit",
    "check_released",
    "require_gaussian",
]
