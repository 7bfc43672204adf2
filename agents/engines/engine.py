"""`Engine`: what runs the tasks of a long job, wherever that is."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import AbstractContextManager
from itertools import islice
from typing import Any, Protocol, TypeVar

from tqdm import tqdm

from dptse_env.traffic import Corridor, RecordLibrary

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")


class EngineError(RuntimeError):
    """An engine cannot run tasks; the message says why, and what to do."""


class Workers(Protocol):
    """Run calls, several at once."""

    @property
    def capacity(self) -> int:
        """Number of calls to submit ahead of their results, so that no worker waits for one.

        It may change while tasks run, as machines join and leave.
        """

    @property
    def place(self) -> str:
        """Machines that run the calls now, for a progress bar; empty for this machine."""

    def submit(self, work: Callable[..., ResultT], /, *arguments: Any) -> Future[ResultT]:
        """Run ``work(*arguments)`` on a worker.

        ``work`` is a function of a module, so that workers can import it; arguments and result can
        be pickled. An error of ``work`` is raised by the future.
        """


class Engine(Protocol):
    """Runs tasks and records traffic, on one machine or on many, with the same results."""

    @property
    def is_parallel(self) -> bool:
        """True if tasks share a machine, so that each should use one thread."""

    def open(self) -> AbstractContextManager[Workers]:
        """Give workers; what they still run when the block ends by an error is given up."""

    def record(
        self, library: RecordLibrary, corridor: Corridor, seeds: Sequence[int], progress: bool
    ) -> None:
        """Make the missing records of traffic seeds; see `RecordLibrary.ensure`.

        Raises:
            ValueError: A seed is out of range or was not recorded.
            RecordingError: A recording fails.
            NetworkError: The corridor has to be compiled and cannot be.
            SumoVersionError: libsumo is missing, broken or of another release series.
            EngineError: Workers are lost, or do not suit.
        """

    def shared(self, library: RecordLibrary) -> RecordLibrary:
        """Return the library as tasks take it along: its records can be read wherever they run."""


def run_tasks(
    engine: Engine,
    work: Callable[[TaskT], ResultT],
    tasks: Iterable[TaskT],
    on_place: Callable[[str], None] = lambda place: None,
) -> Generator[tuple[TaskT, ResultT], None, None]:
    """Yield tasks with their results, in whatever order they end.

    Tasks are taken one by one as workers come free, and nothing is kept of one that is yielded:
    memory does not grow with their number. Closing the generator ends what still runs.

    Args:
        engine: Runs the tasks.
        work: Runs one; a function of a module.
        tasks: The tasks; they can be pickled.
        on_place: Called with `Workers.place` whenever it has changed.

    Raises:
        EngineError: Workers are lost, or do not suit. Errors of ``work`` are raised as they are.
    """
    waiting, running, place = iter(tasks), dict[Future[ResultT], TaskT](), ""
    with engine.open() as workers:
        while True:
            for task in islice(waiting, max(workers.capacity - len(running), 0)):
                running[workers.submit(work, task)] = task
            if workers.place != place:
                on_place(place := workers.place)
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()


def run_shown(
    engine: Engine,
    work: Callable[[TaskT], ResultT],
    tasks: Sequence[TaskT],
    take: Callable[[TaskT, ResultT], None],
    *,
    size: Callable[[TaskT], int] = lambda task: 1,
    progress: bool = True,
    **bar: Any,
) -> None:
    """Run tasks as `run_tasks` does, with a progress bar, and hand over each result as it comes.

    Args:
        engine: Runs the tasks.
        work: Runs one; a function of a module.
        tasks: The tasks; they can be pickled.
        take: Called with each task and its result.
        size: Units of the bar that a task stands for.
        progress: Whether to show the bar.
        bar: Further options of `tqdm`.
    """
    shown = tqdm(total=sum(map(size, tasks)), disable=not progress, **bar)
    # Closed at once: an interrupt between two results must end the workers, too.
    run = contextlib.closing(run_tasks(engine, work, tasks, shown.set_postfix_str))
    with shown, run as finished:
        for task, result in finished:
            take(task, result)
            shown.update(size(task))


def run_in_order(
    engine: Engine,
    work: Callable[[TaskT], ResultT],
    tasks: Sequence[TaskT],
    on_done: Callable[[float], None] = lambda fraction: None,
    **options: Any,
) -> list[ResultT]:
    """Run tasks and return their results, in the order of the tasks.

    ``on_done`` is called after each with the fraction of them that is done, ``options`` are those
    of `run_shown`.
    """
    places = {id(task): place for place, task in enumerate(tasks)}
    results: dict[int, ResultT] = {}

    def take(task: TaskT, result: ResultT) -> None:
        results[places[id(task)]] = result
        on_done(len(results) / len(tasks))

    run_shown(engine, work, tasks, take, **options)
    return [results[place] for place in range(len(tasks))]
