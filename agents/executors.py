"""Executors of tasks: this process, processes of this machine, or a Ray cluster.

All are `concurrent.futures.Executor`, and results do not depend on which one it is. A task whose
worker dies is run again. ``ahead`` is the number of tasks to submit ahead of results, so that no
worker waits for one.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from functools import partial
from itertools import islice
from threading import Lock
from typing import Any, Literal, TypeVar

import loky

from dptse_env.tools import add_tools_path
from dptse_env.traffic.recording import follow_parent, uninterrupted
from dptse_env.utils.kernels import compiling_is_said
from dptse_env.utils.progress import make_bar
from dptse_env.utils.registry import needed_for
from dptse_env.utils.validation import integer

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")

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


class ThisProcess(Executor):
    """Runs tasks one by one in the calling process."""

    ahead = 1

    def submit(self, fn: Callable[..., ResultT], /, *args: Any, **kwargs: Any) -> Future[ResultT]:
        """Run a call at once."""
        future: Future[ResultT] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as problem:
            future.set_exception(problem)
        return future


class LocalProcesses(ThreadPoolExecutor):
    """Runs tasks in processes of this machine, of one thread each.

    They leave Ctrl-C to this process, and end with it however it ends. A thread waits for each
    task, and runs it again, up to `RETRIES` times, where one of the processes dies.

    Args:
        workers: Number of processes, which start with the first call.

    Raises:
        ValueError: ``workers`` is below 1.
    """

    def __init__(self, workers: int) -> None:
        """Check the number."""
        self.workers = integer("workers", workers, 1)
        self.ahead = 2 * workers
        self._is_cancelled, self._lock = False, Lock()
        self._pool: loky.ProcessPoolExecutor | None = None
        super().__init__(self.ahead)

    def submit(self, fn: Callable[..., ResultT], /, *args: Any, **kwargs: Any) -> Future[ResultT]:
        """Run a call in one of the processes."""
        return super().submit(self._run, partial(fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes; with ``cancel_futures`` without waiting for what they run."""
        # What waits must not begin once processes are gone, and what runs needs them to its end.
        super().shutdown(wait and not cancel_futures, cancel_futures=cancel_futures)
        with self._lock:
            self._is_cancelled = cancel_futures
            if self._pool is not None:
                self._pool.shutdown(wait=wait, kill_workers=cancel_futures)

    def _run(self, call: Callable[[], ResultT]) -> ResultT:
        for _ in range(RETRIES + 1):
            with self._lock:
                pool = self._started()
            try:
                with uninterrupted():
                    future = pool.submit(call)
                result: ResultT = future.result()
            except BrokenExecutor as problem:
                with self._lock:
                    if self._pool is pool:
                        self._pool = None
                if self._is_cancelled:
                    raise
                lost = problem
            else:
                return result
        raise ExecutorError(_lost(type(lost).__name__)) from lost

    def _started(self) -> loky.ProcessPoolExecutor:
        """Return the processes, new ones where one has died.

        Raises:
            CancelledError: They were ended.
        """
        if self._is_cancelled:
            raise CancelledError
        if self._pool is None:
            self._pool = loky.ProcessPoolExecutor(
                self.workers,
                timeout=IDLE,
                initializer=_begin,
                initargs=(os.getpid(), compiling_is_said.is_set()),
                env={"OMP_NUM_THREADS": "1"},
            )
        return self._pool


def _begin(parent: int, is_said: bool) -> None:
    """Begin a local process: it follows its parent, and logs on lines of their own.

    It repeats nothing: the parent has made the same environments before, so it has given their
    warnings, and perhaps said that estimators are compiled.
    """
    follow_parent(parent)
    if is_said:
        compiling_is_said.set()
    warnings.filterwarnings("ignore", category=UserWarning, module="dptse_env")
    # In a terminal a bar of the parent stands in the line.
    start = "\r\033[K" if sys.stderr.isatty() else ""
    logging.basicConfig(format=f"{start}%(message)s")


class RayCluster(Executor):
    """Runs tasks on a Ray cluster, of which this machine is a node.

    Ray runs a task again whose worker or node dies. Nodes have this package, of the same version.
    Files that a task names, such as policies and road files, have to be readable under one path on
    every node; records of traffic are made where they are needed.

    Args:
        address: Address of the cluster, host:port, or "auto" for the one on this machine. If None,
            that of the environment variable ``RAY_ADDRESS``; where there is none, a cluster of this
            machine alone is started, which ends with the program.

    Raises:
        ExecutorError: There is no cluster at the address, or it has other versions.
        MissingExtraError: Ray is not installed.
    """

    def __init__(self, address: str | None = None) -> None:
        """Connect."""
        with needed_for("the executor ray, here and on all nodes,"):
            import ray  # noqa: PLC0415 (an extra)
        self._ray: Any = ray
        if not ray.is_initialized():
            self._connect(address or os.environ.get("RAY_ADDRESS"))
        # Spread, so that all nodes have tasks from the first on.
        self._call: Any = ray.remote(lambda fn, *args, **kwargs: fn(*args, **kwargs)).options(
            max_retries=RETRIES, scheduling_strategy="SPREAD"
        )
        self._running: dict[Future[Any], Any] = {}

    @property
    def ahead(self) -> int:
        """Number of tasks to submit ahead of their results: two for each processor there is now."""
        return 2 * max(int(self._ray.cluster_resources().get("CPU", 1)), 1)

    def submit(self, fn: Callable[..., ResultT], /, *args: Any, **kwargs: Any) -> Future[ResultT]:
        """Run a call on a node."""
        reference, outcome = self._call.remote(fn, *args, **kwargs), Future[ResultT]()
        self._running[outcome] = reference

        def end(inner: Future[ResultT]) -> None:
            self._running.pop(outcome, None)
            problem = inner.exception()
            if problem is None:
                outcome.set_result(inner.result())
            else:
                outcome.set_exception(self._explained(problem))

        reference.future().add_done_callback(end)
        return outcome

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the cluster be; with ``cancel_futures`` end what still runs there."""
        if cancel_futures:
            for reference in list(self._running.values()):
                self._ray.cancel(reference, force=True)

    def _connect(self, address: str | None) -> None:
        if address is not None and address != "auto":
            _require_cluster(address)
        environment = {
            "env_vars": {"OMP_NUM_THREADS": "1"},
            "worker_process_setup_hook": f"{add_tools_path.__module__}.{add_tools_path.__name__}",
        }
        try:
            self._ray.init(
                address=address or "local",
                runtime_env=environment,
                log_to_driver=False,
                include_dashboard=False if address is None else None,
                logging_level="WARNING",
            )
        except (ConnectionError, RuntimeError, ValueError, self._ray.exceptions.RayError) as error:
            there = "on this machine" if address in (None, "auto") else f"at {address}"
            raise ExecutorError(f"no cluster {there} takes this program: {error}") from error

    def _explained(self, problem: BaseException) -> BaseException:
        """Return the error of a task itself, or else one that says how its worker was lost."""
        errors = self._ray.exceptions
        if isinstance(problem, errors.RayTaskError) and isinstance(problem.cause, Exception):
            problem.cause.__cause__ = problem  # it has the traceback on the worker
            return problem.cause
        if isinstance(problem, errors.RayError):
            reason = str(problem).strip().splitlines()[0]
            return ExecutorError(_lost(f"{type(problem).__name__}: {reason}"))
        return problem


AnyExecutor = ThisProcess | LocalProcesses | RayCluster

THIS_PROCESS = ThisProcess()


def _lost(reason: str) -> str:
    return (
        f"a task was lost {RETRIES + 1} times ({reason}): results so far are kept, the same "
        "command goes on from there"
    )


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


def make_executor(name: ExecutorName, workers: int, address: str | None = None) -> AnyExecutor:
    """Return the executor that a command line chooses.

    Args:
        name: ``local``, processes of this machine, or ``ray``, a cluster.
        workers: Number of local processes; 1 is the calling process. A cluster has as many as it
            has processors.
        address: Address of the cluster; see `RayCluster`.

    Raises:
        ExecutorError: There is no suitable cluster.
        MissingExtraError: Ray is not installed.
        ValueError: An argument is out of range or of the other executor.
    """
    if name == "ray":
        return RayCluster(address)
    if address is not None:
        raise ValueError(f"address must be given with the executor ray, got {address!r}")
    return ThisProcess() if integer("workers", workers, 1) == 1 else LocalProcesses(workers)


def run_shown(
    executor: AnyExecutor,
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
        executor: Runs the tasks.
        work: Runs one; a function that workers can import.
        tasks: The tasks; they can be pickled.
        take: Called with the index of each task in `tasks` and its result.
        size: Units of the bar that a task stands for.
        progress: Whether to show the bar.
        bar: Further options of `tqdm`.

    Raises:
        ExecutorError: Workers died again and again. Errors of ``work`` are raised as they are.
    """
    waiting, running = iter(enumerate(tasks)), dict[Future[ResultT], int]()
    with make_bar(sum(map(size, tasks)), shown=progress, **bar) as shown:
        try:
            while True:
                for index, task in islice(waiting, max(executor.ahead - len(running), 0)):
                    running[executor.submit(work, task)] = index
                if not running:
                    return
                for future in wait(running, LONGEST_WAIT, FIRST_COMPLETED).done:
                    index = running.pop(future)
                    take(index, future.result())
                    shown.update(size(tasks[index]))
        except BaseException:
            executor.shutdown(cancel_futures=True)
            raise


def run_in_order(
    executor: AnyExecutor,
    work: Callable[[TaskT], ResultT],
    tasks: Sequence[TaskT],
    on_done: Callable[[float], None] = lambda fraction: None,
    **options: Any,
) -> list[ResultT]:
    """Run tasks and return their results, in the order of the tasks.

    ``on_done`` is called after each with the fraction of them that is done, ``options`` are those
    of `run_shown`.
    """
    results: dict[int, ResultT] = {}

    def take(index: int, result: ResultT) -> None:
        results[index] = result
        on_done(len(results) / len(tasks))

    run_shown(executor, work, tasks, take, **options)
    return [results[index] for index in range(len(tasks))]
