"""Differential privacy, mathematics only: Gaussian relations, sensitivities, noise, accounts."""

from dptse_env.privacy.gaussian import (
    DELTAS,
    ROUNDING,
    EpsilonTable,
    ReleaseAccount,
    delta_of,
    epsilon_of,
    epsilons_of,
    joint_noise_std,
    le_ny_kappa,
    mu_of,
    over_trips,
    printed_noise_std,
    require_covered,
    rounded_up,
    single_noise_std,
)
from dptse_env.privacy.sensitivity import (
    Adjacency,
    ReleaseSensitivity,
    Sensitivity,
    contribution_sensitivity,
    paper_sensitivity,
)

__all__ = [
    "DELTAS",
    "ROUNDING",
    "Adjacency",
    "EpsilonTable",
    "ReleaseAccount",
    "ReleaseSensitivity",
    "Sensitivity",
    "contribution_sensitivity",
    "delta_of",
    "epsilon_of",
    "epsilons_of",
    "joint_noise_std",
    "le_ny_kappa",
    "mu_of",
    "over_trips",
    "paper_sensitivity",
    "printed_noise_std",
    "require_covered",
    "rounded_up",
    "single_noise_std",
]
