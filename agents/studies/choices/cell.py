"""Cells of the study of choices: a world, a bandwidth and a query policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from agents.experiments.demand import TWO_PEAKS
from agents.policies import find_policy

HIGHWAY, LONG = "highway", "long"
CAPPED, PACED = "capped", "paced"
EKF, RECURRENT = ESTIMATORS = ("ekf", "recurrent")
OWN_TRAFFIC, OTHER_TRAFFIC = "own", "krauss-two-peaks"


class Road(NamedTuple):
    """A road of the study.

    Attributes:
        label: Its name in tables.
        envs: Environment id by release model.
        n_mainline: Segments that can be queried.
    """

    label: str
    envs: dict[str, str]
    n_mainline: int


ROADS = {
    HIGHWAY: Road(
        "1.5 km, 15 segments",
        {
            CAPPED: "dptse_env:dptse/PrivateHighway-v0",
            PACED: "dptse_env:dptse/PrivateHighway-v1",
        },
        15,
    ),
    LONG: Road(
        "12 km, 120 segments",
        dict.fromkeys((CAPPED, PACED), "dptse_env:dptse/LongHighway-v0"),
        120,
    ),
}
TRAFFIC: dict[str, dict[str, Any]] = {
    OWN_TRAFFIC: {},
    OTHER_TRAFFIC: {"corridor": {"drivers": {"model": "Krauss"}}, "demand": TWO_PEAKS},
}
"""Keywords of another car-following model and another shape of demand than any policy trained on,
on the short road."""


@dataclass(frozen=True)
class ChoiceCell:
    """A configuration, run on every traffic seed of its road.

    Attributes:
        road: Name in `ROADS`.
        traffic: Name in `TRAFFIC`.
        release: ``capped`` or ``paced``.
        estimator: ``ekf`` or ``recurrent``.
        epsilon: Of the guarantee.
        span: Neighbouring segments that a query sums over.
        bandwidth: Queries a second.
        policy: A schedule, or a saved policy.
    """

    road: str
    traffic: str
    release: str
    estimator: str
    epsilon: float
    span: int
    bandwidth: int
    policy: str

    @property
    def env(self) -> str:
        """Environment id."""
        return ROADS[self.road].envs[self.release]

    @property
    def share(self) -> float:
        """Part of the road that is queried in a second."""
        return self.bandwidth / ROADS[self.road].n_mainline

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of ``gym.make`` that make it."""
        keywords: dict[str, Any] = {
            **TRAFFIC[self.traffic],
            "estimator": self.estimator,
            "epsilon": self.epsilon,
            "bandwidth": self.bandwidth,
            **find_policy(self.policy).keywords,
        }
        if self.road == LONG:
            keywords["privacy"] = self.release
        if self.span > 1:
            keywords |= {"query_spans": [self.span], "bandwidth_unit": "sums"}
        return keywords
