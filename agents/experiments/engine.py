"""Engines: they run tasks somewhere and hand back results as the tasks end."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any, Protocol, TypeVar

from tqdm import tqdm

from agents.experiments.cells import Key, KeyT
from agents.experiments.ledger import Ledger, ScoredT
from dptse_env.utils.validation import integer

KeyT_co = TypeVar("KeyT_co", bound=Key, covariant=True)


class Task(Protocol[KeyT_co]):
    """Some episodes of one key, with everything that a worker needs to run them."""

    @property
    def cell(self) -> KeyT_co:
        """The key of its records in a ledger."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """Traffic seeds, an episode each."""


TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")


class Engine(Protocol):
    """Runs tasks: in local processes, or wherever another implementation sends them."""

    @property
    def is_parallel(self) -> bool:
        """True if tasks share a machine, so that each should use one thread."""

    def run(
        self, work: Callable[[TaskT], ResultT], tasks: Sequence[TaskT]
    ) -> Generator[tuple[TaskT, ResultT], None, None]:
        """Yield tasks with their results, in whatever order they end.

        Closing the generator ends what still runs. An error of ``work`` is raised here; it is a
        function of a module, so that workers can import it, and tasks can be pickled.
        """


@dataclass(frozen=True)
class LocalProcesses:
    """Runs tasks in processes of this machine.

    Attributes:
        workers: Number of processes; 1 runs in the calling process.

    Raises:
        ValueError: ``workers`` is below 1.
    """

    workers: int

    def __post_init__(self) -> None:
        """Check the number."""
        integer("workers", self.workers, 1)

    @property
    def is_parallel(self) -> bool:
        """See `Engine.is_parallel`."""
        return self.workers > 1

    def run(
        self, work: Callable[[TaskT], ResultT], tasks: Sequence[TaskT]
    ) -> Generator[tuple[TaskT, ResultT], None, None]:
        """See `Engine.run`."""
        if self.workers == 1:
            for task in tasks:
                yield task, work(task)
            return
        # Threads of linear algebra would fight over the cores; workers read this as they start.
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        pool = make_pool(self.workers)
        try:
            running = {pool.submit(work, task): task for task in tasks}
            for future in as_completed(running):
                yield running.pop(future), future.result()
        except BaseException:
            # What runs is not waited for: it is redone from its seeds at the next start.
            for process in list((pool._processes or {}).values()):
                process.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


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
    with bar, contextlib.closing(engine.run(work, tasks)) as finished:
        for task, records in finished:
            ledger.append(task.cell, records)
            bar.update(len(records))
    ledger.sort()


def make_pool(workers: int) -> ProcessPoolExecutor:
    """Return workers that leave interrupts to the caller and end with it, however it ends."""
    # Spawned, not forked: this process may hold threads and a loaded simulation.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=follow_parent)


def follow_parent() -> None:
    """Leave interrupts to the parent process, and end when it ends."""

    def end_with_parent() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        wait([parent.sentinel])
        # The parent was killed: no process takes results any more, and nothing is left to clean up.
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()
