"""Query policies of the adversary: public schedules, the hunter of a vehicle, an adaptive one."""

from __future__ import annotations

import numpy as np

from agents.studies.audit.distances import (
    ReleaseDistances,
    contribution_cap,
    plan_contributions,
)
from agents.studies.audit.worlds import AdjacentWorlds
from dptse_env.config import EnvConfig
from dptse_env.parts import make_interface, make_release
from dptse_env.schedules import OBSERVATION_SCHEDULES
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
    schedule = OBSERVATION_SCHEDULES[name](interface)
    queried: BoolArray = schedule.select(steps, np.zeros((len(steps), size), dtype=np.float32))
    return queried


def always_observed(config: EnvConfig) -> list[int]:
    """Return the record columns that are observed at every step without a query."""
    columns: list[int] = make_release(config).setup.always_observed.tolist()
    return columns


def hunting_plan(config: EnvConfig, worlds: AdjacentWorlds) -> BoolArray:
    """Return the queries that follow the vehicle in both worlds, shape (horizon, n_mainline).

    A trajectory is queried in the seconds that reveal most, as many as count, within the bandwidth.
    """
    plan = np.zeros((config.horizon_steps, config.corridor.n_mainline), dtype=bool)
    candidates, left = [], []
    for world in (0, 1):
        seconds, budget = _worthwhile(config, worlds, world)
        candidates += seconds
        left.append(budget)
    for _, step, segment, world in sorted(candidates):
        # Where both trajectories meet, one query serves both.
        free = plan[step, segment] or plan[step].sum() < config.bandwidth
        if left[world] and free:
            plan[step, segment] = True
            left[world] -= 1
    return plan


def _worthwhile(
    config: EnvConfig, worlds: AdjacentWorlds, world: int
) -> tuple[list[tuple[float, int, int, int]], int]:
    """Return (-gain, step, segment, world) of possible queries, and how many of them to make."""
    vehicle, horizon = worlds.trajectories[world], config.horizon_steps
    always = np.isin(vehicle.segment, always_observed(config))
    seen = (always | (vehicle.segment < config.corridor.n_mainline)) & (vehicle.step >= 1)
    seen &= vehicle.step <= horizon
    distances = ReleaseDistances.from_config(config)
    gains, always, vehicle = (
        _gains(distances, worlds, world)[seen],
        always[seen],
        vehicle.only(seen),
    )
    plan = plan_contributions(gains, always, contribution_cap(config))
    chosen = ~always & (np.arange(len(gains)) < plan.stop)
    columns = (-gains[chosen], vehicle.step[chosen] - 1, vehicle.segment[chosen])
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return [(*row, world) for row in rows], plan.n_queries


def _gains(distances: ReleaseDistances, worlds: AdjacentWorlds, world: int) -> FloatArray:
    """Return the gain of each second of a trajectory, shape (m,); half of it where both meet."""
    vehicle, other = worlds.trajectories[world], worlds.trajectories[1 - world]
    gains = distances.by_second(worlds.rest, vehicle)
    _, here, there = np.intersect1d(
        vehicle.step, other.step, assume_unique=True, return_indices=True
    )
    meet = vehicle.segment[here] == other.segment[there]
    here, there = here[meet], there[meet]
    pair = vehicle.only(here), other.only(there)
    gains[here] = 0.5 * distances.where_equal(worlds.rest, pair)
    return gains


def make_policy(config: EnvConfig, name: str, worlds: AdjacentWorlds) -> FixedQueries:
    """Return the policy of a name in `STRATEGIES` for two worlds."""
    if name in PUBLIC_SCHEDULES:
        return FixedQueries(public_plan(config, name))
    plan = hunting_plan(config, worlds)
    return AdaptiveQueries(plan) if name == "adaptive" else FixedQueries(plan)
