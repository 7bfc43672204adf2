"""Threads that work on blocks of a batch of episodes.

Compiled code that releases the global interpreter lock runs on several cores at once; the numpy
and Python code around it does not.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from typing import Any, TypeVar

from dptse_env.utils.arrays import IntArray
from dptse_env.utils.validation import integer

Data = TypeVar("Data")

SMALLEST_BLOCK = 16
"""Smallest block of episodes that is worth a thread: handing over a block takes some 50 us."""

BLOCKS_PER_THREAD = 4


class EpisodeThreads:
    """Splits the episodes of a batch among threads.

    An episode's result does not depend on the block that it is in, so the number of threads changes
    the time only.
    """

    def __init__(self, threads: int | None = None) -> None:
        """Set the number of threads; none is started yet.

        Args:
            threads: Largest number of threads; None for one per usable core.

        Raises:
            ValueError: ``threads`` is below 1.
        """
        self.threads = n_cores() if threads is None else integer("threads", threads, 1)
        self._pool: ThreadPoolExecutor | None = None
        self._owner = 0

    def __reduce__(self) -> tuple[type[EpisodeThreads], tuple[int]]:
        """Pickle without the threads."""
        return type(self), (self.threads,)

    def run(
        self,
        work: Callable[[IntArray, Data], None],
        episodes: IntArray,
        data: Data,
        block_of: Callable[[Any, slice], Any],
    ) -> None:
        """Call ``work(episodes, data)`` on blocks of both; return when all are done.

        An exception in any of them is raised here, once all have stopped.

        Args:
            work: Works on some episodes and what ``data`` has of them.
            episodes: Shape (k,).
            data: Of the k episodes.
            block_of: Returns a block of ``data``.
        """
        n_episodes = len(episodes)
        n_threads = max(min(self.threads, n_episodes // SMALLEST_BLOCK), 1)
        if n_threads == 1:
            work(episodes, data)
            return
        # More blocks than threads: a thread whose core is busy elsewhere then runs fewer of them.
        n_blocks = min(BLOCKS_PER_THREAD * n_threads, n_episodes // SMALLEST_BLOCK)
        ends = [n_episodes * k // n_blocks for k in range(n_blocks + 1)]
        blocks = iter([slice(*pair) for pair in pairwise(ends)])

        def drain() -> None:
            for block in blocks:
                work(episodes[block], block_of(data, block))

        futures = [self._threads().submit(drain) for _ in range(n_threads - 1)]
        try:
            drain()
        finally:
            wait(futures)
        for future in futures:
            future.result()

    def _threads(self) -> ThreadPoolExecutor:
        # A forked process has the pool, but not its threads.
        if self._pool is None or self._owner != os.getpid():
            self._pool = ThreadPoolExecutor(self.threads - 1, thread_name_prefix="dptse-block")
            self._owner = os.getpid()
        return self._pool


def n_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
