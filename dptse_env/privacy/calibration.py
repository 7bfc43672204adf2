"""What a user asks for, and the noise that each preset adds for it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from dptse_env.privacy.gaussian import le_ny_kappa
from dptse_env.privacy.reasons import VoidReason
from dptse_env.privacy.sensitivity import Sensitivity
from dptse_env.validation import inside, positive

__all__ = ["PRESETS", "Preset", "PrivacySettings", "noise_std"]


@dataclass(frozen=True)
class PrivacySettings:
    """What a user asks of the mechanism.

    Attributes:
        preset: one of `PRESETS`.
        epsilon: above zero.
        delta: in (0, 0.5).

    Raises:
        ValueError: if a field is out of range; the message names its path below `privacy`.
    """

    preset: str = "paper"
    epsilon: float = 1.0
    delta: float = 0.05

    def __post_init__(self) -> None:
        """Check each field, and keep the numbers as plain floats."""
        if self.preset not in list(PRESETS):
            raise ValueError(f"privacy.preset must be one of {list(PRESETS)}, got {self.preset!r}")
        object.__setattr__(self, "epsilon", positive("privacy.epsilon", self.epsilon))
        object.__setattr__(self, "delta", inside("privacy.delta", self.delta, 0.0, 0.5))


@dataclass(frozen=True)
class Preset:
    """How a preset turns sensitivities into noise.

    Attributes:
        noise_std: gives the noise standard deviation of each release, in the release's own unit.
        void_reasons: why this calibration gives no guarantee, even with true sensitivities.
    """

    noise_std: Callable[[PrivacySettings, Sensitivity], tuple[float, ...]]
    void_reasons: tuple[VoidReason, ...] = ()


def noise_std(settings: PrivacySettings, sensitivity: Sensitivity) -> npt.NDArray[np.float64]:
    """Standard deviation of the noise of each release.

    Args:
        settings: preset, epsilon and delta.
        sensitivity: of each of the m released quantities.

    Returns:
        (m,), each in the unit of its release: for the paper's sensitivities [veh/km, km/h].
    """
    preset = PRESETS[settings.preset]
    return np.array(preset.noise_std(settings, sensitivity))


def _variance_as_printed(settings: PrivacySettings, sensitivity: Sensitivity) -> tuple[float, ...]:
    """Noise of *variance* kappa^2 Delta, the paper's section III to the letter.

    A variance in veh/km cannot be right: the number depends on the units, here veh/km and km/h.
    """
    kappa = le_ny_kappa(settings.epsilon, settings.delta)
    return tuple(kappa * math.sqrt(release.bound) for release in sensitivity.releases)


def _std_per_release(settings: PrivacySettings, sensitivity: Sensitivity) -> tuple[float, ...]:
    """Noise of standard deviation kappa Delta, as in Le Ny and Pappas (2014), theorem 3."""
    kappa = le_ny_kappa(settings.epsilon, settings.delta)
    return tuple(kappa * release.bound for release in sensitivity.releases)


PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        "paper": Preset(_variance_as_printed, void_reasons=("literal_variance",)),
        "corrected": Preset(_std_per_release),
    }
)
"""The presets by name: the noise as printed in the paper, and as its cited theorem needs it."""
