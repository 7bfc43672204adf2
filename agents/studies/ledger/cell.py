"""Cells of the study of ledgers: mechanisms, filters with their settings, and configurations."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

CAPPED, PACED, EXACT = MECHANISMS = ("capped", "paced", "exact")
"""Release models; ``exact`` has no noise and no guarantee."""
EXACT_PRESET = "agents.studies.ledger.exact:Exact"
PLAIN, DEMAND, WALK = "ekf", "ekf-demand", "random_walk"
FILTER_LABELS = {
    PLAIN: "EKF",
    DEMAND: "EKF with demand states",
    "ukf-demand": "UKF with demand states",
    "enkf-demand": "EnKF with demand states",
    "mhe-demand": "MHE with demand states",
    WALK: "random walk",
}
FILTERS = tuple(FILTER_LABELS)
"""Filters: an estimator, with demand states or without."""
TRACER, EQUAL_RATES = "tracer", "equal-rates"
PACINGS = {TRACER: "tracer", EQUAL_RATES: "agents.studies.ledger.pacing:EqualRates"}
"""Pacings by their names in the cells: by the rates of the queries, or by equal rates."""
REFERENCE = "paper"
"""The schedule that the settings of `capped` were tuned for."""
SPAN = 2
"""Segments of a sum over neighbours."""
NOT_SET = "none"
"""Value of a field that the mechanism does not have."""


@dataclass(frozen=True)
class FilterSets:
    """Shipped sets of estimator settings, one for each filter under each mechanism.

    An empty name stands for the settings that the environment takes by default.

    Attributes:
        capped: The EKF under ``capped``.
        capped_demand: The EKF with demand states under ``capped``.
        capped_walk: The random walk under ``capped``.
        paced: The EKF under ``paced`` and ``exact``.
        paced_demand: The EKF with demand states under ``paced`` and ``exact``.
        paced_ukf: The UKF with demand states under ``paced``.
        paced_enkf: The EnKF with demand states under ``paced``.
        paced_mhe: The MHE with demand states under ``paced``.
        paced_walk: The random walk under ``paced``.
    """

    capped: str = "ekf-w99-3lane-capped"
    capped_demand: str = "ekf-w99-3lane-capped-demand"
    capped_walk: str = "random_walk-w99-3lane-capped"
    paced: str = "ekf-w99-3lane-capped"
    paced_demand: str = "ekf-w99-3lane-paced"
    paced_ukf: str = "ukf-w99-3lane-paced"
    paced_enkf: str = "enkf-w99-3lane-paced"
    paced_mhe: str = "mhe-w99-3lane-paced"
    paced_walk: str = "random_walk-w99-3lane-paced"

    def find(self, mechanism: str, filter_name: str) -> str:
        """Return the name of a set."""
        if mechanism == CAPPED:
            names = {PLAIN: self.capped, DEMAND: self.capped_demand, WALK: self.capped_walk}
        else:
            names = {
                PLAIN: self.paced,
                DEMAND: self.paced_demand,
                "ukf-demand": self.paced_ukf,
                "enkf-demand": self.paced_enkf,
                "mhe-demand": self.paced_mhe,
                WALK: self.paced_walk,
            }
        return names[filter_name]


@dataclass(frozen=True)
class LedgerCell:
    """A configuration, run on every traffic seed.

    Attributes:
        mechanism: One of `MECHANISMS`.
        filter_name: One of `FILTERS`.
        settings: Set of estimator settings; empty for those of the environment.
        schedule: Query schedule.
        epsilon: Infinite without a guarantee.
        delta: 0 without a guarantee.
        span: Neighbouring segments that a query sums over.
        bandwidth: What the queries of a second cost together, in the bandwidth unit.
        bandwidth_unit: ``segments``, or ``sums``, where a query costs 1 whatever its span.
        pace: Part of the budget to be spent by the end of a trip; 0 where there is no pacing.
        clip: Largest deviation of a speed that is released [km/h]; 0 under ``capped``.
        ratio: Ratio of the charges for a deviation and for a count; 0 where nothing is charged.
        pacing: One of `PACINGS`.
    """

    mechanism: str
    filter_name: str
    settings: str
    schedule: str
    epsilon: float
    delta: float
    adjacency: str
    unit: str
    boundary_inputs: str
    span: int
    bandwidth: int
    bandwidth_unit: str
    pace: float
    clip: float
    ratio: float
    pacing: str

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of ``gym.make`` that make it."""
        keywords: dict[str, Any] = {
            "estimator": self.filter_name.removesuffix("-demand"),
            "bandwidth": self.bandwidth,
            "privacy": self._privacy(),
        }
        if self.settings:
            keywords["estimator_settings"] = self.settings
        if self.span > 1:
            keywords |= {"query_spans": [self.span], "bandwidth_unit": self.bandwidth_unit}
        return keywords

    def _privacy(self) -> dict[str, Any]:
        names = ["boundary_inputs"]
        if self.mechanism == EXACT:
            names += ["clip"]
        else:
            names += ["epsilon", "delta", "adjacency", "unit"]
        if self.mechanism == PACED:
            names += ["pace", "clip", "ratio"]
        privacy = {name: getattr(self, name) for name in names}
        privacy["preset"] = EXACT_PRESET if self.mechanism == EXACT else self.mechanism
        if self.mechanism == PACED:
            privacy["pacing"] = PACINGS[self.pacing]
        return privacy

    @property
    def canonical(self) -> LedgerCell:
        """The cell that stands for all that give the same episodes."""
        if self.mechanism == PACED:
            return self
        changes: dict[str, Any] = {"pace": 0.0, "ratio": 0.0, "pacing": NOT_SET}
        if self.mechanism == CAPPED:
            changes["clip"] = 0.0
        else:
            changes |= {"epsilon": float("inf"), "delta": 0.0}
            changes |= {"adjacency": NOT_SET, "unit": NOT_SET}
        return dataclasses.replace(self, **changes)
