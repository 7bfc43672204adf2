"""Tasks of a study: run on an engine, their records kept in a ledger."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from tqdm import tqdm

from agents.engines.engine import Engine, run_tasks
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
    total = sum(len(task.seeds) for task in tasks)
    bar = tqdm(total=total, desc="episodes", unit="episode", mininterval=0.5, disable=not progress)
    # Closed at once: an interrupt between two results must end the workers, too.
    with bar, contextlib.closing(run_tasks(engine, work, tasks, bar.set_postfix_str)) as finished:
        for task, records in finished:
            ledger.append(task.cell, records)
            bar.update(len(records))
    ledger.sort()
