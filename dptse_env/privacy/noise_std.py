"""Standard deviations of the noise for given privacy parameters, by three calibrations.

Each function returns one standard deviation for each release, in the release's unit: for the
paper's sensitivities [veh/km, km/h].
"""

import math

from dptse_env.privacy.gaussian import le_ny_kappa, mu_of
from dptse_env.privacy.sensitivity import Sensitivity


def printed_noise_std(sensitivity: Sensitivity, epsilon: float, delta: float) -> tuple[float, ...]:
    """Noise of *variance* kappa^2 Delta, as printed in section III of the paper.

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

    The budget mu^2 is divided between the sensitivities that can occur together. A release that
    has a larger sensitivity on its own gets the noise that this needs. `share`, in (0, 1), is the
    part of mu^2 for the first release.
    """
    mu = mu_of(epsilon, delta)
    alone = tuple(release.bound for release in sensitivity.releases)
    together = sensitivity.extremes[0] if sensitivity.extremes else alone
    shares = share, 1.0 - share
    return tuple(
        max(bound / math.sqrt(part), largest) / mu
        for bound, part, largest in zip(together, shares, alone, strict=True)
    )
