"""Run cells in worker processes, and note each as soon as it is done."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any, Generic, Protocol

import gymnasium as gym
from tqdm import tqdm

from agents.evaluation.episodes import EpisodeScore, run_episode
from agents.experiments.ledger import Cell, CellT, Ledger
from dptse_env.schedules import make_schedule
from dptse_env.validation import integer


class Design(Protocol[CellT]):
    """What is run: every cell on every seed."""

    @property
    def env(self) -> str:
        """Environment id."""

    @property
    def schedule(self) -> str:
        """Query schedule of every episode."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """Traffic seeds."""

    def cells(self) -> list[CellT]:
        """Return every cell once."""


@dataclass(frozen=True)
class Task(Generic[CellT]):
    """A cell on some traffic seeds.

    Attributes:
        env: Environment id.
        schedule: Query schedule.
        cell: The cell.
        seeds: Its traffic seeds.
        records: Folder of the record cache; None for the user's cache.
    """

    env: str
    schedule: str
    cell: CellT
    seeds: tuple[int, ...]
    records: str | None


@contextlib.contextmanager
def void_on_purpose() -> Iterator[None]:
    """Keep quiet about a guarantee that a study's keywords void; its account of privacy says it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"privacy\.preset is .* yet no privacy")
        yield


def make_env(env: str, cell: Cell, seeds: Sequence[int], records: str | None) -> gym.Env[Any, Any]:
    """Make the environment of a cell.

    Raises:
        ValueError: A value of the cell is out of range.
    """
    with void_on_purpose():
        return gym.make(
            env,
            disable_env_checker=True,
            traffic_seeds=list(seeds),
            records=records,
            **cell.keywords,
        )


def run_task(task: Task[CellT]) -> list[EpisodeScore]:
    """Run a cell on its seeds; a seed gives the traffic and the noise, so cells are paired."""
    env = make_env(task.env, task.cell, task.seeds, task.records)
    schedule = make_schedule(task.schedule, env)
    return [run_episode(env, schedule, traffic_seed=seed, seed=seed) for seed in task.seeds]


def missing(
    design: Design[CellT], ledger: Ledger[CellT, EpisodeScore], records: str | None
) -> list[Task[CellT]]:
    """Return what the ledger lacks, one task a cell."""
    tasks = []
    for cell in design.cells():
        seeds = tuple(seed for seed in design.seeds if (cell, seed) not in ledger.rows)
        if seeds:
            tasks.append(Task(design.env, design.schedule, cell, seeds, records))
    return tasks


def run_all(
    tasks: Sequence[Task[CellT]],
    ledger: Ledger[CellT, EpisodeScore],
    workers: int,
    progress: bool = True,
    work: Callable[[Any], list[Any]] | None = None,
) -> None:
    """Run tasks and add what they find to the ledger as they end.

    Args:
        tasks: What to run.
        ledger: Where scores go.
        workers: Processes; 1 runs in this one.
        progress: Whether to show a progress bar.
        work: Runs a task and returns a record for each of its seeds; `run_task` if None.

    Raises:
        ValueError: ``workers`` is below 1.
    """
    integer("workers", workers, 1)
    total = sum(len(task.seeds) for task in tasks)
    bar = tqdm(total=total, desc="episodes", unit="episode", mininterval=0.5, disable=not progress)
    # Closed at once: an interrupt between two results must end the workers, too.
    with bar, contextlib.closing(_done(tasks, workers, work or run_task)) as done:
        for task, scores in done:
            ledger.append(task.cell, scores)
            bar.update(len(scores))


def _done(
    tasks: Iterable[Task[CellT]], workers: int, work: Callable[[Any], list[Any]]
) -> Generator[tuple[Task[CellT], list[EpisodeScore]], None, None]:
    """Yield tasks with their scores, in whatever order they end."""
    if workers == 1:
        for task in tasks:
            yield task, work(task)
        return
    # Threads of the linear algebra would fight over the cores; children read this as they start.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    pool = make_pool(workers)
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


def make_pool(workers: int) -> ProcessPoolExecutor:
    """Return processes that leave interrupts to this one and end with it, however it ends."""
    # Spawned, not forked: this process may hold threads and a loaded simulation.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker)


def _begin_worker() -> None:
    """Leave interrupts to the parent, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    # The parent was killed: nobody takes results any more, and nothing is left to clean up.
    os._exit(1)
