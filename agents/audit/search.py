"""A search for the worst pair of trips and the queries that tell them apart, from random ones.

It knows nothing of release models but the distance that they show: the larger one of a pair and its
mutation is kept. So it finds what a planner that knows the proof would not look for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from agents.audit.attack import overheard
from agents.audit.planner import PUBLIC_SCHEDULES, Planner, public_plan, random_plan
from agents.audit.worlds import AdjacentWorlds, Trajectory, Worlds
from agents.executors import Executor, run_in_order, this_process
from dptse_env.config import EnvConfig
from dptse_env.parts import make_task
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.validation import integer

CLIMBED = "climbed"
"""Name of the target that a search finds."""

CLIMBERS = 32
"""Pairs that are climbed from at once, in one process."""

HERDS = 4
"""Sets of climbers, each in a process of its own."""


@dataclass(frozen=True)
class Pair:
    """Two trips and the queries of an episode of T seconds.

    Attributes:
        place: Record column of each trip by second, -1 where it is not there, shape (2, T).
        speed: Its speed [km/h], shape (2, T).
        plan: Queries that are made, shape (T, G).
    """

    place: IntArray
    speed: FloatArray
    plan: BoolArray

    @property
    def trips(self) -> tuple[Trajectory, Trajectory]:
        """The trajectories."""
        seconds = [np.flatnonzero(place >= 0) for place in self.place]
        zero, one = (
            Trajectory(at + 1, place[at], speed[at])
            for at, place, speed in zip(seconds, self.place, self.speed, strict=True)
        )
        return zero, one


class Mutations:
    """Random pairs, and random changes to them.

    Attributes:
        config: The configuration under attack.
        plan: Queries that are not to be changed, shape (T, G), or None.
    """

    def __init__(self, config: EnvConfig, plan: BoolArray | None = None) -> None:
        """Find out what can be observed, and how many queries can be paid for."""
        self.config, self.plan = config, plan
        planner, task = Planner(config), make_task(config)
        self._is_event, self._n_trips = planner.is_event, 2 if planner.replaces else 1
        self._queries, self._covers = task.queries, task.covers
        self._places = np.flatnonzero(task.covers.any(axis=0))
        self._fastest = 1.2 * config.corridor.geometry.largest_speed_limit

    def start(self, generator: np.random.Generator) -> Pair:
        """Return a random pair, and random queries."""
        T = self.config.horizon_steps
        pair = Pair(
            np.full((2, T), -1),
            np.zeros((2, T)),
            random_plan(self._queries, T, generator) if self.plan is None else self.plan,
        )
        for _ in range(20):
            pair = self._other_stay(pair, self._window(generator), generator)
        return self._one_second(pair, generator) if self._is_event else pair

    def mutated(self, pair: Pair, generator: np.random.Generator) -> Pair:
        """Return a pair with a change in some seconds, of a trip or of the queries."""
        kind, seconds = generator.integers(4), self._window(generator)
        if kind == 0 and self.plan is None:
            return self._other_queries(pair, seconds, generator)
        if kind == 1:
            return self._other_speed(pair, seconds, generator)
        if self._is_event:
            return self._one_second(pair, generator)
        return self._other_stay(pair, seconds, generator)

    def _window(self, generator: np.random.Generator) -> slice:
        """Return some seconds in succession; short and long ones are alike frequent."""
        T = self.config.horizon_steps
        length = int(np.exp(generator.uniform(0.0, np.log(T))))
        first = int(generator.integers(T - length + 1))
        return slice(first, first + length)

    def _other_stay(self, pair: Pair, seconds: slice, generator: np.random.Generator) -> Pair:
        """Put a trip on another segment, where the other trip is, or off the road."""
        place, speed, trip = pair.place.copy(), pair.speed.copy(), self._trip(generator)
        places = [generator.choice(self._places), place[1 - trip, seconds], -1]
        place[trip, seconds] = places[generator.choice(3, p=[0.6, 0.2, 0.2])]
        speed[trip, seconds] = self._speed(generator)
        return replace(pair, place=place, speed=speed)

    def _other_speed(self, pair: Pair, seconds: slice, generator: np.random.Generator) -> Pair:
        speed = pair.speed.copy()
        speed[self._trip(generator), seconds] = self._speed(generator)
        return replace(pair, speed=speed)

    def _other_queries(self, pair: Pair, seconds: slice, generator: np.random.Generator) -> Pair:
        """Query what sees the trips first, and then anything; or anything at all."""
        plan, at = pair.plan.copy(), np.arange(len(pair.plan))[seconds]
        follows = generator.random((2, 1)) < 0.5
        there = np.where(follows, pair.place[:, at], -1)
        covers = self._covers[: self._queries.n_queries]
        sees = covers[:, there] & (there >= 0)
        first = (sees[:, 0] | sees[:, 1]).T
        plan[at] = random_plan(self._queries, len(at), generator, first)
        return replace(pair, plan=plan)

    def _one_second(self, pair: Pair, generator: np.random.Generator) -> Pair:
        """Put both trips on the road for one second, the same."""
        place, speed = np.full_like(pair.place, -1), pair.speed.copy()
        second = generator.integers(place.shape[1])
        for trip in range(self._n_trips):
            place[trip, second] = generator.choice(self._places)
            speed[trip, second] = self._speed(generator)
        return replace(pair, place=place, speed=speed)

    def _trip(self, generator: np.random.Generator) -> int:
        return int(generator.integers(self._n_trips))

    def _speed(self, generator: np.random.Generator) -> float:
        """Return a speed, often one of the ends of the range."""
        return float(np.clip(generator.uniform(-0.3, 1.3), 0.0, 1.0)) * self._fastest


def climb(
    config: EnvConfig,
    record: Record,
    rounds: int,
    *,
    policy: str = "hunter",
    seed: int = 0,
    executor: Executor = this_process,
) -> tuple[AdjacentWorlds, BoolArray]:
    """Return the worlds and queries of the largest distance that a search reaches.

    Args:
        config: The configuration under attack.
        record: The other vehicles.
        rounds: Mutations of each pair.
        policy: A public schedule, whose queries are kept, or another policy, whose queries are
            searched for as well.
        seed: Seeds the search and the noise, >= 0.
        executor: Runs the search.

    Raises:
        ValueError: The adversary does not know the distribution of the noise.
    """
    integer("rounds", rounds, 0)
    plan = public_plan(config, policy) if policy in PUBLIC_SCHEDULES else None
    herds = run_in_order(
        executor,
        partial(_climb, config, record, rounds, plan, seed),
        list(range(HERDS)),
        desc="climbing",
        unit="herd",
    )
    _, pair = max(herds, key=lambda herd: herd[0])
    description = f"an added vehicle that climbed in {rounds} rounds from a random trip"
    worlds = AdjacentWorlds(record, pair.trips, description)
    return worlds, pair.plan


def _climb(
    config: EnvConfig, record: Record, rounds: int, plan: BoolArray | None, seed: int, herd: int
) -> tuple[float, Pair]:
    """Return the best pair of a set of climbers, and its squared distance."""
    mutations, generator = Mutations(config, plan), np.random.default_rng((seed, herd))
    pairs = [mutations.start(generator) for _ in range(CLIMBERS)]
    squares = squared_distances(config, record, pairs, seed)
    for _ in range(rounds):
        tried = [mutations.mutated(pair, generator) for pair in pairs]
        found = squared_distances(config, record, tried, seed)
        for k in np.flatnonzero(found >= squares):
            pairs[k], squares[k] = tried[k], found[k]
    best = int(np.argmax(squares))
    return float(squares[best]), pairs[best]


def squared_distances(
    config: EnvConfig, record: Record, pairs: Sequence[Pair], seed: int = 0
) -> FloatArray:
    """Return the squared distance that each pair reaches in an episode of its own, shape (k,)."""
    trips = [[trip] for pair in pairs for trip in pair.trips]
    seeds = np.arange(len(trips)).reshape(-1, 2)
    worlds = Worlds(record, trips, np.repeat(seeds, 2, axis=0))
    plan = np.stack([pair.plan for pair in pairs], axis=1)
    streams = [np.random.default_rng((seed, k)) for k in range(len(pairs))]
    *_, release = overheard(config, worlds, seeds[:, 0], plan, streams)
    return release.square
