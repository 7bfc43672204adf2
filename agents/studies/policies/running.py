"""Running entries: all traffic seeds of a policy in a cell at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from agents.evaluation.episodes import EpisodeScore, Policy, run_episodes
from agents.experiments.runner import make_batch
from agents.policies import NamedSchedule, PolicySource, SavedPolicy
from agents.studies.policies.manifest import Manifest
from agents.studies.policies.plan import DETERMINISTIC, Entry, PolicyCell, PolicyDesign
from agents.studies.policies.queries import QueryCounter, QueryCounts
from dptse_env.config import EnvConfig
from dptse_env.policies import TRANSFERABLE
from dptse_env.traffic import Records
from dptse_env.vector_env import SensorQueryVectorEnv

POLICY_SEED = 0
"""Seeds the draws of a schedule, and torch for the draws of a learned policy."""


@dataclass(frozen=True)
class EntryTask:
    """An entry on traffic seeds, with everything that a worker needs.

    Attributes:
        noise: Noise is seeded with this plus the traffic seed.
        transferred: Whether the policy acts in a cell that it was not trained for.
        records: Library of records, or its folder; None for the user's cache.
        threads: Threads that estimate; None for one per core.
    """

    cell: Entry
    policy: PolicySource
    env: str
    keywords: Mapping[str, Any]
    seeds: tuple[int, ...]
    noise: int
    transferred: bool
    records: Records
    threads: int | None

    def make(self) -> tuple[SensorQueryVectorEnv, Policy]:
        """Make the environment, an episode for each traffic seed, and the policy in it.

        Raises:
            ValueError: A keyword is out of range, or the policy does not suit.
        """
        env = make_batch(self.env, self.keywords, self.seeds, self.records, self.threads)
        # Another incident is another corridor to a saved policy; its observations and actions must
        # be the same all the same.
        allow = TRANSFERABLE if self.transferred else ()
        return env, self.policy.load(env, allow=allow, seed=POLICY_SEED)


def cell_config(cell: PolicyCell, seeds: Sequence[int]) -> EnvConfig:
    """Return the configuration of a cell.

    Raises:
        ValueError: A keyword is unknown or out of range.
    """
    return make_batch(cell.env, cell.keywords, seeds).config


def run_entry(task: EntryTask) -> list[EpisodeScore]:
    """Run an entry on all its seeds."""
    return _run(task, *task.make())


def count_queries(task: EntryTask) -> list[QueryCounts]:
    """Run an entry and return its queries."""
    env, policy = task.make()
    counter = QueryCounter(env.process, task.seeds)
    _run(task, env, policy, counter)
    return counter.results()


def _run(
    task: EntryTask,
    env: SensorQueryVectorEnv,
    policy: Policy,
    on_second: Callable[[], None] | None = None,
) -> list[EpisodeScore]:
    if isinstance(task.policy, SavedPolicy):
        import torch  # noqa: PLC0415 (schedules alone do without)

        torch.manual_seed(POLICY_SEED)
    return run_episodes(
        env,
        policy,
        traffic_seeds=task.seeds,
        seeds=[task.noise + seed for seed in task.seeds],
        deterministic=task.cell.mode == DETERMINISTIC,
        on_second=on_second,
    )


def make_task(
    entry: Entry,
    design: PolicyDesign,
    manifest: Manifest,
    *,
    seeds: Sequence[int],
    noise: int,
    records: Records = None,
    threads: int | None = None,
) -> EntryTask:
    """Return the task of an entry, with the frozen policy and the settings tuned for it.

    Raises:
        FileNotFoundError: The file of a frozen policy is gone.
        ValueError: It is not the file that was frozen.
    """
    cell = design.cell(entry.cell)
    policy: PolicySource = NamedSchedule(entry.policy)
    if entry.kind == "learned":
        policy = manifest.checkpoint(entry).saved()
    keywords = {**cell.keywords, **policy.keywords}
    settings = manifest.settings(entry.policy, cell_config(cell, seeds))
    if settings is not None:
        keywords["estimator_settings"] = settings
    return EntryTask(
        cell=entry,
        policy=policy,
        env=cell.env,
        keywords=keywords,
        seeds=tuple(seeds),
        noise=noise,
        transferred=entry.trained_in not in ("", entry.cell),
        records=records,
        threads=threads,
    )


def suitable(cell: PolicyCell, names: Sequence[str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the schedules that can be run in a cell, and the reasons why others cannot.

    Raises:
        ValueError: The cell itself is out of range.
    """
    env = make_batch(cell.env, cell.keywords, (0,))
    env.process  # noqa: B018 (made here, so that an error below is the schedule's)
    fit, reasons = [], {}
    for name in names:
        try:
            NamedSchedule(name).load(env, seed=POLICY_SEED)
        except ValueError as problem:
            reasons[name] = str(problem)
        else:
            fit.append(name)
    return tuple(fit), reasons
