"""Tasks of a study: run on an engine, their records kept in a ledger."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from agents.engines.engine import Engine, run_shown
from agents.experiments.cells import Key, KeyT
from agents.experiments.ledger import Ledger, ScoredT

KeyT_co = TypeVar("KeyT_co", bound=Key, covariant=True)


class Task(Protocol[KeyT_co]):
    """Some episodes of one key, with everything that a worker needs to run them."""

    @property
    def cell(self) -> KeyT_co:
        """The key of its records in a ledger."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """Traffic seeds, an episode each."""


def run_all(
    tasks: Sequence[Task[KeyT]],
    ledger: Ledger[KeyT, ScoredT],
    engine: Engine,
    work: Callable[[Any], list[ScoredT]],
    progress: bool = True,
) -> None:
    """Run tasks, add their records to a ledger as they end, and sort it.

    ``work`` runs a task and returns a record for each of its seeds.
    """
    run_shown(
        engine,
        work,
        tasks,
        lambda task, records: ledger.append(task.cell, records),
        size=lambda task: len(task.seeds),
        progress=progress,
        desc="episodes",
        unit="episode",
        mininterval=0.5,
    )
    ledger.sort()
