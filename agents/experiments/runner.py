"""Run the episodes of a design that its ledger lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic

import gymnasium as gym

from agents.engines.engine import Engine
from agents.environments import make_vector, quietly
from agents.evaluation.episodes import EpisodeScore, run_episode
from agents.experiments.cells import CellT, Design
from agents.experiments.ledger import Ledger
from dptse_env.schedules import make_schedule
from dptse_env.traffic import Corridor, RecordLibrary, Records
from dptse_env.vector_env import SensorQueryVectorEnv


@dataclass(frozen=True)
class Workplace:
    """Folder and engine of a study.

    Attributes:
        cache: Folder of the record cache; None for the user's cache.
    """

    folder: Path
    engine: Engine
    cache: str | None = None

    @cached_property
    def records(self) -> RecordLibrary:
        """The library of records, which tasks take along."""
        return self.engine.shared(RecordLibrary(self.cache))

    @property
    def threads(self) -> int | None:
        """Threads of each task: 1 where tasks share a machine; None for one per core."""
        return 1 if self.engine.is_parallel else None

    def record(self, corridor: Corridor, seeds: Sequence[int]) -> None:
        """Record the traffic that is missing."""
        self.engine.record(RecordLibrary(self.cache), corridor, seeds, progress=True)


@dataclass(frozen=True)
class EpisodeTask(Generic[CellT]):
    """A cell on some traffic seeds.

    Attributes:
        keywords: Keywords of ``gym.make`` that make it.
        records: Library of records.
    """

    env: str
    schedule: str
    cell: CellT
    keywords: Mapping[str, Any]
    seeds: tuple[int, ...]
    records: Records


def make_env(
    env: str, keywords: Mapping[str, Any], seeds: Sequence[int], records: Records
) -> gym.Env[Any, Any]:
    """Make an environment for `run_episode`.

    Raises:
        ValueError: A keyword is unknown or out of range.
    """
    seeded: dict[str, Any] = {"traffic_seeds": list(seeds), "records": records}
    with quietly():
        return gym.make(env, disable_env_checker=True, **seeded, **keywords)


def make_batch(
    env: str,
    keywords: Mapping[str, Any],
    seeds: Sequence[int],
    records: Records = None,
    threads: int | None = 1,
) -> SensorQueryVectorEnv:
    """Make a vector environment for `run_episodes`, one episode for each traffic seed.

    Raises:
        ValueError: A keyword is unknown or out of range.
    """
    more = {"traffic_seeds": list(seeds), "records": records, "threads": threads}
    with quietly():
        return make_vector(env, len(seeds), {**keywords, **more})


def run_task(task: EpisodeTask[Any]) -> list[EpisodeScore]:
    """Run a cell on its seeds; a seed gives the traffic and the noise, so cells are paired."""
    env = make_env(task.env, task.keywords, task.seeds, task.records)
    schedule = make_schedule(task.schedule, env)
    return [run_episode(env, schedule, traffic_seed=seed, seed=seed) for seed in task.seeds]


def missing_tasks(
    design: Design[CellT], ledger: Ledger[CellT, EpisodeScore], records: Records
) -> list[EpisodeTask[CellT]]:
    """Return the episodes that a ledger lacks, one task a cell."""
    lacking = {cell: ledger.lacking(cell, design.traffic_seeds) for cell in design.cells()}
    return [
        EpisodeTask(design.env, design.schedule, cell, design.keywords(cell), seeds, records)
        for cell, seeds in lacking.items()
        if seeds
    ]
