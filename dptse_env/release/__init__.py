"""Release of traffic data: true traffic, release models, and boundary inputs."""

from dptse_env.release.base import (
    ReleaseModel,
    ReleaseRequest,
    ReleaseSetup,
)
from dptse_env.release.boundary import BOUNDARIES, BoundaryModel
from dptse_env.release.checks import check_released
from dptse_env.release.detectors import Detectors
from dptse_env.release.gaussian import Capped, Corrected, GaussianRelease, Paper, require_gaussian
from dptse_env.release.mechanism import GaussianMechanism, Mechanism
from dptse_env.release.paced import Paced
from dptse_env.release.pacing import PACINGS, Pacing, PacingSetup, PublicStep
from dptse_env.release.queries import MOST_OPTIONS, BandwidthUnit, QueryOptions
from dptse_env.release.report import VOID_REASONS, PrivacyReport, QuantityReport
from dptse_env.release.settings import (
    BoundaryInputs,
    CappedSettings,
    PacedSettings,
    PrivacySettings,
    SpeedRelease,
    Unit,
)
from dptse_env.release.traffic_table import TrafficTable
from dptse_env.release.two_mechanisms import TwoMechanisms
from dptse_env.utils.registry import Registry

RELEASE_MODELS = Registry(
    "privacy.preset",
    {"paper": Paper, "corrected": Corrected, "capped": Capped, "paced": Paced},
    check=lambda part: (
        None
        if isinstance(part, type) and issubclass(part, ReleaseModel)
        else "be a subclass of dptse_env.release.ReleaseModel"
    ),
)
"""Release models by name: with the noise as printed in the paper, with the noise that its cited
theorem needs, with capped contributions, and with paced ledgers; the last two give a guarantee for
every query policy."""

__all__ = [
    "BOUNDARIES",
    "MOST_OPTIONS",
    "PACINGS",
    "RELEASE_MODELS",
    "VOID_REASONS",
    "BandwidthUnit",
    "BoundaryInputs",
    "BoundaryModel",
    "Capped",
    "CappedSettings",
    "Corrected",
    "Detectors",
    "GaussianMechanism",
    "GaussianRelease",
    "Mechanism",
    "Paced",
    "PacedSettings",
    "Pacing",
    "PacingSetup",
    "Paper",
    "PrivacyReport",
    "PrivacySettings",
    "PublicStep",
    "QuantityReport",
    "QueryOptions",
    "ReleaseModel",
    "ReleaseRequest",
    "ReleaseSetup",
    "SpeedRelease",
    "TrafficTable",
    "TwoMechanisms",
    "Unit",
    "check_released",
    "require_gaussian",
]
