"""Cells of the study of estimators: a world, an estimator and a query schedule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agents.figures import LABELS
from agents.policies import find_policy
from agents.studies.estimators.linear_stack import STACK, stack_settings
from agents.studies.estimators.worlds import WORLDS, World
from dptse_env.policies import shipped_policies

LINEAR, LEARNED = "linear_stack", "recurrent"
ESTIMATOR_LABELS = {**LABELS, LINEAR: "linear stack of EKF and random walk", LEARNED: "recurrent"}
DEFAULT_WEIGHTS = "highway"


@dataclass(frozen=True)
class EstimatorCell:
    """A configuration, run on every traffic seed of its world.

    Attributes:
        world: Name in `WORLDS`.
        estimator: One of `ESTIMATOR_LABELS`.
        schedule: Query schedule, or the name of a policy that ships with the package.
        weights: Network of ``recurrent``, by name or file; empty for the other estimators.
    """

    world: str
    estimator: str
    schedule: str
    weights: str = ""

    @property
    def place(self) -> World:
        """The world."""
        return WORLDS[self.world]

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of ``gym.make`` that make it, where no stack is fitted yet."""
        return self.on({})

    def on(self, road: Mapping[str, Any], fit: str = "") -> dict[str, Any]:
        """Return the keywords on a road, given as a keyword, with a file of fitted stacks."""
        place = self.place.on(road)
        keywords = {**place.keywords, "estimator": self.estimator}
        keywords |= find_policy(self.schedule).keywords
        if self.estimator == LINEAR:
            keywords["estimator"] = STACK
            keywords["estimator_settings"] = stack_settings(place, fit, self.world)
        if self.estimator == LEARNED:
            recurrent = {"weights": self.weights, "outside": True}
            keywords["estimator_settings"] = {"recurrent": recurrent}
        return keywords

    @property
    def is_learned_policy(self) -> bool:
        """Whether the schedule is a policy that ships with the package."""
        return self.schedule in shipped_policies()
