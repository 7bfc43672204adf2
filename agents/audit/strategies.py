"""Query policies of the adversary: public schedules, the hunter of a vehicle, an adaptive one."""

from __future__ import annotations

import numpy as np

from dptse_env.config import EnvConfig
from dptse_env.parts import make_interface
from dptse_env.schedules import SCHEDULES
from dptse_env.utils.arrays import BoolArray, FloatArray

DECISION_THRESHOLD = 3.0
"""Log-likelihood ratio at which the adaptive hunter is decided: odds of 20 to 1."""

PUBLIC_SCHEDULES = ("paper", "static", "round-robin")
"""Schedules that ignore observations: their queries are known beforehand."""

STRATEGIES = ("hunter", "adaptive", *PUBLIC_SCHEDULES)
"""Names of the policies."""


class FixedQueries:
    """Queries by a plan, whatever is released.

    Attributes:
        plan: Segments by step, shape (horizon, n_mainline).
    """

    def __init__(self, plan: BoolArray) -> None:
        """Keep the plan."""
        self.plan = plan

    def queries(self, step: int, belief: FloatArray) -> BoolArray:
        """Return the segments to query, shape (k, n_mainline).

        ``belief`` is the log-likelihood ratio of world 1 of each run's transcript so far, (k,).
        """
        return np.tile(self.plan[step], (len(belief), 1))


class AdaptiveQueries(FixedQueries):
    """Follows its plan while it is undecided, and stops querying from then on."""

    def queries(self, step: int, belief: FloatArray) -> BoolArray:
        """See `FixedQueries.queries`."""
        undecided = np.abs(belief) < DECISION_THRESHOLD
        queries: BoolArray = self.plan[step] & undecided[:, None]
        return queries


def public_plan(config: EnvConfig, name: str) -> BoolArray:
    """Return the queries of a public schedule, shape (horizon, n_mainline)."""
    interface = make_interface(config)
    steps = np.arange(config.horizon_steps)
    size = interface.observations.space.shape[0]
    schedule = SCHEDULES.find(name)(interface)
    queried: BoolArray = schedule.select(steps, np.zeros((len(steps), size), dtype=np.float32))
    return queried


def always_observed(config: EnvConfig) -> list[int]:
    """Return the record columns that are observed at every step without a query."""
    corridor = config.corridor
    boundaries = range(corridor.n_segments, corridor.n_segments + corridor.n_boundaries)
    return [*corridor.fixed_sensors, *(boundaries if config.privacy.boundary == "private" else ())]
