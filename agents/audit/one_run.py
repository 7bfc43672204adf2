"""An attack in one run: many vehicles, each with a coin, and one transcript of all of them.

Time is cut into slots of equal length. In a slot, queries that share no segment have one
canary each, a vehicle that is on the road in this slot alone: so no number of a release depends on
two of them. Its coin says whether it stands or drives at the speed limit, or, with a pair of
queries, on which of the two it stands. Where vehicles are added or removed, it stands or is not
there. They are made as often as the bandwidth allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, ndtri

from agents.audit.attack import overheard
from agents.audit.planner import Planner
from agents.audit.statistics import error_bound
from agents.audit.worlds import Trajectory, Worlds
from dptse_env.config import EnvConfig
from dptse_env.parts import make_task
from dptse_env.release import Task
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

KINDS = {
    "elsewhere": "stands on one segment, or on another",
    "fast": "stands, or drives at the speed limit",
    "absent": "stands, or is not there",
}
"""The two ways of a canary between which its coin decides."""

RATIO = 1.3
"""Ratio of the lengths of slots that are tried."""

FEWEST = 8
"""Fewest canaries of a design that is tried; without any error, they show a mu of 1."""

RISK = 0.05
"""Risk of the bounds by which a length is chosen."""


@dataclass(frozen=True)
class Design:
    """Canaries and queries of one run.

    Attributes:
        kind: What a coin decides, one of `KINDS`.
        slot: Length of a slot [s].
        canaries: Trajectory of each of the n canaries by its coin.
        plan: Queries of each step, shape (horizon, G).
        owner: The canary that a channel may tell of, by step, shape (horizon, C); n
            where there is none.
    """

    kind: str
    slot: int
    canaries: list[tuple[Trajectory, Trajectory]]
    plan: BoolArray
    owner: IntArray

    @property
    def n(self) -> int:
        """Number of canaries n."""
        return len(self.canaries)

    def with_coins(self, coins: IntArray) -> list[Trajectory]:
        """Return the trajectories of all canaries by their coins, shape (n,)."""
        return [pair[coin] for pair, coin in zip(self.canaries, coins.tolist(), strict=True)]

    def by_canary(self, heard: FloatArray) -> FloatArray:
        """Return the sums for each canary, (n,), of what channels tell, shape (horizon, C)."""
        sums = np.zeros(self.n + 1)
        np.add.at(sums, self.owner, heard)
        return sums[: self.n]


@dataclass(frozen=True)
class OneRun:
    """An adversary's scores of one run with n canaries.

    Attributes:
        design: Canaries and queries.
        coins: The canaries' coins, shape (n,).
        scores: Log-likelihood ratio of coin 1 of each canary, shape (n,).
        distances: Distance that its coin moved the true sums, in units of the noise, shape (n,).
    """

    design: Design
    coins: IntArray
    scores: FloatArray
    distances: FloatArray

    @property
    def expected_errors(self) -> float:
        """Expected number of wrong guesses."""
        return float(ndtr(-0.5 * self.distances).sum())

    @property
    def distance(self) -> float:
        """The distance at which equal canaries would expect as many errors."""
        equal = -2.0 * float(ndtri(self.expected_errors / self.design.n))
        # Where no errors are expected at all.
        return min(equal, float(self.distances.max()))


def make_design(config: EnvConfig, slot: int, kind: str) -> Design:
    """Return the canaries of the slots of a length [s] that fit into an episode.

    Args:
        config: The configuration under attack.
        slot: Length of a slot.
        kind: What a coin decides, one of `KINDS`; ``elsewhere`` takes two queries that share no
            segment.
    """
    task, size = make_task(config), 2 if kind == "elsewhere" else 1
    queries, sites = task.queries, apart(task)
    sites = sites[: len(sites) // size * size]
    at_once = int(np.count_nonzero(np.cumsum(queries.cost[sites]) <= queries.bandwidth))
    # Where only one query can be paid for, the two queries of a pair take turns.
    n_used = max(at_once // size * size, size)
    canaries: list[tuple[Trajectory, Trajectory]] = []
    plan = np.zeros((config.horizon_steps, queries.n_queries), dtype=bool)
    owner = np.full((config.horizon_steps, task.n_channels), -1)
    for first in range(0, config.horizon_steps - slot + 1, slot):
        seconds = np.arange(first, first + slot)
        used = sites[(first // slot * n_used + np.arange(n_used)) % len(sites)]
        turns = (seconds[:, None] + np.arange(min(at_once, n_used))) % n_used
        plan[seconds[:, None], used[turns]] = True
        for pair in used.reshape(-1, size):
            covered = task.covers[:, task.covers[pair].any(axis=0)].any(axis=1)
            owner[first : first + slot, covered] = len(canaries)
            stands, elsewhere = (
                Trajectory.constant(seconds + 1, int(task.channels.first[each]), 0.0)
                for each in (pair[0], pair[-1])
            )
            fast = np.full(slot, config.corridor.geometry.largest_speed_limit)
            other = {
                "elsewhere": elsewhere,
                "fast": replace(stands, speed=fast),
                "absent": Trajectory.absent(),
            }[kind]
            canaries.append((stands, other))
    owner[~task.observed(plan) | (owner < 0)] = len(canaries)
    return Design(kind, slot, canaries, plan, owner)


def apart(task: Task) -> IntArray:
    """Return queries that share no segment; the cheapest come first."""
    taken, sites = np.zeros(task.n_cells, dtype=bool), []
    for query in np.argsort(task.queries.cost, kind="stable").tolist():
        covered = task.covers[query]
        if not (covered & taken).any():
            taken |= covered
            sites.append(query)
    return np.array(
        sorted(sites, key=lambda query: int(task.channels.first[query])), dtype=np.int64
    )


def attack_in_one_run(
    config: EnvConfig, record: Record, *, noise_factor: float = 1.0, seed: int = 0
) -> OneRun:
    """Throw coins, play one episode, and score the coins of all canaries.

    Slots are as long as lets errors bound mu best, by the distances in rehearsals on noise and
    coins of their own.

    Args:
        config: The configuration under attack.
        record: The other vehicles.
        noise_factor: Multiplies the noise that the configuration declares.
        seed: Seeds coins and noise, >= 0.

    Raises:
        ValueError: The adversary does not know the distribution of the noise.
    """
    rehearsal, run = np.random.default_rng(seed).spawn(2)
    tried = [
        each
        for designs in _designs(config)
        for each in _play(config, record, designs, noise_factor, rehearsal)
    ]
    # The lower the bound on the rate of errors, the higher that on mu.
    best = min(tried, key=lambda each: error_bound(each.expected_errors, each.design.n, RISK))
    return _play(config, record, [best.design], noise_factor, run)[0]


def _designs(config: EnvConfig) -> list[list[Design]]:
    """Return the designs to try, by kinds; slots of a second where that is what is protected."""
    planner = Planner(config)
    longest = 1 if planner.is_event else config.horizon_steps
    n = int(np.log(longest) / np.log(RATIO)) + 1
    slots = np.unique(np.rint(RATIO ** np.arange(n)).astype(int)).tolist()
    kinds = ["fast"] if planner.replaces else ["absent"]
    if planner.replaces and len(apart(make_task(config))) > 1:
        kinds.append("elsewhere")
    designs = [[make_design(config, slot, kind) for slot in slots] for kind in kinds]
    return [[each for each in row if each.n >= FEWEST] or row[:1] for row in designs]


def _play(
    config: EnvConfig,
    record: Record,
    designs: Sequence[Design],
    noise_factor: float,
    generator: np.random.Generator,
) -> list[OneRun]:
    """Play an episode of each design."""
    coins = [generator.integers(2, size=design.n) for design in designs]
    added = [
        design.with_coins(each)
        for design, thrown in zip(designs, coins, strict=True)
        for each in (np.zeros_like(thrown), np.ones_like(thrown), thrown)
    ]
    worlds = np.arange(len(added)).reshape(-1, 3)
    pairs = np.repeat(worlds[:, :2], 3, axis=0)
    plan = np.stack([design.plan for design in designs], axis=1)
    streams = generator.spawn(len(designs))
    played = overheard(
        config, Worlds(record, added, pairs), worlds[:, 2], plan, streams, noise_factor
    )
    heard = np.array([release.heard for release in played])
    return [
        OneRun(
            design,
            thrown,
            design.by_canary(heard[:, 0, k]),
            np.sqrt(design.by_canary(heard[:, 1, k])),
        )
        for k, (design, thrown) in enumerate(zip(designs, coins, strict=True))
    ]
