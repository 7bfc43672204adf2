"""The privacy report of an environment: what its releases cost, and what may be claimed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from dptse_env.release.void_reasons import VOID_REASONS

STRICT_DELTA = 1e-4
"""A delta at which epsilon is reported beside the one asked for, which is often weak."""


@dataclass(frozen=True)
class QuantityReport:
    """One released quantity: how far a vehicle may move it, and the noise that hides it.

    Attributes:
        quantity: Name of the released quantity.
        unit: Unit of `sensitivity` and `noise_std`.
        sensitivity: L2, over a whole episode.
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

    `mu`, `epsilon` and `epsilon_strict` are what an episode's releases reveal together *if the
    sensitivities hold*, and if nothing but the releases is used. They are no guarantee while
    `void_reasons` has an entry.

    Attributes:
        preset: Name of the release model, or ``"package.module:Class"``.
        guarantee: The claim, or "none".
        void_reasons: Why not; empty if and only if something may be claimed.
        protects: Whose data is protected, and what counts as a change of it.
        claimed_epsilon: The epsilon asked for.
        claimed_delta: The delta asked for.
        speed_release: How speeds are released: ``mean`` or ``flow``.
        boundary_inputs: Where the estimator's inputs at the boundary come from.
        mu: Of all releases together.
        epsilon: Of all releases together, at `claimed_delta`.
        epsilon_strict: Of all releases together, at `strict_delta`.
        releases: One for each released quantity.
        assumptions: The public numbers the sensitivities were computed from, by name with unit.
        details: Settings of this release model alone, such as unit, cap, adjacency and share.
        strict_delta: The smaller delta at which `epsilon_strict` is given.
    """

    preset: str
    guarantee: str
    void_reasons: tuple[str, ...]
    protects: str
    claimed_epsilon: float
    claimed_delta: float
    speed_release: str
    boundary_inputs: str
    mu: float = math.inf
    epsilon: float = math.inf
    epsilon_strict: float = math.inf
    releases: tuple[QuantityReport, ...] = ()
    assumptions: Mapping[str, float] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    strict_delta: float = STRICT_DELTA

    def voided(self, reasons: Iterable[str]) -> PrivacyReport:
        """Return the report with further reasons for which nothing may be claimed."""
        found = {*self.void_reasons, *reasons}
        if found == set(self.void_reasons):
            return self
        return replace(self, guarantee="none", void_reasons=in_order(found))

    def to_dict(self) -> dict[str, Any]:
        """Return a fresh dict of plain str, float, int, dict and list; `details` stand beside."""
        report: dict[str, Any] = asdict(self)
        report["void_reasons"] = list(self.void_reasons)
        report["releases"] = [asdict(quantity) for quantity in self.releases]
        report.update(report.pop("details"))
        return report


def in_order(reasons: Iterable[str]) -> tuple[str, ...]:
    """Return reasons in the order of `VOID_REASONS`, others behind them."""
    found = set(reasons)
    known = [reason for reason in VOID_REASONS if reason in found]
    return (*known, *sorted(found - set(known)))
