"""`LocalProcesses`: the engine of one machine."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any

from agents.engines.engine import ResultT, Workers
from dptse_env.traffic import Corridor, RecordLibrary
from dptse_env.utils.validation import integer


@dataclass(frozen=True)
class LocalProcesses:
    """Runs tasks in processes of this machine; see `Engine`.

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

    @contextlib.contextmanager
    def open(self) -> Iterator[Workers]:
        """See `Engine.open`."""
        if self.workers == 1:
            yield _Caller()
            return
        # Threads of linear algebra would fight over the cores; workers read this as they start.
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        pool = _make_pool(self.workers)
        try:
            yield _Pool(pool, self.workers)
        except BaseException:
            # What runs is not waited for: it is redone from its seeds at the next start.
            for process in list((pool._processes or {}).values()):
                process.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)

    def record(
        self, library: RecordLibrary, corridor: Corridor, seeds: Sequence[int], progress: bool
    ) -> None:
        """See `Engine.record`."""
        library.ensure(corridor, seeds, self.workers, progress)

    def shared(self, library: RecordLibrary) -> RecordLibrary:
        """See `Engine.shared`."""
        return library


THIS_PROCESS = LocalProcesses(1)
"""Runs tasks one by one in the calling process."""


class _Caller:
    """Runs calls in the calling process, at once."""

    capacity, place = 1, ""

    def submit(self, work: Callable[..., ResultT], /, *arguments: Any) -> Future[ResultT]:
        """See `Workers.submit`."""
        future: Future[ResultT] = Future()
        future.set_result(work(*arguments))
        return future


@dataclass(frozen=True)
class _Pool:
    """Runs calls in a pool of processes."""

    pool: ProcessPoolExecutor
    n_processes: int
    place = ""

    @property
    def capacity(self) -> int:
        """See `Workers.capacity`."""
        return 2 * self.n_processes

    def submit(self, work: Callable[..., ResultT], /, *arguments: Any) -> Future[ResultT]:
        """See `Workers.submit`."""
        return self.pool.submit(work, *arguments)


def _make_pool(workers: int) -> ProcessPoolExecutor:
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
