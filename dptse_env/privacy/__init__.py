"""Differential privacy, mathematics only: Gaussian relations, sensitivities, noise, accounts."""

from dptse_env.privacy.account import EpsilonTable, ReleaseAccount
from dptse_env.privacy.gaussian import (
    analytic_multiplier,
    compose,
    delta_of,
    epsilon_of,
    le_ny_kappa,
    mu_of,
)
from dptse_env.privacy.noise_std import joint_noise_std, printed_noise_std, single_noise_std
from dptse_env.privacy.sensitivity import (
    Adjacency,
    ReleaseSensitivity,
    Sensitivity,
    contribution_sensitivity,
    paper_sensitivity,
)

__all__ = [
    "Adjacency",
    "EpsilonTable",
    "ReleaseAccount",
    "ReleaseSensitivity",
    "Sensitivity",
    "analytic_multiplier",
    "compose",
    "contribution_sensitivity",
    "delta_of",
    "epsilon_of",
    "joint_noise_std",
    "le_ny_kappa",
    "mu_of",
    "paper_sensitivity",
    "printed_noise_std",
    "single_noise_std",
]
