"""Plans against a release model with the same noise at every step, by closed forms."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from itertools import pairwise
from typing import ClassVar

import numpy as np

from agents.studies.audit.attack import Adversary
from agents.studies.audit.distances import (
    ReleaseDistances,
    contribution_cap,
    plan_contributions,
    protects_seconds,
    replaces,
)
from agents.studies.audit.planning import Pair, Planner, Second
from agents.studies.audit.releases import Terms
from agents.studies.audit.strategies import PUBLIC_SCHEDULES, always_observed
from agents.studies.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.config import EnvConfig
from dptse_env.parts import make_release
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class GaussianPlanner(Planner):
    """Plans against `paper`, `corrected` and `capped`, where a hunter should save queries."""

    kinds: ClassVar[tuple[str, ...]] = ("worst-case", "replaced", "deleted")

    @cached_property
    def _distances(self) -> ReleaseDistances:
        return ReleaseDistances.from_config(self.config)

    def rank(self, record: Record, kind: str) -> IntArray:
        """Return vehicles by the distance between presence and absence, the largest first."""
        config = self.config
        rows = np.flatnonzero(self.observable(record)[record.step, record.segment])
        rows = rows[np.lexsort((record.step[rows], record.vehicle[rows]))]
        gains = self._distances.by_row(record)[rows]
        always = np.isin(record.segment[rows], always_observed(config))
        # A schedule meets a vehicle when it does; a hunter picks the seconds that reveal most.
        always |= self.policy in PUBLIC_SCHEDULES
        vehicles, starts = np.unique(record.vehicle[rows].astype(np.int64), return_index=True)
        reach = np.zeros(len(vehicles))
        for i, (start, stop) in enumerate(pairwise([*starts.tolist(), len(rows)])):
            trip = slice(start, stop)
            if protects_seconds(config):
                reach[i] = gains[trip].max()
            else:
                cap = contribution_cap(config)
                reach[i] = plan_contributions(gains[trip], always[trip], cap).reach
        best: IntArray = vehicles[np.argsort(-reach, kind="stable")]
        return best

    def gains(self, rest: Record, vehicle: Trajectory) -> FloatArray:
        """See `Planner.gains`: squared distances in units of the noise."""
        return self._distances.by_second(rest, vehicle)

    def made_up(self, record: Record, kind: str) -> Mapping[str, Pair]:
        """Return the trajectories of the closed form that are furthest apart.

        Segments without a sensor and with few others: one vehicle moves their mean speed most.
        """
        corridor, seconds = self.config.corridor, np.arange(1, self.config.horizon_steps + 1)
        here, there = self.quiet_segments(record)[:2]
        stands = Trajectory.constant(seconds, here, 0.0)
        added = f"an added vehicle that stands on segment {here}"
        if not replaces(self.config):
            return {f"{added}, or none in its place": (stands, Trajectory.absent())}
        limit = corridor.largest_speed_limit
        elsewhere = Trajectory.constant(seconds, there, 0.0)
        passing = Trajectory.constant(seconds, here, limit)
        return {
            f"{added}, or on segment {there} instead": (stands, elsewhere),
            f"{added}, or there at {limit:g} km/h": (stands, passing),
        }

    def reached(self, worlds: AdjacentWorlds) -> float:
        """See `Planner.reached`: the exact distance, which does not depend on what is released."""
        return planned_distance(self.config, worlds, self.plan(worlds))

    def worthwhile(self, worlds: AdjacentWorlds, world: int) -> tuple[list[Second], int]:
        """See `Planner.worthwhile`: as many seconds as count, by what they tell."""
        vehicle = worlds.trajectories[world]
        seen = self.queryable(vehicle)
        gains, vehicle = self._gains_in(worlds, world)[seen], vehicle.only(seen)
        always: BoolArray = np.isin(vehicle.segment, always_observed(self.config))
        plan = plan_contributions(gains, always, contribution_cap(self.config))
        chosen = ~always & (np.arange(len(gains)) < plan.stop)
        columns = (-gains[chosen], vehicle.step[chosen] - 1, vehicle.segment[chosen])
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return [(*row, world) for row in rows], plan.n_queries

    def _gains_in(self, worlds: AdjacentWorlds, world: int) -> FloatArray:
        """Return what each second of a trajectory tells, (m,); half of it where both meet."""
        vehicle, other = worlds.trajectories[world], worlds.trajectories[1 - world]
        gains = self.gains(worlds.rest, vehicle)
        _, here, there = np.intersect1d(
            vehicle.step, other.step, assume_unique=True, return_indices=True
        )
        meet = vehicle.segment[here] == other.segment[there]
        here, there = here[meet], there[meet]
        pair = vehicle.only(here), other.only(there)
        gains[here] = 0.5 * self._distances.where_equal(worlds.rest, pair)
        return gains


def planned_distance(config: EnvConfig, worlds: AdjacentWorlds, plan: BoolArray) -> float:
    """Return the distance between the worlds under a plan (horizon, n_mainline), in noise units."""
    release = make_release(config)
    sigma = np.broadcast_to(release.sigma, (1, release.setup.n_columns, 2))
    terms = Terms(sigma, np.empty((1, 0)), np.empty((1, 0)))
    adversary = Adversary(config, worlds, 1)
    adversary.reset(1)
    for step, queried in enumerate(plan):
        adversary.expect(step + 1, queried[None], terms)
    return float(np.sqrt(adversary.square[0]))
