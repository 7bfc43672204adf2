"""Differential privacy: mechanisms, sensitivity, accounting."""

from dptse_env.privacy.accountant import Accountant, PrivacyReport, ReleaseReport
from dptse_env.privacy.calibration import (
    PRESETS,
    BoundaryInputs,
    PrivacySettings,
    SpeedRelease,
    Unit,
    noise_std,
)
from dptse_env.privacy.gaussian import (
    analytic_multiplier,
    compose,
    delta_of,
    epsilon_of,
    le_ny_kappa,
    mu_of,
)
from dptse_env.privacy.mechanism import GaussianMechanism, Mechanism
from dptse_env.privacy.reasons import VOID_REASONS, VoidReason
from dptse_env.privacy.sensitivity import (
    Adjacency,
    ReleaseSensitivity,
    Sensitivity,
    contribution_sensitivity,
    paper_sensitivity,
)

__all__ = [
    "PRESETS",
    "VOID_REASONS",
    "Accountant",
    "Adjacency",
    "BoundaryInputs",
    "GaussianMechanism",
    "Mechanism",
    "PrivacyReport",
    "PrivacySettings",
    "ReleaseReport",
    "ReleaseSensitivity",
    "Sensitivity",
    "SpeedRelease",
    "Unit",
    "VoidReason",
    "analytic_multiplier",
    "compose",
    "contribution_sensitivity",
    "delta_of",
    "epsilon_of",
    "le_ny_kappa",
    "mu_of",
    "noise_std",
    "paper_sensitivity",
]
