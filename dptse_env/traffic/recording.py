"""Recording in worker processes, each of which runs one simulation of SUMO at a time.

libsumo has one simulation in a process, and a crash of SUMO ends its process; so it runs in none of
the caller's. Workers are plain processes of the interpreter that loky starts: they never import the
caller's ``__main__``. When one dies, loky fails all tasks; those are done again by new workers.
"""

import contextlib
import logging
import multiprocessing
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from itertools import islice
from pathlib import Path

from loky import ProcessPoolExecutor
from loky.process_executor import BrokenProcessPool

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.own_sumo import Remark
from dptse_env.traffic.record import Record
from dptse_env.traffic.sumo import RecordingError, simulate
from dptse_env.traffic.sumo_input import NetconvertError
from dptse_env.utils.registry import MissingExtraError
from dptse_env.versions import SumoVersionError

ATTEMPTS = 3
"""Workers that may die on a traffic seed, for instance for lack of memory. An error that a worker
reports is final, since the same seed would fail in the same way again."""

WATCH = 0.5
"""Time [s] between two looks of a worker at whether its parent is there."""

Sources = Mapping[int, Mapping[str, object]]
"""Properties saved with the record of each traffic seed; see `Record.save`."""

logger = logging.getLogger(__name__)


def record_seeds(
    corridor: Corridor,
    paths: Mapping[int, Path],
    sources: Sources,
    workers: int = 1,
    done: Callable[[], object] = lambda: None,
    remark: Callable[[int, str], object] = lambda seed, text: None,
) -> None:
    """Record traffic seeds, several at once.

    Args:
        corridor: The road.
        paths: The file of each traffic seed's record, which is replaced if it exists.
        sources: What is saved with each.
        workers: Number of processes.
        done: Called after each record.
        remark: Takes what is unusual of the traffic of a seed; see `simulate`.

    Raises:
        RecordingError: A recording fails, or `ATTEMPTS` workers died on a seed. Recordings in
            progress are finished and kept, no other is started.
        NetconvertError: The corridor has to be compiled and cannot be.
        SumoVersionError: libsumo is missing, broken or too old.
        MissingExtraError: The corridor has to be compiled and netconvert is missing.
    """
    waiting, deaths = dict(paths), Counter[int]()

    def finished(seed: int, remarks: list[str]) -> None:
        for text in remarks:
            remark(seed, text)
        del waiting[seed]
        done()

    while waiting:
        # One whose worker died is recorded alone, so that another death is on its account.
        alone = [seed for seed in waiting if deaths[seed]][:1]
        seeds = {seed: paths[seed] for seed in alone or waiting}
        lost, cause = _record_until_death(corridor, seeds, sources, workers, finished)
        deaths.update(lost)
        for seed in lost:
            if deaths[seed] == ATTEMPTS:
                cause = f"{cause}\n(tried {ATTEMPTS} times; no worker survived it)"
                raise RecordingError.from_cause(corridor, seed, cause)
        if lost:
            again = ", ".join(map(str, lost[:20]))
            logger.warning("%s: %s; recording again: traffic seeds %s", corridor.name, cause, again)


def simulate_in_worker(corridor: Corridor, seed: int, remark: Remark = lambda text: None) -> Record:
    """Do as `simulate` in another process; errors are those of `record_seeds`."""
    with tempfile.TemporaryDirectory(prefix="dptse-record-") as folder:
        path = Path(folder) / "record"
        record_seeds(corridor, {seed: path}, {seed: {}}, remark=lambda _, text: remark(text))
        return Record.load(path, {}, corridor.record_shape)


def _record_until_death(
    corridor: Corridor,
    paths: Mapping[int, Path],
    sources: Sources,
    workers: int,
    finished: Callable[[int, list[str]], None],
) -> tuple[list[int], str]:
    """Record until all is done or a worker dies; return what was in progress then, and why."""
    waiting, running, cause = iter(paths), dict[Future[list[str]], int](), ""
    n_workers = min(workers, len(paths))
    with _worker_processes(n_workers) as pool:
        while not cause:
            try:
                # No more than there are workers: all of them are in progress.
                for seed in islice(waiting, n_workers - len(running)):
                    task = corridor, seed, paths[seed], dict(sources[seed])
                    with uninterrupted():
                        running[pool.submit(_record, *task)] = seed
            except BrokenProcessPool as error:
                cause = _cause(error)
            if not running:
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                try:
                    remarks = future.result()
                except BrokenProcessPool as error:
                    cause = _cause(error)
                else:
                    finished(running.pop(future), remarks)
    return list(running.values()), cause


@contextlib.contextmanager
def _worker_processes(n_workers: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes that end with this one, and remove what they leave in their folder."""
    this = multiprocessing.current_process()
    # Daemonic processes, such as those of vectorised environments, may have no children since these
    # would outlive them; workers do not.
    was_daemon, this.daemon = this.daemon, False
    try:
        with (
            tempfile.TemporaryDirectory(prefix="dptse-worker-") as folder,
            ProcessPoolExecutor(
                n_workers,
                initializer=follow_parent,
                initargs=(os.getpid(), folder),
                # Modules in the working directory must not shadow those of the interpreter.
                env={"TMPDIR": folder, "PYTHONSAFEPATH": "1"},
            ) as pool,
        ):
            yield pool
    finally:
        this.daemon = was_daemon


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Start processes in the body that leave interrupts to this one from the first moment on."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def follow_parent(parent: int, folder: str | None = None) -> None:
    """Leave Ctrl-C and SIGTERM to the parent of this process, and end when it ends.

    Args:
        parent: The process id of the parent.
        folder: A folder to remove if the parent is killed and cannot do so.
    """

    def end_with_parent() -> None:
        _wait_for_end(parent)
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)

    for number in (signal.SIGINT, signal.SIGTERM):  # a whole group of processes may have them
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()


def _wait_for_end(parent: int) -> None:
    """Return when the parent of this process, of a given process id, has ended."""
    if sys.platform == "win32":  # where `os.getppid` is the same after the parent's end
        process = multiprocessing.parent_process()
        assert process is not None
        process.join()
    else:  # where workers of loky have no handle of their parent
        while os.getppid() == parent:
            time.sleep(WATCH)


def _record(corridor: Corridor, seed: int, path: Path, source: dict[str, object]) -> list[str]:
    remarks: list[str] = []
    try:
        simulate(corridor, seed, remarks.append).save(path, source)
    except (RecordingError, NetconvertError, SumoVersionError, MissingExtraError):
        raise
    except Exception as error:
        cause = f"{type(error).__name__}: {error}"
        raise RecordingError.from_cause(corridor, seed, cause) from error
    return remarks


def _cause(error: BrokenProcessPool) -> str:
    """Return what is known of a worker's death: loky's message has exit codes of all workers."""
    codes = re.search(r"exit codes of the workers are \{(.{1,200}?)\}", str(error))
    return f"a recording process died ({codes[1] if codes else type(error).__name__})"
