"""Plans of an adversary before an attack: vehicles that tell much, and seconds to query them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from itertools import pairwise
from typing import ClassVar

import numpy as np

from agents.audit.attack import attack, public_terms
from agents.audit.distances import (
    ReleaseDistances,
    contribution_cap,
    plan_contributions,
    protects_seconds,
    replaces,
)
from agents.audit.releases import Terms, attacked
from agents.audit.strategies import (
    PUBLIC_SCHEDULES,
    AdaptiveQueries,
    FixedQueries,
    always_observed,
    public_plan,
)
from agents.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.config import EnvConfig
from dptse_env.parts import make_release
from dptse_env.release import Paced
from dptse_env.traffic import Record
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.fields import require

JAM_SPEED = 10.0
"""Speed below which a vehicle stands in a jam [km/h]."""

LATE = 0.5
"""Part of an episode after which a vehicle enters late."""

SHORTLIST = 12
"""Partners to try for the best vehicle. The best partners stand in one jam and are alike, so the
list grows sparser down the ranking instead of ending early."""

Pair = tuple[Trajectory, Trajectory]
Second = tuple[float, int, int, int]  # a cost, a step, a segment and the world it is queried for


class Planner(ABC):
    """Plans an attack on a release model.

    Attributes:
        kinds: Kinds of targets that it knows.
        config: The configuration under attack.
        policy: Name of the policy, in `agents.audit.strategies.STRATEGIES`.
    """

    kinds: ClassVar[tuple[str, ...]] = ("worst-case",)

    def __init__(self, config: EnvConfig, policy: str) -> None:
        """Plan for a configuration and a policy."""
        self.config, self.policy = config, policy

    @abstractmethod
    def gains(self, rest: Record, vehicle: Trajectory) -> FloatArray:
        """Return what each second of a vehicle that is added to a record tells, shape (m,)."""

    @abstractmethod
    def worthwhile(self, worlds: AdjacentWorlds, world: int) -> tuple[list[Second], int]:
        """Return the seconds in which to query a world's vehicle, and how many of them to take.

        Those of the least cost are taken first.
        """

    def more_pairs(self, record: Record, here: int) -> Mapping[str, Pair]:
        """Return further worst cases under the adjacency ``replace``, by the difference in words.

        ``here`` is the segment on which the vehicle of the others stands.
        """
        return {}

    def places(self, record: Record) -> list[int]:
        """Return the segments on which a made-up vehicle stands, the best first.

        Those without a sensor and with few others come first: there, a vehicle moves the mean
        speed most.
        """
        corridor = self.config.corridor
        load = record.counts[:, : corridor.n_mainline].sum(axis=0)
        fixed = np.isin(np.arange(corridor.n_mainline), corridor.fixed_sensors)
        segments: list[int] = np.lexsort((load, fixed)).tolist()
        return segments

    def made_up(self, record: Record, kind: str) -> Mapping[str, Pair]:
        """Return pairs of made-up trajectories of a kind, by the difference in words."""
        seconds, (here, there) = self.seconds, self.places(record)[:2]
        stands = Trajectory.constant(seconds, here, 0.0)
        added = f"an added vehicle that stands on segment {here}"
        if not replaces(self.config):
            return {f"{added}, or none in its place": (stands, Trajectory.absent())}
        elsewhere = Trajectory.constant(seconds, there, 0.0)
        pairs = {f"{added}, or on segment {there} instead": (stands, elsewhere)}
        more = self.more_pairs(record, here)
        return more if kind == "opposite" else {**pairs, **more}

    @property
    def seconds(self) -> IntArray:
        """The seconds of an episode."""
        return np.arange(1, self.config.horizon_steps + 1)

    def require_kind(self, kind: str) -> None:
        """Refuse kinds of targets that the release model or the adjacency does not have.

        Raises:
            ValueError: It is none of `kinds`.
        """
        preset = f"preset {self.config.privacy.preset!r}"
        require(kind in self.kinds, "target", f"one of {list(self.kinds)} for {preset}", kind)
        single = [each for each in self.kinds if each not in ("replaced", "opposite")]
        allowed = f"one of {single} with add_remove"
        require(replaces(self.config) or kind in single, "target", allowed, kind)

    def observable(self, record: Record) -> BoolArray:
        """Return flags of record columns the policy may observe, (n_steps, n_columns)."""
        config = self.config
        observed = np.zeros((record.n_steps, record.n_columns), dtype=bool)
        is_public = self.policy in PUBLIC_SCHEDULES
        queried = public_plan(config, self.policy) if is_public else True
        seconds = slice(1, config.horizon_steps + 1)
        observed[seconds, : config.corridor.n_mainline] = queried
        observed[seconds, always_observed(config)] = True
        return observed

    def always(self, segment: AnyArray) -> BoolArray:
        """Return flags of record columns that are observed without a query, shape (m,)."""
        flags: BoolArray = np.isin(segment, always_observed(self.config))
        return flags

    def queryable(self, vehicle: Trajectory) -> BoolArray:
        """Return flags of a vehicle's seconds that an episode can release, shape (m,)."""
        seen = (vehicle.step >= 1) & (vehicle.step <= self.config.horizon_steps)
        on_mainline = vehicle.segment < self.config.corridor.n_mainline
        flags: BoolArray = seen & (self.always(vehicle.segment) | on_mainline)
        return flags

    def by_turns(
        self, vehicle: Trajectory, rows: BoolArray, world: int
    ) -> tuple[list[Second], int]:
        """Return all seconds of some rows of a world's vehicle, for `worthwhile`.

        Where the bandwidth does not suffice for both vehicles, it serves them by turns.
        """
        chosen = vehicle.only(rows)
        steps = zip((chosen.step - 1).tolist(), chosen.segment.tolist(), strict=True)
        seconds = [(float((step + world) % 2), step, segment, world) for step, segment in steps]
        return seconds, len(seconds)

    def plan(self, worlds: AdjacentWorlds) -> BoolArray:
        """Return the policy's queries, shape (horizon, n_mainline)."""
        if self.policy in PUBLIC_SCHEDULES:
            return public_plan(self.config, self.policy)
        return self.hunting_plan(worlds)

    def hunting_plan(self, worlds: AdjacentWorlds) -> BoolArray:
        """Return the queries that follow the vehicle in both worlds, shape (horizon, n_mainline).

        A trajectory is queried in the seconds that tell most, within the bandwidth.
        """
        config = self.config
        plan = np.zeros((config.horizon_steps, config.corridor.n_mainline), dtype=bool)
        candidates, left = [], []
        for world in (0, 1):
            seconds, budget = self.worthwhile(worlds, world)
            candidates += seconds
            left.append(budget)
        for _, step, segment, world in sorted(candidates):
            # Where both trajectories meet, one query serves both.
            free = plan[step, segment] or plan[step].sum() < config.bandwidth
            if left[world] and free:
                plan[step, segment] = True
                left[world] -= 1
        return plan

    def queries(self, worlds: AdjacentWorlds) -> FixedQueries:
        """Return the policy for two worlds."""
        plan = self.plan(worlds)
        return AdaptiveQueries(plan) if self.policy == "adaptive" else FixedQueries(plan)

    def reached(self, worlds: AdjacentWorlds) -> float:
        """Return the distance that the policy reaches between two worlds in a run of either."""
        queries = FixedQueries(self.plan(worlds))
        return float(attack(self.config, worlds, queries, 1, progress=False).distances.max())


class GaussianPlanner(Planner):
    """Plans against `paper`, `corrected` and `capped`, whose noise is the same at every step.

    Distances have closed forms, and a hunter should save queries.
    """

    kinds: ClassVar[tuple[str, ...]] = ("worst-case", "replaced", "deleted")

    @cached_property
    def _distances(self) -> ReleaseDistances:
        return ReleaseDistances.from_config(self.config)

    def rank(self, record: Record, kind: str) -> IntArray:
        """Return observable vehicles by the distance between presence and absence."""
        config = self.config
        rows = np.flatnonzero(self.observable(record)[record.step, record.segment])
        rows = rows[np.lexsort((record.step[rows], record.vehicle[rows]))]
        gains = self._distances.by_row(record)[rows]
        # A schedule meets a vehicle when it does; a hunter picks the seconds that reveal most.
        always = self.always(record.segment[rows]) | (self.policy in PUBLIC_SCHEDULES)
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

    def more_pairs(self, record: Record, here: int) -> Mapping[str, Pair]:
        """See `Planner.more_pairs`: two vehicles on one segment, as slow and as fast as can be."""
        limit = self.config.corridor.largest_speed_limit
        slow, fast = (Trajectory.constant(self.seconds, here, speed) for speed in (0.0, limit))
        name = f"an added vehicle that stands on segment {here}, or there at {limit:g} km/h"
        return {name: (slow, fast)}

    def worthwhile(self, worlds: AdjacentWorlds, world: int) -> tuple[list[Second], int]:
        """See `Planner.worthwhile`: as many seconds as count, by what they tell."""
        vehicle = worlds.trajectories[world]
        seen = self.queryable(vehicle)
        gains, vehicle = self._gains_in(worlds, world)[seen], vehicle.only(seen)
        always = self.always(vehicle.segment)
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


class PacedPlanner(Planner):
    """Plans against `paced`, by the prices and centres of a typical episode.

    A vehicle tells as much as it pays, so a hunter saves no queries.
    """

    kinds: ClassVar[tuple[str, ...]] = (
        "worst-case", "opposite", "replaced", "deleted", "runs-out", "jam", "late",
    )  # fmt: skip
    _terms: Terms | None = None

    @cached_property
    def _release(self) -> Paced:
        release = make_release(self.config)
        assert isinstance(release, Paced)
        return release

    def _typical(self, record: Record) -> Terms:
        """Return public terms of an episode over the first record that was asked for.

        One vehicle more or less hardly changes them, nor does the noise.
        """
        if self._terms is None:
            schedule = self.policy if self.policy in PUBLIC_SCHEDULES else "round-robin"
            self._terms = public_terms(self.config, record, public_plan(self.config, schedule))
        return self._terms

    def rank(self, record: Record, kind: str) -> IntArray:
        """Return observable vehicles by what they pay, or by what their kind is about."""
        flags = self.observable(record)[record.step, record.segment]
        step, vehicle = record.step[flags], record.vehicle[flags].astype(np.int64)
        speed, segment = record.speed[flags], record.segment[flags]
        costs = self._costs(record, step, segment, speed)
        asked = np.bincount(vehicle, costs, record.n_vehicles)
        if protects_seconds(self.config):
            paid: FloatArray = np.zeros(record.n_vehicles)
            np.maximum.at(paid, vehicle, costs)
        else:
            paid = np.minimum(asked, self._release.ledgers.budget[0])
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
        ledgers, terms = self._release.ledgers, self._typical(record)
        covers = self._release.task.covers
        prices = (terms.prices @ (covers / covers.sum(axis=0)))[step - 1, segment]
        centre = terms.centre[step - 1, segment]
        speed = np.clip(speed, 0.0, ledgers.fastest)
        deviations = np.clip(speed - centre, -ledgers.clip, ledgers.clip)
        costs: FloatArray = prices * (1.0 + ledgers.ratio * (deviations / ledgers.clip) ** 2)
        return costs

    def more_pairs(self, record: Record, here: int) -> Mapping[str, Pair]:
        """See `Planner.more_pairs`: two vehicles whose deviations are as opposite as can be.

        They are on the road in the better half of the seconds: where the centre is near the speed
        limit, both are below it or at it.
        """
        corridor, clip = self.config.corridor, self._release.ledgers.clip
        limit, mainline = corridor.largest_speed_limit, slice(corridor.n_mainline)
        centres = self._typical(record).centre[self.seconds - 1, mainline]
        products = np.minimum(limit - centres, clip) * np.minimum(centres, clip)
        products = np.where(self.observable(record)[self.seconds, mainline], products, -1.0)
        best = products.max(axis=1)
        chosen = best >= np.median(best)
        seconds, segments = self.seconds[chosen], np.argmax(products, axis=1)[chosen]
        still = np.zeros(len(seconds))
        slow, fast = (Trajectory(seconds, segments, still + speed) for speed in (0.0, limit))
        name = (
            "an added vehicle that stands, or one in its place at the speed limit, where the "
            "centre lies between them"
        )
        return {name: (slow, fast)}

    def worthwhile(self, worlds: AdjacentWorlds, world: int) -> tuple[list[Second], int]:
        """See `Planner.worthwhile`: every second that needs a query, for both by turns."""
        vehicle = worlds.trajectories[world]
        needed = self.queryable(vehicle) & ~self.always(vehicle.segment)
        return self.by_turns(vehicle, needed, world)

    def hunting_plan(self, worlds: AdjacentWorlds) -> BoolArray:
        """See `Planner.hunting_plan`; what is left of the bandwidth goes round all segments.

        That keeps the estimator, and so centres and prices, as they are in a typical episode.
        """
        plan = super().hunting_plan(worlds)
        for queried, offered in zip(plan, public_plan(self.config, "round-robin"), strict=True):
            left = self.config.bandwidth - int(queried.sum())
            queried[np.flatnonzero(offered & ~queried)[:left]] = True
        return plan


class GroupsPlanner(Planner):
    """Plans against two groups of columns: a made-up connected vehicle that stands at a sensor.

    It is seen in every second by the fixed sensor, and queried as well.
    """

    def gains(self, rest: Record, vehicle: Trajectory) -> FloatArray:
        """See `Planner.gains`: every second tells alike."""
        return self.queryable(vehicle).astype(np.float64)

    def places(self, record: Record) -> list[int]:
        """See `Planner.places`: at the last sensor, and at another one or elsewhere."""
        n_mainline, quiet = self.config.corridor.n_mainline, super().places(record)
        sensors = [each for each in self.config.corridor.fixed_sensors if each < n_mainline]
        return list(dict.fromkeys([*sensors[-1:], *sensors, *quiet]))

    def worthwhile(self, worlds: AdjacentWorlds, world: int) -> tuple[list[Second], int]:
        """See `Planner.worthwhile`: every second on the mainline, for both vehicles by turns."""
        vehicle = worlds.trajectories[world]
        on_mainline = vehicle.segment < self.config.corridor.n_mainline
        return self.by_turns(vehicle, self.queryable(vehicle) & on_mainline, world)


TARGET_KINDS = PacedPlanner.kinds
"""Kinds of targets; release models other than the paced ledger have some of them."""


def make_planner(config: EnvConfig, policy: str) -> Planner:
    """Return what plans an attack on a configuration by a policy."""
    release = attacked(make_release(config)).model
    if not release.task.is_whole:
        return GroupsPlanner(config, policy)
    kind = PacedPlanner if isinstance(release, Paced) else GaussianPlanner
    return kind(config, policy)


def make_policy(config: EnvConfig, policy: str, worlds: AdjacentWorlds) -> FixedQueries:
    """Return the policy of a name in `agents.audit.strategies.STRATEGIES` for two worlds."""
    return make_planner(config, policy).queries(worlds)


def choose_target(config: EnvConfig, record: Record, kind: str, policy: str) -> AdjacentWorlds:
    """Return the two worlds of a kind that a policy distinguishes best.

    Args:
        config: The configuration under attack.
        record: The traffic.
        kind: ``deleted``, a vehicle of the record is there or not; ``replaced``, one of two
            vehicles of the record is there; ``worst-case``, a vehicle is added that stands still,
            and in the other world stands elsewhere, drives by or is absent, whichever is worst
            under the adjacency. For the paced ledger also ``opposite``, the part of the worst case
            with two added vehicles on one segment, as slow and as fast as can be; and, of the
            record and replaced by another or by none, ``runs-out``, the vehicle to which its ledger
            refuses most, ``jam``, the one that stands longest, and ``late``, the one that pays most
            of those that enter in the second half.
        policy: Name of the policy.

    Raises:
        ValueError: The kind does not go with the release model or the adjacency, or the record
            holds too few vehicles.
    """
    planner = make_planner(config, policy)
    planner.require_kind(kind)
    if kind in ("worst-case", "opposite"):
        made_up = planner.made_up(record, kind).items()
        candidates = [_worlds(planner, record, pair, name) for name, pair in made_up]
    else:
        assert isinstance(planner, GaussianPlanner | PacedPlanner)  # others make vehicles up
        candidates = _of_record(planner, planner.rank(record, kind), record, kind)
    return max(candidates, key=planner.reached) if len(candidates) > 1 else candidates[0]


def _of_record(
    planner: Planner, ranked: IntArray, record: Record, kind: str
) -> list[AdjacentWorlds]:
    """Return worlds in which the best of ranked vehicles is replaced by others, or by none."""
    alone = kind == "deleted" or not replaces(planner.config)
    need = 1 if alone else 2
    require(len(ranked) >= need, "traffic", f"a record of {need} observable vehicles", len(ranked))
    first = int(ranked[0])
    vehicle, rest = Trajectory.from_record(record, first), record.without(first)
    if alone:
        name = f"vehicle {first} of the record, or none in its place"
        return [_worlds(planner, rest, (vehicle, Trajectory.absent()), name)]
    others = np.unique(ranked[np.geomspace(1, len(ranked) - 1, SHORTLIST).astype(int)]).tolist()
    return [
        _worlds(
            planner,
            rest.without(other),
            (vehicle, Trajectory.from_record(record, other)),
            f"vehicle {first} of the record, or vehicle {other} instead",
        )
        for other in others
    ]


def _worlds(planner: Planner, rest: Record, pair: Pair, description: str) -> AdjacentWorlds:
    """Return two worlds that differ as far as is protected.

    For the unit ``event`` that is the second of the two trajectories that tells most.
    """
    if protects_seconds(planner.config):
        seen, total = planner.observable(rest), np.zeros(rest.n_steps)
        for vehicle in pair:
            told = planner.gains(rest, vehicle) * seen[vehicle.step, vehicle.segment]
            np.add.at(total, vehicle.step, told)
        best = int(np.argmax(total))
        pair = pair[0].only(pair[0].step == best), pair[1].only(pair[1].step == best)
    return AdjacentWorlds(rest, pair, description)
