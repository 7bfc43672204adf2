"""Running cells: all traffic seeds of a cell at once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from agents.evaluation.contributions import LedgerScore, LedgerWatcher, TripSums
from agents.evaluation.episodes import EpisodeScore, run_episodes
from agents.experiments.ledger import Ledger
from agents.experiments.runner import Workplace, make_batch
from agents.studies.ledger.cell import LedgerCell
from agents.studies.ledger.plan import LedgerDesign
from dptse_env.schedules import make_schedule
from dptse_env.traffic import Records

POLICY_SEED = 0
"""Seeds the draws of a schedule."""


@dataclass(frozen=True)
class LedgerTask:
    """A cell on traffic seeds, with everything that a worker needs.

    Attributes:
        keywords: Keywords of ``gym.make`` that make it.
        records: Library of records, or its folder; None for the user's cache.
        threads: Threads that estimate; None for one per core.
    """

    env: str
    cell: LedgerCell
    keywords: Mapping[str, Any]
    seeds: tuple[int, ...]
    records: Records
    threads: int | None


def lacking_tasks(
    design: LedgerDesign, cells: Iterable[LedgerCell], ledger: Ledger[Any, Any], place: Workplace
) -> list[LedgerTask]:
    """Return the cells of which a ledger lacks a seed; they are run on all seeds again.

    A schedule that draws at random draws for all episodes of a cell at once.
    """
    seeds = design.traffic_seeds
    return [
        LedgerTask(design.env, cell, design.keywords(cell), seeds, place.records, place.threads)
        for cell in dict.fromkeys(cells)
        if ledger.lacking(cell, seeds)
    ]


def score_cell(task: LedgerTask) -> list[LedgerScore]:
    """Run a cell on its seeds; a seed gives the traffic and the noise, so cells are paired."""
    watcher, scores = _run(task)
    return watcher.scores(scores)


def watch_cell(task: LedgerTask) -> list[TripSums]:
    """Run a cell on its seeds, and return what its vehicles have paid."""
    watcher, scores = _run(task)
    return watcher.trips(scores)


def _run(task: LedgerTask) -> tuple[LedgerWatcher, list[EpisodeScore]]:
    env = make_batch(task.env, task.keywords, task.seeds, task.records, task.threads)
    schedule = make_schedule(task.cell.schedule, env, POLICY_SEED)
    watcher = LedgerWatcher(env.process, task.seeds)
    scores = run_episodes(
        env, schedule, traffic_seeds=task.seeds, seeds=task.seeds, on_second=watcher
    )
    return watcher, scores
