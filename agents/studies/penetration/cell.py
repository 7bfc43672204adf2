"""Cells of the study of penetration: a release model, an estimator, sensors and their faults."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from dptse_env.privacy import epsilon_of, mu_of
from dptse_env.release import Detectors

EPSILON, DELTA = 5.0, 0.05
PRINTED, CORRECTED, CAPPED, PACED = RELEASES = ("paper", "corrected", "capped", "paced")
GUARANTEED = (CAPPED, PACED)
"""Release models in which queries and detectors share a budget."""

FUSED, QUERIES, DETECTORS, WHOLE = ("fused", "queries", "detectors", "detectors-whole")
"""Arms: both kinds of sensors; queries alone; detectors alone, with the part of the budget that
they have beside queries; detectors alone with the whole budget."""

HEALTHY, UNKNOWN, MISREPORTING = ("healthy", "unknown", "misreporting")
TRUCKS, MIXED = ("trucks", "mixed")
HIGH, LOW, WITHOUT = ("high", "low", "without")
FACTORS = {HIGH: 4.0 / 3.0, LOW: 2.0 / 3.0}
"""Factor on the counts of a detector that miscounts."""
UNKNOWN_SHARES = (0.02, 0.3)
"""Range of a share that is drawn for each traffic seed."""
COUNT, *REPORTED = ("count", "spacing", "neighbours")
"""Sources of densities."""

TRUCK_SHARE = 0.1
CLASSES = [
    {"name": "car", "share": 1.0 - TRUCK_SHARE},
    {"name": "truck", "share": TRUCK_SHARE, "length": 12.0, "largest_speed": 85.0},
]
"""Classes of the traffic with trucks."""

MISREPORTED = {"misreporting": 0.3, "misreport_factor": 0.5}

TESTED, ESTIMATED = ("tested", "estimated")
FUSIONS: dict[str, dict[str, Any]] = {
    "": {},
    TESTED: {"innovation_test": True},
    ESTIMATED: {"share": "estimated"},
}

OF_ESTIMATOR: dict[str, dict[str, Any]] = {"recurrent": {"dwell_factor": 1.0}}
"""Settings of the fusion by estimator: the one whose deviations are honest is told how alike the
answers of successive seconds are."""


@dataclass(frozen=True)
class PenetrationCell:
    """A configuration, run on every traffic seed.

    Attributes:
        release: Release model.
        estimator: Estimator.
        arm: ``fused``, ``queries``, ``detectors`` or ``detectors-whole``.
        share: Share p of connected vehicles; the middle of the range where it is unknown.
        policy: Query schedule.
        world: What is wrong: ``healthy``, ``unknown``, ``misreporting``, or of one detector
            ``high``, ``low`` or ``without``; or traffic with trucks, of which all trucks are
            connected, ``trucks``, or as many vehicles at random, ``mixed``.
        detector: Number of that detector; -1 where there is none.
        fusion: Name in `FUSIONS`.
        density_from: What densities are estimated from.
    """

    release: str
    estimator: str
    arm: str
    share: float
    policy: str
    world: str = HEALTHY
    detector: int = -1
    fusion: str = ""
    density_from: str = COUNT

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of ``gym.make`` that make it, but for those of the road."""
        penetration: dict[str, Any] = {"share": self.share, "density_from": self.density_from}
        if self.world == UNKNOWN:
            penetration["share"] = list(UNKNOWN_SHARES)
        elif self.world == MISREPORTING:
            penetration |= MISREPORTED
        elif self.world == TRUCKS:
            penetration["by_class"] = [{"name": "truck", "share": 1.0}]
        return {
            "privacy": self.release,
            "epsilon": whole_epsilon(self.share) if self.arm == WHOLE else EPSILON,
            "estimator": self.estimator,
            "penetration": penetration,
            "fusion": {**FUSIONS[self.fusion], **OF_ESTIMATOR.get(self.estimator, {})},
        }

    def detectors(self, places: tuple[int, ...]) -> dict[str, Any]:
        """Return the keywords of detectors that stand on some segments."""
        if self.arm == QUERIES:
            places = ()
        if self.world == WITHOUT:
            places = tuple(place for k, place in enumerate(places) if k != self.detector)
        keywords: dict[str, Any] = {"corridor": {"fixed_sensors": list(places)}}
        if self.world in (TRUCKS, MIXED):
            keywords["corridor"]["vehicle_classes"] = CLASSES
        if self.world in FACTORS:
            factor = [1.0] * len(places)
            factor[self.detector] = FACTORS[self.world]
            keywords["detectors"] = {"factor": factor}
        return keywords


def whole_epsilon(share: float) -> float:
    """Return the epsilon of both mechanisms at which detectors have mu of `EPSILON` by themselves.

    Beside queries, detectors have a part of the budget mu^2. Where nothing is queried, what the
    queries could have spent is not spent, and the detectors' part is all that is released.

    Args:
        share: Share of connected vehicles, on which that part depends.
    """
    return epsilon_of(mu_of(EPSILON, DELTA) / math.sqrt(Detectors().part_of_budget(share)), DELTA)
