"""Query policies that need no training, from a clock to a rollout, and oracles above them.

Every schedule has the ``predict`` of a stable-baselines3 policy, so one loop serves fixed and
learned policies alike. What it must remember between steps travels in ``state``, so one schedule
serves any number of episodes at once.

======================== ========== ======================================================
schedules                sees       extra cost of a step
======================== ========== ======================================================
`SCHEDULES`              the        a sort at most
                         observation
`INFORMED`               the        an EKF's step or two; ``rollout`` some hundred of them
                         estimator's
                         covariance
`PLANS`                  the clock  none; optimised beforehand on training traffic
`ORACLES`                the truth  bounds, no policies: ``uses_truth`` is True
======================== ========== ======================================================
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from dptse_env.schedules.base import BoundSchedule, Schedule, ScheduleState
from dptse_env.schedules.fixed import (
    Everything,
    LargestVariance,
    Nothing,
    OldestFirst,
    Random,
    Shifting,
    StaleVariance,
)
from dptse_env.schedules.informed import (
    Caution,
    Greedy,
    GreedyLogdet,
    GreedyTrace,
    Informed,
    WaryTrace,
)
from dptse_env.schedules.oracles import OracleBruteForce, OracleError, OracleGreedy
from dptse_env.schedules.plans import PLANS, Place, Plan, Planned, find_plan, read_plan
from dptse_env.schedules.rollout import Rollout

__all__ = [
    "INFORMED",
    "ORACLES",
    "PLANS",
    "SCHEDULES",
    "BoundSchedule",
    "Caution",
    "Everything",
    "Greedy",
    "GreedyLogdet",
    "GreedyTrace",
    "Informed",
    "LargestVariance",
    "Nothing",
    "OldestFirst",
    "OracleBruteForce",
    "OracleError",
    "OracleGreedy",
    "Plan",
    "Planned",
    "Random",
    "Rollout",
    "Schedule",
    "ScheduleState",
    "Shifting",
    "StaleVariance",
    "WaryTrace",
    "make_schedule",
]

SCHEDULES: dict[str, Callable[..., Schedule]] = {
    "none": Nothing,
    "static": partial(Shifting, period=None),
    "paper": partial(Shifting, period=4),
    "round-robin": partial(Shifting, period=1),
    "random": Random,
    "oldest-first": OldestFirst,
    "largest-variance": LargestVariance,
    "largest-density-variance": partial(LargestVariance, term="density"),
    "stale-variance": StaleVariance,
    "all": Everything,
}
"""Schedules that see nothing but the observation, each made of (interface, seed)."""

INFORMED: dict[str, Callable[..., BoundSchedule]] = {
    "greedy-trace": GreedyTrace,
    "greedy-logdet": GreedyLogdet,
    "wary-trace": WaryTrace,
    "rollout": Rollout,
}
"""Schedules that know the estimator's covariance, each made of (process, seed)."""

ORACLES: dict[str, Callable[..., BoundSchedule]] = {
    "oracle-error": OracleError,
    "oracle-greedy": OracleGreedy,
    "oracle-brute-force": OracleBruteForce,
}
"""Bounds that see the truth, each made of (process, seed). They are no policies."""


def make_schedule(name: str, env: Any, seed: int | None = None) -> Schedule:
    """Return the schedule ``name`` for an environment.

    Args:
        name: A name in `SCHEDULES`, `INFORMED`, `PLANS` or `ORACLES`, or the path of a plan, a
            file whose name ends in ``.json``.
        env: An environment of this package, scalar or vector, wrapped or not.
        seed: Seed of the schedule's own choices.

    Raises:
        ValueError: The name is unknown or the schedule does not suit the environment.
    """
    env = env.unwrapped
    if name in SCHEDULES:
        return SCHEDULES[name](env.interface, seed)
    if name.endswith(".json"):
        return Planned(env.process, read_plan(name), seed)
    if name in PLANS:
        return Planned(env.process, find_plan(name, Place.of(env.config)), seed)
    if name in INFORMED:
        return INFORMED[name](env.process, seed)
    if name in ORACLES:
        return ORACLES[name](env.process, seed)
    known = (*SCHEDULES, *INFORMED, *PLANS, *ORACLES)
    raise ValueError(f"unknown schedule {name!r}; known: {', '.join(known)}")
