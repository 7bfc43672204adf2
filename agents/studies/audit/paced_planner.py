"""Plans against the paced ledger, by the prices and centres of a typical episode."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import ClassVar

import numpy as np

from agents.studies.audit.distances import protects_seconds, replaces
from agents.studies.audit.planning import Pair, Planner, Second
from agents.studies.audit.series import PublicSeries, play_series
from agents.studies.audit.strategies import (
    PUBLIC_SCHEDULES,
    always_observed,
    public_plan,
)
from agents.studies.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.parts import make_release
from dptse_env.release import Paced
from dptse_env.traffic import Record
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray

JAM_SPEED = 10.0
"""Speed below which a vehicle stands in a jam [km/h]."""

LATE = 0.5
"""Part of an episode after which a vehicle enters late."""


class PacedPlanner(Planner):
    """Plans against `paced`: a vehicle tells as much as it pays, so a hunter saves no queries."""

    kinds: ClassVar[tuple[str, ...]] = (
        "worst-case", "opposite", "replaced", "deleted", "runs-out", "jam", "late",
    )  # fmt: skip
    made_up_kinds: ClassVar[tuple[str, ...]] = ("worst-case", "opposite")
    _series: PublicSeries | None = None

    @cached_property
    def _release(self) -> Paced:
        release = make_release(self.config)
        assert isinstance(release, Paced)
        return release

    def _typical(self, record: Record) -> PublicSeries:
        """Return public numbers of an episode over the first record that was asked for.

        One vehicle more or less hardly changes them, nor does the noise.
        """
        if self._series is None:
            schedule = self.policy if self.policy in PUBLIC_SCHEDULES else "round-robin"
            plan = public_plan(self.config, schedule)
            self._series = play_series(self.config, record, plan)
        return self._series

    def rank(self, record: Record, kind: str) -> IntArray:
        """Return vehicles by what they pay, or by what their kind is about."""
        flags = self.observable(record)[record.step, record.segment]
        step, vehicle = record.step[flags], record.vehicle[flags].astype(np.int64)
        speed, segment = record.speed[flags], record.segment[flags]
        costs = self._costs(record, step, segment, speed)
        asked = np.bincount(vehicle, costs, record.n_vehicles)
        if protects_seconds(self.config):
            paid: FloatArray = np.zeros(record.n_vehicles)
            np.maximum.at(paid, vehicle, costs)
        else:
            paid = np.minimum(asked, self._release.ledgers.budget)
        suits: AnyArray = paid
        if kind == "runs-out":
            suits = asked - paid
        elif kind == "jam":
            suits = np.bincount(vehicle, (speed < JAM_SPEED).astype(float), record.n_vehicles)
        elif kind == "late":
            first = np.full(record.n_vehicles, record.n_steps)
            np.minimum.at(first, vehicle, step)
            suits = np.where(first > LATE * self.config.horizon_steps, paid, 0.0)
        best: IntArray = np.lexsort((-asked, -suits))
        return best[asked[best] > 0.0]

    def gains(self, rest: Record, vehicle: Trajectory) -> FloatArray:
        """See `Planner.gains`: what a vehicle pays in each second, if its ledger covers it."""
        gains = np.zeros(len(vehicle.step))
        seen = self.queryable(vehicle)
        some = vehicle.only(seen)
        gains[seen] = self._costs(rest, some.step, some.segment, some.speed)
        return gains

    def _costs(
        self, record: Record, step: AnyArray, segment: AnyArray, speed: AnyArray
    ) -> FloatArray:
        """Return what rows of vehicles pay for a query of their segment, shape (rows,).

        Where several queries cover a segment, it is the mean of what they cost.
        """
        ledgers, terms = self._release.ledgers, self._typical(record).terms
        prices = terms.prices @ (ledgers.covers / ledgers.covers.sum(axis=0))
        prices, limit = prices[step - 1, segment], ledgers.vehicles.largest_speed
        centres = terms.centres[step - 1, segment]
        deviations = np.clip(np.clip(speed, 0.0, limit) - centres, -ledgers.clip, ledgers.clip)
        costs: FloatArray = prices * (1.0 + ledgers.ratio * (deviations / ledgers.clip) ** 2)
        return costs

    def made_up(self, record: Record, kind: str) -> Mapping[str, Pair]:
        """Return two vehicles on two segments, two that deviate oppositely, or a lone one."""
        seconds = np.arange(1, self.config.horizon_steps + 1)
        here, there = self.quiet_segments(record)[:2]
        stands = Trajectory.constant(seconds, here, 0.0)
        added = f"an added vehicle that stands on segment {here}"
        if not replaces(self.config):
            return {f"{added}, or none in its place": (stands, Trajectory.absent())}
        opposite = {
            "an added vehicle that stands, or one in its place at the speed limit, where "
            "the centre lies between them": self._opposite(record, seconds)
        }
        if kind == "opposite":
            return opposite
        elsewhere = Trajectory.constant(seconds, there, 0.0)
        return {f"{added}, or on segment {there} instead": (stands, elsewhere)} | opposite

    def _opposite(self, record: Record, seconds: IntArray) -> Pair:
        """Return two vehicles on one segment whose deviations are as opposite as can be.

        They are on the road in the better half of the seconds: where the centre is near the speed
        limit, both are below it or at it.
        """
        corridor, clip = self.config.corridor, self._release.ledgers.clip
        centres = self._typical(record).terms.centres[seconds - 1, : corridor.n_mainline]
        products = np.minimum(corridor.largest_speed_limit - centres, clip) * np.minimum(
            centres, clip
        )
        seen = self.observable(record)[seconds, : corridor.n_mainline]
        products = np.where(seen, products, -1.0)
        best = products.max(axis=1)
        chosen = best >= np.median(best)
        seconds, segments = seconds[chosen], np.argmax(products, axis=1)[chosen]
        still = np.zeros(len(seconds))
        return (
            Trajectory(seconds, segments, still),
            Trajectory(seconds, segments, still + corridor.largest_speed_limit),
        )

    def worthwhile(self, worlds: AdjacentWorlds, world: int) -> tuple[list[Second], int]:
        """See `Planner.worthwhile`: every second that needs a query, for both by turns."""
        vehicle = worlds.trajectories[world]
        always = np.isin(vehicle.segment, always_observed(self.config))
        return self.by_turns(vehicle, self.queryable(vehicle) & ~always, world)

    def hunting_plan(self, worlds: AdjacentWorlds) -> BoolArray:
        """See `Planner.hunting_plan`; what is left of the bandwidth goes round all segments.

        That keeps the estimator, and so centres and prices, as they are in a typical episode.
        """
        plan = super().hunting_plan(worlds)
        for queried, offered in zip(plan, public_plan(self.config, "round-robin"), strict=True):
            left = self.config.bandwidth - int(queried.sum())
            queried[np.flatnonzero(offered & ~queried)[:left]] = True
        return plan
