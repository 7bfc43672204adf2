"""What the releases of an episode cost, and which guarantee may be claimed for them."""

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from dptse_env.privacy.calibration import (
    PRESETS,
    BoundaryInputs,
    PrivacySettings,
    SpeedRelease,
    Unit,
    noise_std,
)
from dptse_env.privacy.gaussian import epsilon_of
from dptse_env.privacy.reasons import VOID_REASONS, VoidReason
from dptse_env.privacy.sensitivity import Adjacency, Sensitivity

__all__ = ["STRICT_DELTA", "Accountant", "PrivacyReport", "ReleaseReport"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.integer]

STRICT_DELTA = 1e-4
"""A delta at which epsilon is reported beside the one asked for, which is often weak."""


@dataclass(frozen=True)
class ReleaseReport:
    """One released quantity: how far a vehicle may move it, and the noise that hides it.

    Attributes:
        quantity: what is released.
        unit: unit of `sensitivity` and `noise_std`.
        sensitivity: L2, over a whole episode.
        noise_std: standard deviation of the noise on each value.
        mu: sensitivity / noise_std.
    """

    quantity: str
    unit: str
    sensitivity: float
    noise_std: float
    mu: float


@dataclass(frozen=True)
class PrivacyReport:
    """Public account of a configuration; nothing in it depends on the traffic of an episode.

    `mu`, `epsilon` and `epsilon_strict` are what an episode's releases reveal together *if the
    sensitivities hold*, and if nothing but the releases is used. They are no guarantee while
    `void_reasons` has an entry.

    Attributes:
        preset: name of the preset.
        guarantee: what may be claimed, or "none".
        void_reasons: why not; empty if and only if something may be claimed.
        protects: whose data is protected, and what counts as a change of it.
        unit: what is protected; None where a preset bounds no contributions.
        cap: queried steps in which a vehicle counts; None if in all of them.
        adjacency: how two records differ.
        share: part of the budget mu^2 that density gets; None where nothing is shared out.
        claimed_epsilon: the epsilon asked for.
        claimed_delta: the delta asked for.
        assumptions: the public numbers the sensitivities were computed from, by name with unit.
        speed_release: how speeds are released.
        boundary_inputs: where the estimator's inputs at the boundary come from.
        releases: one for each released quantity.
        mu: of all releases together.
        epsilon: of all releases together, at `claimed_delta`.
        epsilon_strict: of all releases together, at `strict_delta`.
        strict_delta: a delta that is worth the name.
    """

    preset: str
    guarantee: str
    void_reasons: tuple[VoidReason, ...]
    protects: str
    unit: Unit | None
    cap: int | None
    adjacency: Adjacency
    share: float | None
    claimed_epsilon: float
    claimed_delta: float
    assumptions: tuple[tuple[str, int | float], ...]
    speed_release: SpeedRelease
    boundary_inputs: BoundaryInputs
    releases: tuple[ReleaseReport, ...]
    mu: float
    epsilon: float
    epsilon_strict: float
    strict_delta: float = STRICT_DELTA

    def to_dict(self) -> dict[str, Any]:
        """Return a fresh dict of plain str, float, int, dict and list, equal to its own JSON."""
        report = asdict(self)
        report["void_reasons"] = list(self.void_reasons)
        report["assumptions"] = dict(self.assumptions)
        report["releases"] = [asdict(release) for release in self.releases]
        return report


class Accountant:
    """Keeps account of what a configuration's releases reveal."""

    def __init__(self, settings: PrivacySettings, sensitivity: Sensitivity) -> None:
        """Work out the account of a configuration.

        Args:
            settings: what was asked for.
            sensitivity: of the released quantities.
        """
        self.report = _report(settings, sensitivity)
        self._contributions = sensitivity.contributions

    @cached_property
    def _charged(self) -> tuple[FloatArray, FloatArray]:
        """Values of mu and epsilon after 0..C steps; made when first asked for."""
        n, delta = self._contributions, self.report.claimed_delta
        mu = self.report.mu * np.sqrt(np.arange(n + 1) / n) if n else np.array([self.report.mu])
        epsilon = np.array([epsilon_of(one, delta) if one > 0.0 else 0.0 for one in mu])
        return mu, epsilon

    def spent(self, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """What episodes have revealed of a vehicle at most, if the sensitivities hold.

        Where contributions are bounded, a vehicle has made at most one a step. The paper's
        sensitivities bound a whole episode and say nothing of a part of it: the whole is charged
        from the start.

        Args:
            steps: (k,) steps released so far in each of k episodes.

        Returns:
            mu (k,) and epsilon at the delta asked for (k,), of all releases together.
        """
        mu, epsilon = self._charged
        charged = np.minimum(steps, len(mu) - 1)
        return mu[charged], epsilon[charged]


def _report(settings: PrivacySettings, sensitivity: Sensitivity) -> PrivacyReport:
    stds = noise_std(settings, sensitivity).tolist()
    releases = tuple(
        ReleaseReport(release.quantity, release.unit, release.bound, std, release.bound / std)
        for release, std in zip(sensitivity.releases, stds, strict=True)
    )
    mu = sensitivity.joint_mu(stds)
    epsilon = epsilon_of(mu, settings.delta)

    found = {*PRESETS[settings.preset].void_reasons, *sensitivity.void_reasons}
    if settings.boundary == "true":
        found.add("boundary_inputs")
    # Le Ny's kappa is loose enough at times that even two releases stay below epsilon together.
    if epsilon > settings.epsilon * (1.0 + 1e-9):
        found.add("releases_not_composed")

    return PrivacyReport(
        preset=settings.preset,
        guarantee="none" if found else _guarantee(settings, sensitivity),
        void_reasons=tuple(reason for reason in VOID_REASONS if reason in found),
        protects=sensitivity.protects,
        unit=settings.unit if settings.is_bounded else None,
        cap=settings.contribution_cap,
        adjacency=settings.adjacency,
        share=settings.share if settings.is_bounded else None,
        claimed_epsilon=settings.epsilon,
        claimed_delta=settings.delta,
        assumptions=sensitivity.assumptions,
        speed_release=settings.speed,
        boundary_inputs=settings.boundary,
        releases=releases,
        mu=mu,
        epsilon=epsilon,
        epsilon_strict=epsilon_of(mu, STRICT_DELTA),
    )


def _guarantee(settings: PrivacySettings, sensitivity: Sensitivity) -> str:
    quantities = " and ".join(release.quantity for release in sensitivity.releases)
    return (
        f"({settings.epsilon:g}, {settings.delta:g})-differential privacy of {quantities} "
        f"together, for {sensitivity.protects}"
    )
