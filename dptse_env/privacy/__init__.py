"""Differential privacy: mechanisms, sensitivity, accounting."""

from dptse_env.privacy.accountant import Accountant, BoundaryInputs, PrivacyReport, ReleaseReport
from dptse_env.privacy.calibration import PRESETS, PrivacySettings, noise_std
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
from dptse_env.privacy.sensitivity import ReleaseSensitivity, Sensitivity, paper_sensitivity

__all__ = [
    "PRESETS",
    "VOID_REASONS",
    "Accountant",
    "BoundaryInputs",
    "GaussianMechanism",
    "Mechanism",
    "PrivacyReport",
    "PrivacySettings",
    "ReleaseReport",
    "ReleaseSensitivity",
    "Sensitivity",
    "VoidReason",
    "analytic_multiplier",
    "compose",
    "delta_of",
    "epsilon_of",
    "le_ny_kappa",
    "mu_of",
    "noise_std",
    "paper_sensitivity",
]
