"""Release of traffic data: the task, true traffic, and release models."""

from dptse_env.release.gaussian import (
    Capped,
    CappedSettings,
    Corrected,
    GaussianRelease,
    Printed,
    require_gaussian,
)
from dptse_env.release.model import ReleaseModel, check_released
from dptse_env.release.paced import Paced, PacedSettings
from dptse_env.release.pacing import Pacing
from dptse_env.release.queries import MOST_QUERIES, BandwidthUnit, Queries
from dptse_env.release.report import VOID_REASONS, PrivacyReport, QuantityReport
from dptse_env.release.settings import BoundaryInputs, PrivacySettings
from dptse_env.release.task import Group, Request, Task
from dptse_env.release.vehicles import Traffic
from dptse_env.utils.registry import Registry

RELEASE_MODELS = Registry(
    "privacy.preset",
    {"printed": Printed, "corrected": Corrected, "capped": Capped, "paced": Paced},
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
    "MOST_QUERIES",
    "RELEASE_MODELS",
    "VOID_REASONS",
    "BandwidthUnit",
    "BoundaryInputs",
    "Capped",
    "CappedSettings",
    "Corrected",
    "GaussianRelease",
    "Group",
    "Paced",
    "PacedSettings",
    "Pacing",
    "Printed",
    "PrivacyReport",
    "PrivacySettings",
    "QuantityReport",
    "Queries",
    "ReleaseModel",
    "Request",
    "Task",
    "Traffic",
    "check_released",
    "require_gaussian",
]
