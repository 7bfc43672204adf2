"""Executors of tasks: in this process, in processes of this machine, or on a Ray cluster.

All three are `concurrent.futures.Executor`, and results do not depend on which one it is. Their
``ahead`` is the number of tasks to submit ahead of results, so that no worker waits for one.
"""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from functools import partial
from itertools import islice
from typing import Any, Literal, TypeVar

import loky
from tqdm import tqdm

from dptse_env.command_line import TOOLS
from dptse_env.traffic.recording import follow_parent
from dptse_env.utils.fields import integer
from dptse_env.utils.registry import needed_for

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")

ExecutorName = Literal["local", "ray"]

RETRIES = 3
"""Further attempts at a task whose worker or node dies. An error of the task itself is final."""

CONNECT_SECONDS = 10.0
"""Longest time for a connection to a cluster [s]."""

HEALTH_SECONDS = 12.0
"""Longest time for a cluster to say that it works [s]."""


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


class LocalProcesses(Executor):
    """Runs tasks in processes of this machine, of one thread each.

    They leave Ctrl-C to this process, and end with it however it ends. When one dies, all tasks
    that are not done are run again by new ones, each up to `RETRIES` times.

    Args:
        workers: Number of processes.

    Raises:
        ValueError: ``workers`` is below 1.
    """

    def __init__(self, workers: int) -> None:
        """Check the number; processes start with the first call."""
        self.workers = integer("workers", workers, 1)
        self.ahead = 2 * workers
        self._is_cancelled = False

    def submit(self, fn: Callable[..., ResultT], /, *args: Any, **kwargs: Any) -> Future[ResultT]:
        """Run a call in one of the processes."""
        self._is_cancelled = False
        outcome: Future[ResultT] = Future()
        self._begin(outcome, partial(fn, *args, **kwargs), RETRIES)
        return outcome

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes; with ``cancel_futures`` without waiting for what they run."""
        self._is_cancelled = cancel_futures
        self._pool().shutdown(wait=wait, kill_workers=cancel_futures)

    def _begin(self, outcome: Future[ResultT], call: Callable[[], ResultT], retries: int) -> None:
        try:
            inner = self._pool().submit(call)
        except BrokenExecutor as problem:
            self._end(outcome, call, retries, problem)
            return

        def end(inner: Future[ResultT]) -> None:
            problem = inner.exception()
            if problem is None:
                outcome.set_result(inner.result())
            else:
                self._end(outcome, call, retries, problem)

        inner.add_done_callback(end)

    def _end(
        self,
        outcome: Future[ResultT],
        call: Callable[[], ResultT],
        retries: int,
        problem: BaseException,
    ) -> None:
        if not isinstance(problem, BrokenExecutor) or self._is_cancelled:
            outcome.set_exception(problem)
        elif retries == 0:
            outcome.set_exception(ExecutorError(_lost(type(problem).__name__)))
        else:
            # In a thread of its own: this one may belong to the processes that are replaced.
            again = outcome, call, retries - 1
            threading.Thread(target=self._begin, args=again, daemon=True).start()

    def _pool(self) -> Any:
        """Return the processes, new ones where one has died."""
        return loky.get_reusable_executor(
            self.workers,
            initializer=follow_parent,
            initargs=(os.getpid(),),
            env={"OMP_NUM_THREADS": "1"},
        )


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
        self._call: Any = ray.remote(_call).options(
            max_retries=RETRIES, scheduling_strategy="SPREAD"
        )
        self._running: dict[Future[Any], Any] = {}

    @property
    def ahead(self) -> int:
        """Number of tasks to submit ahead of their results: two for each processor there is now."""
        return 2 * max(int(self._ray.cluster_resources().get("CPU", 1)), 1)

    def submit(self, fn: Callable[..., ResultT], /, *args: Any, **kwargs: Any) -> Future[ResultT]:
        """Run a call on a node."""
        reference = self._call.remote(fn, args, kwargs)
        outcome: Future[ResultT] = Future()
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
            _reach(address)
        environment: dict[str, Any] = {"env_vars": {"OMP_NUM_THREADS": "1"}}
        if TOOLS.is_dir():
            environment["worker_process_setup_hook"] = "dptse_env.command_line.add_tools_path"
        try:
            self._ray.init(
                address=address or "local",
                runtime_env=environment,
                log_to_driver=False,
                include_dashboard=False if address is None else None,
                logging_level=logging.WARNING,
            )
        except (ConnectionError, RuntimeError, ValueError, self._ray.exceptions.RayError) as error:
            there = "on this machine" if address in (None, "auto") else f"at {address}"
            raise ExecutorError(
                f"no cluster {there} takes this program (Python {platform.python_version()}, Ray "
                f"{self._ray.__version__}): {error}"
            ) from error

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


def _call(fn: Callable[..., ResultT], args: Sequence[Any], kwargs: dict[str, Any]) -> ResultT:
    return fn(*args, **kwargs)


def _lost(reason: str) -> str:
    return (
        f"a task was lost {RETRIES + 1} times ({reason}): results so far are kept, the same "
        "command goes on from there"
    )


def _reach(address: str) -> None:
    """Check that a cluster answers at an address; `ray.init` would try for minutes.

    Raises:
        ExecutorError: None does, or the address is no host:port.
    """
    host, colon, port = address.rpartition(":")
    if not (host and colon and port.isdecimal()) or "://" in address:
        raise ExecutorError(
            f"address must be host:port of a cluster's head node, or auto, got {address!r}. Run "
            "the program on a node of the cluster"
        )
    try:
        socket.create_connection((host, int(port)), CONNECT_SECONDS).close()
    except OSError as problem:
        raise ExecutorError(
            f"no cluster answers at {address} ({problem}): start one there with 'ray start "
            "--head', or give --address another one"
        ) from problem
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    try:
        answer = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=HEALTH_SECONDS
        )
    except subprocess.TimeoutExpired as problem:
        raise ExecutorError(
            f"what listens at {address} does not answer as a Ray cluster: give --address that of a "
            "head node, as 'ray start --head' prints it"
        ) from problem
    if answer.returncode:
        lines = answer.stderr.strip().splitlines() or ["it is not healthy"]
        raise ExecutorError(f"the cluster at {address} cannot be used: {lines[-1]}")


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


def run_tasks(
    executor: AnyExecutor, work: Callable[[TaskT], ResultT], tasks: Iterable[TaskT]
) -> Generator[tuple[TaskT, ResultT], None, None]:
    """Yield tasks with their results, in whatever order they end.

    Tasks are taken one by one as workers come free, and nothing is kept of one that is yielded:
    memory does not grow with their number. Closing the generator ends what still runs.

    Args:
        executor: One of this module.
        work: Runs a task; a function that workers can import.
        tasks: The tasks; they can be pickled.

    Raises:
        ExecutorError: Workers died again and again. Errors of ``work`` are raised as they are.
    """
    waiting, running = iter(tasks), dict[Future[ResultT], TaskT]()
    try:
        while True:
            for task in islice(waiting, max(executor.ahead - len(running), 0)):
                running[executor.submit(work, task)] = task
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()
    except BaseException:
        executor.shutdown(cancel_futures=True)
        raise


def run_shown(
    executor: AnyExecutor,
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
        executor: Runs the tasks.
        work: Runs one.
        tasks: The tasks.
        take: Called with each task and its result.
        size: Units of the bar that a task stands for.
        progress: Whether to show the bar.
        bar: Further options of `tqdm`.
    """
    shown = tqdm(total=sum(map(size, tasks)), disable=not progress, **bar)
    # Closed at once: an interrupt between two results must end the workers, too.
    with shown, contextlib.closing(run_tasks(executor, work, tasks)) as finished:
        for task, result in finished:
            take(task, result)
            shown.update(size(task))


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
    places = {id(task): place for place, task in enumerate(tasks)}
    results: dict[int, ResultT] = {}

    def take(task: TaskT, result: ResultT) -> None:
        results[places[id(task)]] = result
        on_done(len(results) / len(tasks))

    run_shown(executor, work, tasks, take, **options)
    return [results[place] for place in range(len(tasks))]
