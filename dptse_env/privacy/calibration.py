"""What a user asks for, and the noise that each preset adds for it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from dptse_env.privacy.gaussian import le_ny_kappa, mu_of
from dptse_env.privacy.reasons import VoidReason
from dptse_env.privacy.sensitivity import Adjacency, Sensitivity
from dptse_env.validation import inside, integer, positive

__all__ = [
    "PRESETS",
    "BoundaryInputs",
    "Preset",
    "PrivacySettings",
    "SpeedRelease",
    "Unit",
    "noise_std",
]

Unit = Literal["trip", "horizon", "event"]
"""What is protected: a trip of capped contributions, of any length, or one second of it."""

SpeedRelease = Literal["mean", "flow"]
"""How speeds are released: their mean over a segment's vehicles, or a sum, the centred flow."""

BoundaryInputs = Literal["true", "nominal", "private"]
"""Where the estimator's inputs at the boundary come from: measured traffic, public demand, or the
boundary segments' releases."""


@dataclass(frozen=True)
class PrivacySettings:
    """What a user asks of the mechanism.

    Attributes:
        preset: one of `PRESETS`.
        epsilon: above zero.
        delta: in (0, 0.5).
        unit: of preset `guaranteed`, what is protected: `trip`, a vehicle's trip, which counts in
            its first `cap` queried steps; `horizon`, a trip with no cap, charged for every step of
            an episode; `event`, one second of a trip.
        cap: of unit `trip`, queried steps in which a vehicle counts, >= 1.
        adjacency: of preset `guaranteed`: `replace` or `add_remove`.
        share: of preset `guaranteed`, part of the budget mu^2 that density gets, in (0, 1).
        speed_release: `mean` or `flow`; None for the preset's own.
        boundary_inputs: `true`, `nominal` or `private`; None for the preset's own.

    Raises:
        ValueError: if a field is out of range; the message names its path below `privacy`.
    """

    preset: str = "paper"
    epsilon: float = 1.0
    delta: float = 0.05
    unit: Unit = "trip"
    cap: int = 64
    adjacency: Adjacency = "replace"
    share: float = 0.5
    speed_release: SpeedRelease | None = None
    boundary_inputs: BoundaryInputs | None = None

    def __post_init__(self) -> None:
        """Check each field, and keep the numbers as plain floats."""
        self._check_name("preset", tuple(PRESETS))
        object.__setattr__(self, "epsilon", positive("privacy.epsilon", self.epsilon))
        object.__setattr__(self, "delta", inside("privacy.delta", self.delta, 0.0, 0.5))
        object.__setattr__(self, "cap", integer("privacy.cap", self.cap, 1))
        object.__setattr__(self, "share", inside("privacy.share", self.share, 0.0, 1.0))
        self._check_name("unit", get_args(Unit))
        self._check_name("adjacency", get_args(Adjacency))
        self._check_name("speed_release", (None, *get_args(SpeedRelease)))
        self._check_name("boundary_inputs", (None, *get_args(BoundaryInputs)))
        if not self.is_bounded and self.speed_release == "flow":
            raise ValueError(
                f"privacy.speed_release must be 'mean' with preset {self.preset!r}, whose "
                "sensitivity is that of a mean, got 'flow'"
            )
        if self.speed == "mean" and self.adjacency == "add_remove":
            raise ValueError(
                "privacy.adjacency must be 'replace' where mean speeds are released, got "
                "'add_remove': without its one vehicle a segment has no mean"
            )

    @property
    def speed(self) -> SpeedRelease:
        """How speeds are released."""
        return self.speed_release or PRESETS[self.preset].speed_release

    @property
    def boundary(self) -> BoundaryInputs:
        """Where the estimator's inputs at the boundary come from."""
        return self.boundary_inputs or PRESETS[self.preset].boundary_inputs

    @property
    def is_bounded(self) -> bool:
        """Whether the preset bounds what a vehicle contributes, as `guaranteed` does."""
        return PRESETS[self.preset].is_bounded

    @property
    def contribution_cap(self) -> int | None:
        """Queried steps in which a vehicle counts; None if in all of them."""
        return self.cap if self.is_bounded and self.unit == "trip" else None

    def contributions(self, horizon: int) -> int:
        """Return in how many of an episode's `horizon` steps the protected unit can count."""
        return {"trip": min(self.cap, horizon), "horizon": horizon, "event": 1}[self.unit]

    def protected(self) -> str:
        """Return in words what a guarantee of a bounded preset protects."""
        change = "replaced by another" if self.adjacency == "replace" else "added or removed"
        return {
            "trip": f"one vehicle's trip, {change}, which counts in {self.cap} queried steps",
            "horizon": f"one vehicle's whole trip, {change}",
            "event": f"one second of one vehicle's trip, {change}",
        }[self.unit]

    def _check_name(self, name: str, allowed: tuple[Any, ...]) -> None:
        value = getattr(self, name)
        if value not in allowed:
            raise ValueError(f"privacy.{name} must be one of {list(allowed)}, got {value!r}")


@dataclass(frozen=True)
class Preset:
    """How a preset turns sensitivities into noise, and what it releases unless told otherwise.

    Attributes:
        noise_std: gives the noise standard deviation of each release, in the release's own unit.
        void_reasons: why this calibration gives no guarantee, even with true sensitivities.
        speed_release: how speeds are released.
        boundary_inputs: where the estimator's inputs at the boundary come from.
        is_bounded: whether the sensitivity bounds a vehicle's contributions, or is the paper's.
    """

    noise_std: Callable[[PrivacySettings, Sensitivity], tuple[float, ...]]
    void_reasons: tuple[VoidReason, ...] = ()
    speed_release: SpeedRelease = "mean"
    boundary_inputs: BoundaryInputs = "true"
    is_bounded: bool = False


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


def _std_of_all_releases(settings: PrivacySettings, sensitivity: Sensitivity) -> tuple[float, ...]:
    """Noise whose releases together are (epsilon, delta)-private, by analytic calibration.

    The budget mu^2 is shared out among what can be met together first; a release that can weigh
    more when it is met alone gets the noise that this needs.
    """
    mu = mu_of(settings.epsilon, settings.delta)
    alone = tuple(release.bound for release in sensitivity.releases)
    together = sensitivity.extremes[0] if sensitivity.extremes else alone
    shares = settings.share, 1.0 - settings.share
    return tuple(
        max(bound / math.sqrt(share), largest) / mu
        for bound, share, largest in zip(together, shares, alone, strict=True)
    )


PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        "paper": Preset(_variance_as_printed, void_reasons=("literal_variance",)),
        "corrected": Preset(_std_per_release),
        "guaranteed": Preset(
            _std_of_all_releases, speed_release="flow", boundary_inputs="nominal", is_bounded=True
        ),
    }
)
"""The presets by name: the noise as printed in the paper, as its cited theorem needs it, and with
a guarantee for every query policy."""
