"""What the adversary asks: a public schedule, a hunter of the vehicle, a hunter that adapts."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from agents.studies.audit.distances import Ruler, best_spending
from agents.studies.audit.worlds import TwoWorlds
from dptse_env.arrays import BoolArray, FloatArray
from dptse_env.config import EnvConfig
from dptse_env.interface import QueryInterface
from dptse_env.schedules import SCHEDULES

FENCE = 3.0
"""Log-likelihood ratio at which the adaptive hunter has made up its mind: odds of 20 to 1."""

PUBLIC_SCHEDULES = ("paper", "static", "round-robin")
"""Schedules that look at nothing: their queries are known beforehand."""

POLICIES = ("hunter", "adaptive", *PUBLIC_SCHEDULES)
"""Names of the policies."""


class Policy(Protocol):
    """Chooses queries by what was released before, and by what the adversary knows."""

    def queries(self, step: int, belief: FloatArray) -> BoolArray:
        """Return the segments to ask, shape (k, n_mainline).

        Args:
            step: Steps released so far.
            belief: Log-likelihood ratio of world 1 of each run's transcript so far, shape (k,).
        """


class Planned:
    """Asks what was planned, whatever is released.

    Attributes:
        plan: Segments by step, shape (horizon, n_mainline).
    """

    def __init__(self, plan: BoolArray) -> None:
        """Keep the plan."""
        self.plan = plan

    def queries(self, step: int, belief: FloatArray) -> BoolArray:
        """See `Policy.queries`."""
        return np.tile(self.plan[step], (len(belief), 1))


class Adaptive(Planned):
    """Follows its plan while it is undecided, and leaves the vehicle alone from then on."""

    def queries(self, step: int, belief: FloatArray) -> BoolArray:
        """See `Policy.queries`."""
        return self.plan[step] & (np.abs(belief) < FENCE)[:, None]


def public_plan(config: EnvConfig, name: str) -> BoolArray:
    """Return the queries of a public schedule, shape (horizon, n_mainline)."""
    interface = QueryInterface.of(config)
    steps = np.arange(config.horizon_steps)
    size = interface.observations.space.shape[0]
    schedule = SCHEDULES[name](interface)
    return schedule.select(steps, np.zeros((len(steps), size), dtype=np.float32))


def always_observed(config: EnvConfig) -> list[int]:
    """Return the record columns that are observed at every step without being asked."""
    corridor = config.corridor
    columns = list(corridor.fixed_sensors)
    if config.privacy.boundary == "private":
        columns += range(corridor.n_segments, corridor.n_segments + corridor.n_boundaries)
    return columns


def hunting_plan(config: EnvConfig, worlds: TwoWorlds) -> BoolArray:
    """Return the queries that follow the vehicle in both worlds, shape (horizon, n_mainline).

    A path is asked for in the seconds that tell most, as many as count, within the bandwidth.
    """
    plan = np.zeros((config.horizon_steps, config.corridor.n_mainline), dtype=bool)
    candidates, left = [], []
    for world in (0, 1):
        seconds, budget = _worth_asking(config, worlds, world)
        candidates += seconds
        left.append(budget)
    for _, step, segment, world in sorted(candidates):
        # Where both paths meet, one query serves both.
        free = plan[step, segment] or plan[step].sum() < config.bandwidth
        if left[world] and free:
            plan[step, segment] = True
            left[world] -= 1
    return plan


def _worth_asking(
    config: EnvConfig, worlds: TwoWorlds, world: int
) -> tuple[list[tuple[float, int, int, int]], int]:
    """Return (-gain, step, segment, world) of what may be asked of a path, and how many of it."""
    path, horizon = worlds.paths[world], config.horizon_steps
    unasked = np.isin(path.segment, always_observed(config))
    seen = (unasked | (path.segment < config.corridor.n_mainline)) & (path.step >= 1)
    seen &= path.step <= horizon
    gains, unasked, path = (
        _gains(Ruler.of(config), worlds, world)[seen],
        unasked[seen],
        path.only(seen),
    )
    cap = config.privacy.contribution_cap or horizon
    spending = best_spending(gains, unasked, cap)
    ask = ~unasked & (np.arange(len(gains)) < spending.stop)
    columns = (-gains[ask], path.step[ask] - 1, path.segment[ask])
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return [(*row, world) for row in rows], spending.asked


def _gains(ruler: Ruler, worlds: TwoWorlds, world: int) -> FloatArray:
    """What each second of one world's path tells, shape (m,); where both meet, half of it."""
    own, other = worlds.paths[world], worlds.paths[1 - world]
    gains = ruler.of_path(worlds.rest, own)
    _, mine, its = np.intersect1d(own.step, other.step, assume_unique=True, return_indices=True)
    meet = own.segment[mine] == other.segment[its]
    mine, its = mine[meet], its[meet]
    gains[mine] = 0.5 * ruler.of_meeting(worlds.rest, (own.only(mine), other.only(its)))
    return gains


def make_policy(config: EnvConfig, name: str, worlds: TwoWorlds) -> Planned:
    """Return the policy of a name in `POLICIES` for two worlds."""
    if name in PUBLIC_SCHEDULES:
        return Planned(public_plan(config, name))
    plan = hunting_plan(config, worlds)
    return Adaptive(plan) if name == "adaptive" else Planned(plan)
