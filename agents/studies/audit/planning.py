"""Plans of an adversary before an attack: vehicles that tell much, and seconds to query them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from agents.studies.audit.attack import attack
from agents.studies.audit.distances import replaces
from agents.studies.audit.strategies import (
    PUBLIC_SCHEDULES,
    AdaptiveQueries,
    FixedQueries,
    always_observed,
    public_plan,
)
from agents.studies.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.config import EnvConfig
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.validation import require

Pair = tuple[Trajectory, Trajectory]
Second = tuple[float, int, int, int]  # a cost, a step, a segment and the world it is queried for


class Planner(ABC):
    """Plans an attack on a release model.

    Attributes:
        kinds: Kinds of targets that it knows.
        made_up_kinds: Those whose vehicles are made up.
        config: The configuration under attack.
        policy: Name of the policy, in `STRATEGIES`.
    """

    kinds: ClassVar[tuple[str, ...]]
    made_up_kinds: ClassVar[tuple[str, ...]] = ("worst-case",)

    def __init__(self, config: EnvConfig, policy: str) -> None:
        """Plan for a configuration and a policy."""
        self.config, self.policy = config, policy

    @abstractmethod
    def rank(self, record: Record, kind: str) -> IntArray:
        """Return the observable vehicles of a record, those that suit a kind best first."""

    @abstractmethod
    def gains(self, rest: Record, vehicle: Trajectory) -> FloatArray:
        """Return what each second of a vehicle that is added to a record tells, shape (m,)."""

    @abstractmethod
    def made_up(self, record: Record, kind: str) -> Mapping[str, Pair]:
        """Return pairs of made-up trajectories of a kind, by the difference in words."""

    def reached(self, worlds: AdjacentWorlds) -> float:
        """Return the distance that the policy reaches between two worlds, about.

        It is that of one episode in each world.
        """
        queries = FixedQueries(self.plan(worlds))
        return float(attack(self.config, worlds, queries, 1, progress=False).distances.max())

    @abstractmethod
    def worthwhile(self, worlds: AdjacentWorlds, world: int) -> tuple[list[Second], int]:
        """Return the seconds in which to query a world's vehicle, and how many of them to take.

        Those of the least cost are taken first.
        """

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
        config, corridor = self.config, self.config.corridor
        seconds = slice(1, config.horizon_steps + 1)
        observed = np.zeros((record.n_steps, record.n_columns), dtype=bool)
        is_public = self.policy in PUBLIC_SCHEDULES
        queried = public_plan(config, self.policy) if is_public else True
        observed[seconds, : corridor.n_mainline] = queried
        observed[seconds, always_observed(config)] = True
        return observed

    def queryable(self, vehicle: Trajectory) -> BoolArray:
        """Return flags of a vehicle's seconds that an episode can release, shape (m,)."""
        seen = (vehicle.step >= 1) & (vehicle.step <= self.config.horizon_steps)
        always = np.isin(vehicle.segment, always_observed(self.config))
        flags: BoolArray = seen & (always | (vehicle.segment < self.config.corridor.n_mainline))
        return flags

    def quiet_segments(self, record: Record) -> list[int]:
        """Return the mainline segments, those without a sensor and with few vehicles first."""
        corridor = self.config.corridor
        load = record.counts[:, : corridor.n_mainline].sum(axis=0)
        fixed = np.isin(np.arange(corridor.n_mainline), corridor.fixed_sensors)
        segments: list[int] = np.lexsort((load, fixed)).tolist()
        return segments

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
