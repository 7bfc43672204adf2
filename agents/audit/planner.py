"""Plans of an adversary before an attack: vehicles that tell much, and seconds to query them."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from agents.audit.attack import attack, overheard
from agents.audit.worlds import Pair, Trajectory, Worlds
from dptse_env.config import EnvConfig
from dptse_env.parts import make_interface, make_release
from dptse_env.release.vehicles import Terms
from dptse_env.schedules import SCHEDULES
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.validation import require

KINDS = ("worst-case", "replaced", "deleted")
"""Kinds of targets; see `Planner.choose`."""

SHORTLIST = 12
"""Partners to try for the best vehicle. The best partners stand in one jam and are alike, so the
list grows sparser down the ranking instead of ending early."""

REHEARSALS = 4
"""Runs in either world by which pairs are compared: under `paced` noise moves prices."""

Second = tuple[float, int, int, int]  # a cost, a step, a segment and the world it is queried for


def public_plan(config: EnvConfig, name: str) -> BoolArray:
    """Return the queries of a schedule that ignores observations, shape (horizon, G)."""
    interface = make_interface(config)
    steps = np.arange(config.horizon_steps)
    size = interface.observations.space.shape[0]
    schedule = SCHEDULES.find(name)(interface)
    queried: BoolArray = schedule.select(steps, np.zeros((len(steps), size), dtype=np.float32))
    return queried


class Planner:
    """Plans an attack by what vehicles would tell in a typical episode.

    One vehicle more or less hardly changes the public numbers of an episode, nor does the noise.

    Attributes:
        config: The configuration under attack.
        replaces: Whether adjacent records differ in a vehicle replaced by another, or in one more.
        is_event: Whether a single second of a trip is protected, not the trip.
    """

    def __init__(self, config: EnvConfig) -> None:
        """Make the release model."""
        self.config = config
        self.replaces = getattr(config.privacy, "adjacency", "replace") == "replace"
        self.is_event = getattr(config.privacy, "unit", "trip") == "event"
        self._release, corridor = make_release(config), config.corridor
        self._is_whole = self._release.task.is_whole
        self._queries = queries = self._release.task.queries
        # The query to ask for each segment, shape (n_mainline,): the cheapest.
        self._query = np.argmin(np.where(queries.covers.T, queries.cost, math.inf), axis=1)
        ledgers = getattr(self._release, "ledgers", None)
        terms = Terms(np.full(1, math.inf)) if ledgers is None else ledgers.terms
        self._clip, self._fastest = terms.clip, float(terms.fastest)
        self._budget = float(terms.budget[0])
        # Where all seconds cost the same, the number of those that count.
        self._cap = int(min(self._budget, config.horizon_steps))
        self._limits = corridor.road.limits
        # Record columns that are observed without a query.
        boundaries = range(
            corridor.geometry.n_segments,
            corridor.geometry.n_cells,
        )
        is_private = config.privacy.boundary == "private"
        self._always = [*corridor.fixed_sensors, *(boundaries if is_private else ())]
        self._seconds = np.arange(1, config.horizon_steps + 1)
        self._terms: tuple[FloatArray, FloatArray] | None = None

    # Targets ------------------------------------------------------------------------------------

    @property
    def kinds(self) -> tuple[str, ...]:
        """Those of `KINDS` that go with the adjacency and the groups of channels."""
        kinds = KINDS if self._is_whole else ("worst-case",)
        return tuple(kind for kind in kinds if self.replaces or kind != "replaced")

    def require_kind(self, kind: str) -> None:
        """Refuse a target that is none of `kinds`.

        Raises:
            ValueError: See above.
        """
        require(kind in self.kinds, "target", f"one of {list(self.kinds)} here", kind)

    def choose(self, record: Record, kind: str) -> Worlds:
        """Return the two worlds of a kind that a hunter distinguishes best.

        Args:
            record: The traffic.
            kind: ``deleted``, a vehicle of the record is there or not; ``replaced``, one of two
                vehicles of the record is there; ``worst-case``, a vehicle is added that stands
                still, and in the other world stands elsewhere, drives by as fast as can be or is
                absent, whichever is worst under the adjacency.

        Raises:
            ValueError: It is none of `kinds`, or the record holds too few vehicles.
        """
        self.require_kind(kind)
        if kind == "worst-case":
            worlds = self._made_up(record)
        else:
            worlds = self._of_record(record, alone=kind == "deleted")
        return max(worlds, key=self._reached) if len(worlds) > 1 else worlds[0]

    def _made_up(self, record: Record) -> list[Worlds]:
        """Return worlds that differ in made-up vehicles."""
        here, *others = self._places(record)
        there = next(each for each in others if self._query[each] != self._query[here])
        stands = Trajectory.constant(self._seconds, here, 0.0)
        added = f"an added vehicle that stands on segment {here}"
        if not self.replaces:
            pair = stands, Trajectory.absent()
            return [self._worlds(record, pair, f"{added}, or none in its place")]
        pair = stands, Trajectory.constant(self._seconds, there, 0.0)
        found = [self._worlds(record, pair, f"{added}, or on segment {there} instead")]
        if self._is_whole:
            name = "an added vehicle that stands, or one in its place at the speed limit"
            found.append(self._worlds(record, self._opposite(record), name))
        return found

    def _of_record(self, record: Record, *, alone: bool) -> list[Worlds]:
        """Return worlds in which the best vehicle is replaced by others, or by none."""
        ranked = self.rank(record)
        need, n = 1 if alone else 2, len(ranked)
        require(n >= need, "traffic", f"a record of {need} observable vehicles", n)
        first = int(ranked[0])
        vehicle, rest = Trajectory.from_record(record, first), record.without(first)
        name = f"vehicle {first} of the record"
        if alone:
            pair = vehicle, Trajectory.absent()
            return [self._worlds(rest, pair, f"{name}, or none in its place")]
        others = np.unique(ranked[np.geomspace(1, n - 1, SHORTLIST).astype(int)]).tolist()
        return [
            self._worlds(
                rest.without(other),
                (vehicle, Trajectory.from_record(record, other)),
                f"{name}, or vehicle {other} instead",
            )
            for other in others
        ]

    def rank(self, record: Record) -> IntArray:
        """Return observable vehicles by what they tell."""
        rows = np.flatnonzero(self._observable(record)[record.step, record.segment])
        rows = rows[np.lexsort((record.step[rows], record.vehicle[rows]))]
        step, segment = (column[rows].astype(np.int64) for column in (record.step, record.segment))
        speed = record.speed[rows].astype(np.float64)
        moves = self.moves(record, Trajectory(step, segment, speed), is_in_record=True)
        squares = np.sum(moves**2, axis=1)
        always = np.isin(segment, self._always)
        vehicles, starts = np.unique(record.vehicle[rows].astype(np.int64), return_index=True)
        trips = [slice(*ends) for ends in pairwise([*starts.tolist(), len(rows)])]
        asked = np.array([squares[trip].sum() for trip in trips])
        told = np.array([self._reach(squares[trip], always[trip]) for trip in trips])
        best: IntArray = vehicles[np.lexsort((-asked, -told))]
        return best

    def _reach(self, squares: FloatArray, always: BoolArray) -> float:
        """Return the squared distance that the seconds of a trip can reach together."""
        if self.is_event:
            return float(squares.max())
        if self._release.has_prices:
            return min(float(squares.sum()), self._budget)
        return plan_contributions(squares, always, self._cap)[0]

    def _places(self, record: Record) -> list[int]:
        """Return the segments on which a made-up vehicle stands, the best first.

        Those without a sensor and with few others come first: there, a vehicle moves the mean
        speed most. With two groups of channels sensors come first, where both see the vehicle.
        """
        corridor = self.config.corridor
        load = record.counts[:, : corridor.geometry.n_mainline].sum(axis=0)
        fixed = np.isin(np.arange(corridor.geometry.n_mainline), corridor.fixed_sensors)
        quiet: list[int] = np.lexsort((load, fixed)).tolist()
        if self._is_whole:
            return quiet
        sensors = [each for each in corridor.fixed_sensors if each < corridor.geometry.n_mainline]
        return list(dict.fromkeys([*sensors[-1:], *sensors, *quiet]))

    def _opposite(self, record: Record) -> Pair:
        """Return two vehicles whose deviations from the centre are as opposite as can be.

        They are on the road in the better half of the seconds: where the centre is near the speed
        limit, both are below it or at it.
        """
        limit, places = (
            self.config.corridor.geometry.largest_speed_limit,
            np.array(self._places(record)),
        )
        _, centre = self._typical(record)
        centres = centre[self._seconds - 1][:, places]
        centres = np.nan_to_num(centres, nan=0.5 * limit)
        products = np.minimum(limit - centres, self._clip) * np.minimum(centres, self._clip)
        seen = self._observable(record)[self._seconds][:, places]
        products = np.where(seen, products, -1.0)
        best = products.max(axis=1)
        chosen = best >= np.median(best)
        seconds, segments = self._seconds[chosen], places[np.argmax(products, axis=1)[chosen]]
        still = np.zeros(len(seconds))
        slow, fast = (Trajectory(seconds, segments, still + speed) for speed in (0.0, limit))
        return slow, fast

    def _worlds(self, rest: Record, pair: Pair, description: str) -> Worlds:
        """Return two worlds that differ as far as is protected.

        For the unit ``event`` that is the second of the two trajectories that tells most.
        """
        if self.is_event:
            total = np.zeros(rest.n_steps)
            for vehicle in pair:
                np.add.at(total, vehicle.step, np.sum(self.moves(rest, vehicle) ** 2, axis=1))
            best = int(np.argmax(total))
            pair = pair[0].only(pair[0].step == best), pair[1].only(pair[1].step == best)
        if self.config.corridor.loops is not None:
            description = f"the reports of {description}"
        return Worlds.adjacent(rest, pair, description)

    def _reached(self, worlds: Worlds) -> float:
        """Return the mean distance that a hunter reaches between two worlds in some runs."""
        runs = attack(self.config, worlds, self.plan(worlds), REHEARSALS, progress=False)
        return float(runs.distances.mean())

    # Queries ------------------------------------------------------------------------------------

    def plan(self, worlds: Worlds) -> BoolArray:
        """Return the queries of a hunter, shape (horizon, G).

        He follows the vehicle in both worlds, and queries it in the seconds that tell most,
        within the bandwidth; and after them, when a ledger should refuse it.
        """
        config, cost, bandwidth = self.config, self._queries.cost, self.config.bandwidth
        plan = np.zeros((config.horizon_steps, len(cost)), dtype=bool)
        candidates, left = [], []
        for world in (0, 1):
            seconds, budget = self._worthwhile(worlds, world)
            candidates += seconds
            left.append(budget)

        def ask(step: int, query: int) -> bool:
            # Where both trajectories meet, one query serves both.
            plan[step, query] |= cost[plan[step]].sum() + cost[query] <= bandwidth
            return bool(plan[step, query])

        for _, step, segment, world in sorted(candidates):
            if left[world] and ask(step, self._query[segment]):
                left[world] -= 1
        # Ledgers are spent by then, and should refuse the rest.
        spent = int(np.flatnonzero(plan.any(axis=1)).max(initial=-1))
        for _, step, segment, _ in candidates:
            if step > spent:
                ask(step, self._query[segment])
        if self._release.has_prices and self._is_whole:
            # What is left of the bandwidth goes round all segments. That keeps the estimator, and
            # so centres and prices, as they are in a typical episode.
            for queried, offered in zip(plan, public_plan(config, "round-robin"), strict=True):
                more = np.flatnonzero(offered & ~queried)
                queried[more[cost[queried].sum() + np.cumsum(cost[more]) <= bandwidth]] = True
        return plan

    def _worthwhile(self, worlds: Worlds, world: int) -> tuple[list[Second], int]:
        """Return the seconds in which to query a world's vehicle, and how many of them suffice.

        Those of the least cost are taken first.
        """
        vehicle = worlds.pair[world]
        seen = self._observable(worlds.rest)[vehicle.step, vehicle.segment]
        always = np.isin(vehicle.segment, self._always)
        if self._release.has_prices or not self._is_whole:
            # A vehicle tells as much as it pays, or is seen twice: queries need not be saved.
            # Where the bandwidth does not suffice for both vehicles, it serves them by turns.
            on_mainline = vehicle.segment < self.config.corridor.geometry.n_mainline
            chosen = vehicle.only(seen & (~always if self._is_whole else on_mainline))
            costs, n_queries = ((chosen.step - 1 + world) % 2).astype(float), len(chosen.step)
        else:
            squares, seen_always = self._squares_in(worlds, world)[seen], always[seen]
            _, n_queries, stop = plan_contributions(squares, seen_always, self._cap)
            costs = np.where(np.arange(len(squares)) < stop, -squares, 0.0)[~seen_always]
            chosen = vehicle.only(seen).only(~seen_always)
        columns = costs.tolist(), (chosen.step - 1).tolist(), chosen.segment.tolist()
        return [(*second, world) for second in zip(*columns, strict=True)], n_queries

    def _squares_in(self, worlds: Worlds, world: int) -> FloatArray:
        """Return what each second of a trajectory tells, (m,); half of it where both meet."""
        vehicle, other = worlds.pair[world], worlds.pair[1 - world]
        moves, against = (self.moves(worlds.rest, each) for each in (vehicle, other))
        squares: FloatArray = np.sum(moves**2, axis=1)
        _, here, there = np.intersect1d(
            vehicle.step, other.step, assume_unique=True, return_indices=True
        )
        meet = vehicle.segment[here] == other.segment[there]
        here, there = here[meet], there[meet]
        squares[here] = 0.5 * np.sum((moves[here] - against[there]) ** 2, axis=1)
        return squares

    # What a vehicle tells -----------------------------------------------------------------------

    def moves(
        self, record: Record, vehicle: Trajectory, *, is_in_record: bool = False
    ) -> FloatArray:
        """Return by how much a vehicle moves the releases that it is in, second by second.

        Density, and mean speed or flow, in units of the noise, shape (m, 2); zeros for the seconds
        that nobody can observe.

        Args:
            record: The traffic.
            vehicle: The vehicle; or rows of several, each of which is looked at by itself.
            is_in_record: Whether the record holds it already.
        """
        (scale, centre), moves = self._typical(record), np.zeros((len(vehicle.step), 2))
        seen = self._observable(record)[vehicle.step, vehicle.segment]
        step, segment, speed = vehicle.step[seen], vehicle.segment[seen], vehicle.speed[seen]
        if self._release.task.releases_flow:
            change = np.clip(speed, 0.0, self._fastest) - centre[step - 1, segment]
            change = np.clip(change, -self._clip, self._clip)
        else:
            others = record.counts[step, segment] - is_in_record
            total = record.speed_sums[step, segment] - is_in_record * speed
            # An empty segment has the limit.
            limit = self._limits[segment]
            without = np.where(others > 0, total / np.maximum(others, 1), limit)
            change = (total + speed) / (others + 1) - without
        moves[seen] = scale[step - 1, segment]
        moves[seen, 1] *= change
        return moves

    def _typical(self, record: Record) -> tuple[FloatArray, FloatArray]:
        """Return `public_terms` of an episode over the first record that was asked for."""
        if self._terms is None:
            plan = public_plan(self.config, "round-robin")
            self._terms = public_terms(self.config, record, plan)
        return self._terms

    def _observable(self, record: Record) -> BoolArray:
        """Return flags of record columns that can be observed, (n_steps, n_columns)."""
        observed = np.zeros((record.n_steps, record.n_columns), dtype=bool)
        seconds = slice(1, self.config.horizon_steps + 1)
        observed[seconds, : self.config.corridor.geometry.n_mainline] = True
        observed[seconds, self._always] = True
        return observed


def public_terms(
    config: EnvConfig, record: Record, plan: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Play an episode over a record, and return how far vehicles would move its releases.

    Args:
        config: The configuration.
        record: The traffic.
        plan: Queries, shape (T, G).

    Returns:
        By how much one vehicle more, and 1 km/h more in the sum or mean of speeds, moves the
        release of each place, in units of the noise, shape (T, places, 2); and the centres of
        speeds [km/h], shape (T, places), NaN where mean speeds are released.
    """
    alike = Worlds.adjacent(record, (Trajectory.absent(), Trajectory.absent()))
    played = overheard(config, alike, np.zeros(1, int), plan, [np.random.default_rng(0)])
    rows = []
    for release in played:
        rows.append((release.last.sigma[0].copy(), release.last.centre[0].copy()))
    sigma, centre = (np.array(column) for column in zip(*rows, strict=True))
    task = release.task
    if task.releases_flow:
        sigma = sigma * task.channels.length[:, None]
    else:
        sigma = sigma * np.stack([task.channels.length, np.ones_like(task.channels.length)], axis=1)
    # Of several queries that cover a place each tells the mean of what they tell; groups add up.
    alike_columns = task.channels.group[:, None] == task.channels.group
    share = task.covers / np.maximum(alike_columns.astype(float) @ task.covers, 1.0)
    squares = np.einsum("tcq,cp->tpq", sigma**-2.0, share)
    return np.sqrt(squares), centre


def plan_contributions(squares: FloatArray, always: BoolArray, cap: int) -> tuple[float, int, int]:
    """Return how a vehicle that counts in its first `cap` observed seconds tells most.

    Args:
        squares: Squared distances of its seconds in order, shape (m,).
        always: Flags of seconds that are observed without a query, shape (m,).
        cap: Most seconds that count.

    Returns:
        The sum of the squares that count; the number of other seconds to query; and the index
        before which these must lie: later ones would be counted only after seconds that tell less.
    """
    if cap >= len(squares):
        return float(squares.sum()), cap, len(squares)
    fixed = np.flatnonzero(always)
    options = []
    # With the first n such seconds counted, all queries have to come before the next of them.
    for n in range(min(len(fixed), cap) + 1):
        stop = int(fixed[n]) if n < len(fixed) else len(squares)
        free = np.sort(squares[:stop][~always[:stop]])[::-1][: cap - n]
        options.append((float(squares[fixed[:n]].sum() + free.sum()), cap - n, stop))
    return max(options)
