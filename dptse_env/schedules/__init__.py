"""Query schedules: policies without training, and oracles.

Every schedule has the ``predict`` of a stable-baselines3 policy, so one loop serves schedules and
learned policies alike. Its memory between steps travels in ``state``, so one schedule serves any
number of episodes at once.
"""

from functools import partial
from typing import Any

from dptse_env.schedules.base import ProcessSchedule, Schedule, ScheduleState
from dptse_env.schedules.greedy import GreedyTrace
from dptse_env.schedules.oracles import OracleError, OracleGain
from dptse_env.schedules.rules import (
    Everything,
    ExpectedReduction,
    LargestDeviation,
    LargestVariance,
    Nothing,
    OldestFirst,
    Random,
    Shifting,
    SpeedFront,
    StaleVariance,
)
from dptse_env.utils.registry import Registry, name_of_class

__all__ = [
    "OBSERVATION_SCHEDULES",
    "ORACLES",
    "PROCESS_SCHEDULES",
    "SCHEDULES",
    "Everything",
    "ExpectedReduction",
    "GreedyTrace",
    "LargestDeviation",
    "LargestVariance",
    "Nothing",
    "OldestFirst",
    "OracleError",
    "OracleGain",
    "ProcessSchedule",
    "Random",
    "Schedule",
    "ScheduleState",
    "Shifting",
    "SpeedFront",
    "StaleVariance",
    "make_schedule",
]

OBSERVATION_SCHEDULES: dict[str, Any] = {
    "none": Nothing,
    "static": partial(Shifting, period=None),
    "paper": partial(Shifting, period=4),
    "round-robin": partial(Shifting, period=1),
    "random": Random,
    "oldest-first": OldestFirst,
    "largest-variance": LargestVariance,
    "largest-density-variance": partial(LargestVariance, term="density"),
    "stale-variance": StaleVariance,
    "largest-deviation": LargestDeviation,
    "speed-front": SpeedFront,
    "all": Everything,
}
"""Schedules that use the observation alone, each made of (interface, seed); a step costs at most a
sort."""

PROCESS_SCHEDULES: dict[str, type[ProcessSchedule]] = {
    "expected-reduction": ExpectedReduction,
    "greedy-trace": GreedyTrace,
}
"""Schedules that use the process, but not the truth: the noise to expect, and the estimator's
deviations or covariance. Each is made of (process, seed); a step costs a sort, or some two steps of
the EKF."""

ORACLES: dict[str, type[ProcessSchedule]] = {
    "oracle-error": OracleError,
    "oracle-gain": OracleGain,
}
"""Bounds that use the truth, each made of (process, seed); they are not policies."""


def _expected(part: Any) -> str | None:
    if isinstance(part, type) and not issubclass(part, Schedule):
        return "be a subclass of dptse_env.schedules.Schedule"
    if not callable(part) and not callable(getattr(part, "predict", None)):
        return "be a subclass of dptse_env.schedules.Schedule, or have predict()"
    return None


SCHEDULES = Registry(
    "schedule",
    {**OBSERVATION_SCHEDULES, **PROCESS_SCHEDULES, **ORACLES},
    check=_expected,
)
"""All schedules by name."""


def make_schedule(schedule: Any, env: Any, seed: int | None = None) -> Any:
    """Return a schedule for an environment.

    Args:
        schedule: A name in `SCHEDULES`, ``"package.module:Class"``, a subclass of `Schedule`, or
            an object with ``predict``, which is returned as it is.
        env: An environment of this package, scalar or vector, wrapped or not.
        seed: Seed of the schedule's random choices.

    Raises:
        ValueError: The name is unknown or the schedule does not suit the environment.
    """
    env = env.unwrapped
    part = SCHEDULES.find(schedule)
    if not isinstance(part, type | partial):
        return part
    cls: Any = part.func if isinstance(part, partial) else part
    made = part(env.process if issubclass(cls, ProcessSchedule) else env.interface, seed)
    if not callable(getattr(made, "predict", None)):
        raise ValueError(f"schedule {name_of_class(cls)} must have predict()")
    return made
