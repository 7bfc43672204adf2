"""Privacy report of an environment: privacy loss of its releases, and the guarantee."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any

from dptse_env.traffic import Loops

VOID_REASONS: Mapping[str, str] = MappingProxyType(
    {
        "not_stated": "the release model states no guarantee",
        "literal_variance": (
            "the noise has variance kappa^2 Delta where the theorem needs a standard deviation of "
            "kappa Delta; the result depends on the units"
        ),
        "average_dwell": (
            "the sensitivity takes the average time on a segment for a bound on it: slower "
            "vehicles are seen more often than it counts"
        ),
        "adaptive_queries": (
            "the sensitivity counts static sensors that a vehicle passes once; a set of queried "
            "segments that moves, or that a policy chooses, may follow a vehicle"
        ),
        "speed_sensitivity": (
            "the sensitivity of the mean speed follows from an equilibrium relation; a vehicle "
            "that is nearly alone on its segment changes the mean by far more"
        ),
        "boundary_inputs": (
            "the estimator is fed the true state of the boundary segments without noise"
        ),
        "releases_not_composed": (
            "density and speed together reveal more than the configured epsilon"
        ),
        "measured_values": (
            "corridor.measured names values that were measured on the records that are released, "
            "and so depend on each vehicle in them: take them from other traffic, such as that of "
            "another day, and empty it"
        ),
        "truth_in_info": "info shows the true traffic",
    }
)
"""Reasons against a guarantee with an explanation each, in the order of reports."""

GIVEN_LOOPS = "given the counts and speeds of the loops, which are public and not protected"
"""Condition of a guarantee beside loops."""

ALONE = "a vehicle alone in an interval shows its speed there, as loops.least_count is below 2"
"""Warning of readings of a single vehicle."""


@dataclass(frozen=True)
class QuantityReport:
    """Sensitivity and noise of a released quantity.

    Attributes:
        quantity: Name of the released quantity.
        unit: Unit of `sensitivity` and `noise_std`.
        sensitivity: L2 sensitivity over a complete episode.
        noise_std: Standard deviation of the noise on each value.
        mu: sensitivity / noise_std.
    """

    quantity: str
    unit: str
    sensitivity: float
    noise_std: float
    mu: float


@dataclass(frozen=True)
class PrivacyReport:
    """Public account of the release model in force; nothing in it depends on an episode's traffic.

    `mu`, `epsilon` and `epsilons` are the privacy loss of all releases of an episode together
    *if the sensitivities hold*, and if only the releases are used. They are no guarantee while
    `void_reasons` has an entry.

    Attributes:
        preset: Name of the release model, or ``"package.module:Class"``.
        guarantee: The guarantee, or "none".
        void_reasons: Reasons against a guarantee; empty if and only if there is one.
        protects: Description of the protected data and of the change that is protected.
        claimed_epsilon: The configured epsilon.
        claimed_delta: The configured delta.
        speed_release: Release of speeds: ``mean`` or ``flow``.
        boundary_inputs: Source of the estimator's inputs at the boundary.
        noise: Source of the noise, ``seeded`` or ``secure``. Whoever knows the seed of an episode
            knows its noise: seeded episodes illustrate a guarantee and do not give it.
        mu: Parameter of Gaussian differential privacy of all releases together: the budget of an
            episode, whatever ``info["spent_mu"]`` has come to.
        epsilon: Epsilon of all releases together, at `claimed_delta`.
        epsilons: Epsilon of all releases together at further deltas, from ``"1e-2"`` to ``"1e-6"``.
        releases: A report for each released quantity.
        assumptions: The public numbers the sensitivities were computed from, by name with unit.
        details: Settings of this release model alone, such as unit, cap, adjacency and share; and
            ``loops``, where there are any.
    """

    preset: str
    guarantee: str
    void_reasons: tuple[str, ...]
    protects: str
    claimed_epsilon: float
    claimed_delta: float
    speed_release: str
    boundary_inputs: str
    noise: str
    mu: float = math.inf
    epsilon: float = math.inf
    epsilons: Mapping[str, float] = field(default_factory=dict)
    releases: tuple[QuantityReport, ...] = ()
    assumptions: Mapping[str, float] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)

    def beside(self, loops: Loops) -> PrivacyReport:
        """Return what the report states beside loops: the same, given their readings."""
        given = GIVEN_LOOPS + (f"; {ALONE}" if loops.least_count < 2 else "")
        return replace(
            self,
            protects=f"{self.protects}, {given}",
            guarantee="none" if self.guarantee == "none" else f"{self.guarantee}, {given}",
            details={**self.details, "loops": loops.fields()},
        )

    def voided(self, reasons: Iterable[str]) -> PrivacyReport:
        """Return the report with further reasons against a guarantee."""
        found = {*self.void_reasons, *reasons}
        if found == set(self.void_reasons):
            return self
        return replace(self, guarantee="none", void_reasons=in_order(found))

    def to_dict(self) -> dict[str, Any]:
        """Return a fresh dict of plain JSON values, which includes the entries of `details`.

        None stands for what is infinite, since nothing is stated.
        """
        report: dict[str, Any] = asdict(self)
        report |= {name: None for name in ("mu", "epsilon") if math.isinf(report[name])}
        report["void_reasons"] = list(self.void_reasons)
        report["releases"] = [asdict(quantity) for quantity in self.releases]
        report.update(report.pop("details"))
        return report


def in_order(reasons: Iterable[str]) -> tuple[str, ...]:
    """Return reasons in the order of `VOID_REASONS`, then others sorted by name."""
    found = set(reasons)
    known = [reason for reason in VOID_REASONS if reason in found]
    return (*known, *sorted(found - set(known)))
