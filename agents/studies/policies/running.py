"""Runs entries: all traffic seeds of a policy in a cell at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.evaluation.episodes import EpisodeScore, Policy, make_vector, run_episodes
from agents.evaluation.policies import Saved
from agents.experiments.ledger import Ledger
from agents.experiments.runner import void_on_purpose
from agents.studies.policies.manifest import Manifest
from agents.studies.policies.plan import DETERMINISTIC, Cell, Design, Entry
from agents.studies.policies.queries import Asked, Watch
from dptse_env.config import EnvConfig
from dptse_env.policies import TRANSFERABLE
from dptse_env.schedules import make_schedule
from dptse_env.vector_env import SensorQueryVectorEnv

POLICY_SEED = 0
"""Seeds what a schedule draws, and torch where a learned policy draws."""


@dataclass(frozen=True)
class Task:
    """An entry on traffic seeds, with everything that a worker needs.

    Attributes:
        cell: The entry.
        env: Environment id.
        keywords: Keywords of ``gym.make_vec``.
        seeds: Traffic seeds.
        noise: Noise is seeded with this plus the traffic seed.
        saved: The learned policy; None for a schedule.
        moved: Whether it acts in a cell that it was not trained for.
        records: Folder of the record cache; None for the user's cache.
        threads: Threads that estimate; None for one per core.
    """

    cell: Entry
    env: str
    keywords: Mapping[str, Any]
    seeds: tuple[int, ...]
    noise: int
    saved: Saved | None
    moved: bool
    records: str | None
    threads: int | None

    def make(self) -> tuple[SensorQueryVectorEnv, Policy]:
        """Make the environment, an episode for each traffic seed, and the policy in it.

        Raises:
            ValueError: A keyword is out of range, or the policy does not suit.
        """
        env = make_batch(self.env, self.keywords, self.seeds, self.records, self.threads)
        if self.saved is None:
            return env, make_schedule(self.cell.policy, env, POLICY_SEED)
        # Another incident is another corridor to `load_policy`. What it sees and how it acts must
        # be the same all the same.
        return env, self.saved.load(env, allow=TRANSFERABLE if self.moved else ())


def make_batch(
    env: str,
    keywords: Mapping[str, Any],
    seeds: Sequence[int],
    records: str | None = None,
    threads: int | None = 1,
) -> SensorQueryVectorEnv:
    """Make a vector environment for `run_episodes`, one episode for each traffic seed.

    Raises:
        ValueError: A keyword is unknown or out of range.
    """
    with void_on_purpose():
        more = {"traffic_seeds": list(seeds), "records": records, "threads": threads}
        return make_vector(env, len(seeds), {**keywords, **more})


def config_of(cell: Cell, seeds: Sequence[int]) -> EnvConfig:
    """Return the configuration of a cell.

    Raises:
        ValueError: A keyword is unknown or out of range.
    """
    return make_batch(cell.env, cell.keywords, seeds).config


def run_entry(task: Task) -> list[EpisodeScore]:
    """Run an entry on all its seeds."""
    env, policy = task.make()
    return _run(task, env, policy)


def watch_entry(task: Task) -> list[Asked]:
    """Run an entry and return whom it asked."""
    env, policy = task.make()
    watch = Watch(env.process, task.seeds)
    _run(task, env, policy, watch)
    return watch.asked()


def _run(
    task: Task, env: SensorQueryVectorEnv, policy: Policy, watch: Watch | None = None
) -> list[EpisodeScore]:
    if task.saved is not None:
        import torch  # noqa: PLC0415 (schedules alone do without)

        torch.manual_seed(POLICY_SEED)
    return run_episodes(
        env,
        policy,
        traffic_seeds=task.seeds,
        seeds=[task.noise + seed for seed in task.seeds],
        deterministic=task.cell.mode == DETERMINISTIC,
        on_second=watch,
    )


def make_task(
    entry: Entry,
    design: Design,
    manifest: Manifest,
    *,
    seeds: Sequence[int],
    noise: int,
    records: str | None = None,
    threads: int | None = None,
) -> Task:
    """Return the task of an entry, with the policy that was frozen and the settings it brings.

    Raises:
        FileNotFoundError: The file of a frozen policy is gone.
        ValueError: It is not the file that was frozen.
    """
    cell = design.cell(entry.cell)
    keywords = dict(cell.keywords)
    settings = manifest.settings(entry.policy, config_of(cell, seeds))
    if settings is not None:
        keywords["estimator_settings"] = settings
    saved = None
    if entry.kind == "learned":
        checkpoint = manifest.checkpoint(entry)
        saved, keywords["action"] = checkpoint.saved(), checkpoint.action
    moved = entry.trained_in not in ("", entry.cell)
    return Task(entry, cell.env, keywords, tuple(seeds), noise, saved, moved, records, threads)


def lacking(
    entries: Sequence[Entry], seeds: Sequence[int], ledger: Ledger[Entry, Any]
) -> list[Entry]:
    """Return the entries of which the ledger lacks a seed; they are run whole again."""
    return [entry for entry in entries if any((entry, seed) not in ledger.rows for seed in seeds)]


def suited(cell: Cell, names: Sequence[str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the schedules that can be run in a cell, and why the others cannot.

    Raises:
        ValueError: The cell itself is out of range.
    """
    env = make_batch(cell.env, cell.keywords, (0,))
    env.process  # noqa: B018 (assembled here, so that what fails below is the schedule's)
    fit, others = [], {}
    for name in names:
        try:
            make_schedule(name, env, POLICY_SEED)
        except ValueError as problem:
            others[name] = str(problem)
        else:
            fit.append(name)
    return tuple(fit), others


def mean_error(ledger: Ledger[Entry, EpisodeScore], entry: Entry, seeds: Sequence[int]) -> float:
    """Return the mean error of an entry over the seeds: minus the environment's reward."""
    return float(np.mean([-ledger.rows[entry, seed].reward for seed in seeds]))
