"""Standard deviations of the noise that a privacy parameter asks for, three ways.

Each function returns one standard deviation for each release, in the release's own unit: for the
paper's sensitivities [veh/km, km/h].
"""

import math

from dptse_env.privacy.gaussian import le_ny_kappa, mu_of
from dptse_env.privacy.sensitivity import Sensitivity

__all__ = ["joint_noise_std", "printed_noise_std", "single_noise_std"]


def printed_noise_std(sensitivity: Sensitivity, epsilon: float, delta: float) -> tuple[float, ...]:
    """Noise of *variance* kappa^2 Delta, the paper's section III to the letter.

    A variance in veh/km cannot be right: the number depends on the units, here veh/km and km/h.
    """
    kappa = le_ny_kappa(epsilon, delta)
    return tuple(kappa * math.sqrt(release.bound) for release in sensitivity.releases)


def single_noise_std(sensitivity: Sensitivity, epsilon: float, delta: float) -> tuple[float, ...]:
    """Noise of standard deviation kappa Delta for each release by itself.

    Le Ny and Pappas (2014), theorem 3. Nothing accounts for the releases together.
    """
    kappa = le_ny_kappa(epsilon, delta)
    return tuple(kappa * release.bound for release in sensitivity.releases)


def joint_noise_std(
    sensitivity: Sensitivity, epsilon: float, delta: float, share: float
) -> tuple[float, ...]:
    """Noise under which two releases together are (epsilon, delta)-private, analytic calibration.

    The budget mu^2 is divided among what can be met together first; a release that can weigh more
    when it is met alone gets the noise that this needs.

    Args:
        sensitivity: Of the two releases.
        epsilon: Privacy parameter.
        delta: Privacy parameter.
        share: Part of mu^2 that the first release gets, in (0, 1).
    """
    mu = mu_of(epsilon, delta)
    alone = tuple(release.bound for release in sensitivity.releases)
    together = sensitivity.extremes[0] if sensitivity.extremes else alone
    shares = share, 1.0 - share
    return tuple(
        max(bound / math.sqrt(part), largest) / mu
        for bound, part, largest in zip(together, shares, alone, strict=True)
    )
