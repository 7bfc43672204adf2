"""Executors of tasks: this process, processes of this machine, or a Ray cluster.

An executor is a function of the work and its tasks. It yields the index of each task with its
result, in whatever order they come, and ends what still runs where it is closed before. Results do
not depend on which one it is. A task whose worker dies is run again.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

import loky
from loky.backend import resource_tracker

from dptse_env.tools import add_tools_path
from dptse_env.traffic.recording import follow_parent, uninterrupted
from dptse_env.utils.kernels import compiling_is_said
from dptse_env.utils.progress import make_bar, set_quiet
from dptse_env.utils.registry import needed_for
from dptse_env.utils.validation import integer

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")
Results = Generator[tuple[int, ResultT], None, None]

Executor = Callable[[Callable[[Any], Any], Sequence[Any]], Results[Any]]
"""Runs work, a function that workers can import, on tasks that can be pickled. Errors of the work
are raised as they are; an `ExecutorError` says that workers died again and again."""

ExecutorName = Literal["local", "ray"]

RETRIES = 3
"""Further attempts at a task whose worker or node dies. An error of the task itself is final."""

IDLE = 10.0
"""Time after which a local process without a task ends [s]."""

LONGEST_WAIT = 0.5
"""Longest wait for results [s]: Ctrl-C ends one where another thread is told of it."""

ANSWER_SECONDS = 20.0
"""Longest time for a cluster to say that it works [s]; `ray.init` would try for minutes."""


class ExecutorError(RuntimeError):
    """Tasks cannot be run; the message says why, and what to do."""


def this_process(work: Callable[[TaskT], ResultT], tasks: Sequence[TaskT]) -> Results[ResultT]:
    """Run tasks one by one in the calling process."""
    for index, task in enumerate(tasks):
        yield index, work(task)


def make_executor(name: ExecutorName, workers: int, address: str | None = None) -> Executor:
    """Return the executor that a command line chooses.

    Args:
        name: ``local``, processes of this machine of one thread each, or ``ray``, a cluster of
            which this machine is a node. Its nodes have this package, of the same version. Files
            that a task names, such as policies and road files, have to be readable under one path
            on every node; records of traffic are made where they are needed.
        workers: Number of local processes; 1 is the calling process. A cluster has as many as it
            has processors.
        address: Address of the cluster, host:port, or "auto" for the one on this machine. If None,
            that of the environment variable ``RAY_ADDRESS``; where there is none, a cluster of this
            machine alone is started, which ends with the program.

    Raises:
        ExecutorError: There is no cluster at the address, or it has other versions.
        MissingExtraError: Ray is not installed.
        ValueError: An argument is out of range or of the other executor.
    """
    if name == "ray":
        ray = _connected(address)
        # Spread, so that all nodes have tasks from the first on.
        call = ray.remote(lambda work, task: work(task)).options(
            max_retries=RETRIES, scheduling_strategy="SPREAD"
        )
        return partial(_on_cluster, ray, call)
    if address is not None:
        raise ValueError(f"address must be given with the executor ray, got {address!r}")
    if integer("workers", workers, 1) == 1:
        return this_process
    return partial(_in_processes, workers)


def _in_processes(
    workers: int, work: Callable[[TaskT], ResultT], tasks: Sequence[TaskT]
) -> Results[ResultT]:
    """Run tasks in processes that leave Ctrl-C to this one, and end with it however it ends.

    When one dies, loky fails all tasks; those are done again by new ones.
    """
    left, deaths = dict(enumerate(tasks)), 0
    while left:
        waiting, running = iter([*left.items()]), dict[Future[ResultT], int]()
        with _quiet_tracker():
            pool = loky.get_reusable_executor(
                workers,
                timeout=IDLE,
                initializer=_begin,
                initargs=(os.getpid(), compiling_is_said.is_set()),
                # Those of another folder would not find what is named from here.
                env={"OMP_NUM_THREADS": "1", "PWD": str(Path.cwd())},
            )
        try:
            while left:
                # Ahead of results, so that no process waits for a task.
                for index, task in islice(waiting, 2 * workers - len(running)):
                    with uninterrupted():
                        running[pool.submit(work, task)] = index
                done = wait(running, LONGEST_WAIT, FIRST_COMPLETED).done
                for future in sorted(done, key=_is_lost):  # results that there are come first
                    index, result = running.pop(future), future.result()
                    del left[index]
                    deaths = 0
                    yield index, result
        except BrokenExecutor as problem:
            deaths += 1
            if deaths > RETRIES:
                raise ExecutorError(_lost(type(problem).__name__)) from problem
        except BaseException:
            pool.shutdown(kill_workers=True)
            raise


@contextlib.contextmanager
def _quiet_tracker() -> Iterator[None]:
    """Let loky's resource tracker, if it starts now, remove what an interruption leaves unsaid.

    It is a process of its own, which takes the interpreter's options.
    """
    sys.warnoptions.append(f"ignore::UserWarning:{resource_tracker.__name__}")
    try:
        yield
    finally:
        sys.warnoptions.pop()


def _is_lost(future: Future[Any]) -> bool:
    return isinstance(future.exception(), BrokenExecutor)


def _begin(parent: int, is_said: bool) -> None:
    """Begin a local process: it follows its parent, and logs on lines of their own.

    It repeats nothing: the parent has made the same environments before, so it has given their
    warnings, and perhaps said that estimators are compiled.
    """
    follow_parent(parent)
    if is_said:
        compiling_is_said.set()
    warnings.filterwarnings("ignore", category=UserWarning, module="dptse_env")
    set_quiet(True)  # bars are the parent's
    # In a terminal a bar of the parent stands in the line.
    start = "\r\033[K" if sys.stderr.isatty() else ""
    logging.basicConfig(format=f"{start}%(message)s")


def _on_cluster(
    ray: Any, call: Any, work: Callable[[TaskT], ResultT], tasks: Sequence[TaskT]
) -> Results[ResultT]:
    """Run tasks on the nodes; Ray runs one again whose worker or node dies."""
    running = {call.remote(work, task): index for index, task in enumerate(tasks)}
    try:
        while running:
            for reference in ray.wait([*running], timeout=LONGEST_WAIT)[0]:
                yield running.pop(reference), ray.get(reference)
    except ray.exceptions.RayTaskError as problem:
        if isinstance(problem.cause, Exception):
            raise problem.cause from problem  # which has the traceback on the worker
        raise
    except ray.exceptions.RayError as problem:
        reason = str(problem).strip().splitlines()[0]
        raise ExecutorError(_lost(f"{type(problem).__name__}: {reason}")) from problem
    finally:
        for reference in running:
            ray.cancel(reference, force=True)


def _connected(address: str | None) -> Any:
    """Return Ray, connected to a cluster; see `make_executor`."""
    with needed_for("the executor ray, here and on all nodes,"):
        ray: Any = importlib.import_module("ray")  # an extra
    if ray.is_initialized():
        return ray
    address = address or os.environ.get("RAY_ADDRESS")
    if address not in (None, "auto"):
        _require_cluster(address)
    environment = {
        "env_vars": {"OMP_NUM_THREADS": "1"},
        "worker_process_setup_hook": f"{add_tools_path.__module__}.{add_tools_path.__name__}",
    }
    try:
        ray.init(
            address=address or "local",
            runtime_env=environment,
            log_to_driver=False,
            include_dashboard=False if address is None else None,
            logging_level="WARNING",
        )
    except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        there = "on this machine" if address in (None, "auto") else f"at {address}"
        raise ExecutorError(f"no cluster {there} takes this program: {error}") from error
    return ray


def _require_cluster(address: str) -> None:
    """Check that a Ray cluster answers at an address.

    Raises:
        ExecutorError: None does.
    """
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    answers = False
    with contextlib.suppress(subprocess.TimeoutExpired):
        asked = subprocess.run(command, capture_output=True, check=False, timeout=ANSWER_SECONDS)
        answers = asked.returncode == 0
    if not answers:
        raise ExecutorError(
            f"no Ray cluster answers at {address}: give --address host:port of a head node, as "
            "'ray start --head' prints it there"
        )


def _lost(reason: str) -> str:
    return (
        f"a task was lost {RETRIES + 1} times ({reason}): results so far are kept, the same "
        "command goes on from there"
    )


def run_shown(
    executor: Executor,
    work: Callable[[TaskT], ResultT],
    tasks: Sequence[TaskT],
    take: Callable[[int, ResultT], None],
    *,
    size: Callable[[TaskT], int] = lambda task: 1,
    progress: bool = True,
    **bar: Any,
) -> None:
    """Run tasks with a progress bar, and hand over each result as it comes, in whatever order.

    No result is kept. What still runs is ended where anything goes wrong, and on Ctrl-C.

    Args:
        executor: Runs the tasks; see `Executor` for what it raises.
        work: Runs one.
        tasks: The tasks.
        take: Called with the index of each task in `tasks` and its result.
        size: Units of the bar that a task stands for.
        progress: Whether to show the bar.
        bar: Further options of `tqdm`.
    """
    with (
        make_bar(sum(map(size, tasks)), shown=progress, **bar) as shown,
        contextlib.closing(executor(work, tasks)) as results,
    ):
        for index, result in results:
            take(index, result)
            shown.update(size(tasks[index]))


def run_in_order(
    executor: Executor,
    work: Callable[[TaskT], ResultT],
    tasks: Sequence[TaskT],
    **options: Any,
) -> list[ResultT]:
    """Run tasks and return their results, in their order; options are those of `run_shown`."""
    results: dict[int, ResultT] = {}
    run_shown(executor, work, tasks, results.__setitem__, **options)
    return [results[index] for index in range(len(tasks))]
