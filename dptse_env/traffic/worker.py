"""Recording in child processes, separate from another simulation or several at once.

The child is a plain process of the interpreter, see `dptse_env.utils.python_process`.

When the parent ends in any way, the child's stdin is closed, and the child ends after the record in
progress.
"""

import contextlib
import json
import logging
import pickle
import queue
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.record import Record
from dptse_env.traffic.sumo import RecordingError
from dptse_env.utils import python_process

ATTEMPTS = 3
"""Attempts to make a record whose worker is killed, for instance for lack of memory. A failure that
the worker reports is final, since the same seed would fail in the same way again."""

logger = logging.getLogger(__name__)


class WorkerDiedError(RecordingError):
    """A child process ended without a result; the message names corridor, seed and exit code."""


class Worker:
    """A child process that records scenarios sequentially."""

    def __init__(self) -> None:
        """Start the child."""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        # Removed with the child, even if it is killed.
        self._folder = tempfile.TemporaryDirectory(prefix="dptse-worker-")
        self._process = subprocess.Popen(
            python_process.command("dptse_env.traffic.child"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=python_process.environment() | {"TMPDIR": self._folder.name},
        )

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """True while the child is running."""
        return self._process.poll() is None

    def record(
        self, corridor: Corridor, seed: int, path: Path, source: Mapping[str, object]
    ) -> None:
        """Record one scenario and save it to `path` (see `Record.save`).

        Raises:
            RecordingError: The recording fails.
            WorkerDiedError: The child dies.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            pickle.dump((corridor, seed, path, dict(source)), self._process.stdin)
            self._process.stdin.flush()
            result = self._process.stdout.readline()
        except BrokenPipeError:
            result = b""
        if not result.endswith(b"\n"):  # the child died before the result was complete
            raise WorkerDiedError.from_cause(corridor, seed, self._cause_of_death())
        failure = json.loads(result)["failure"]
        if failure is not None:
            raise RecordingError(failure)

    def close(self) -> None:
        """Let the child end after the record in progress; closing again does nothing."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # dead already, with a task unread in the pipe
            self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()
        self._errors.close()
        self._folder.cleanup()

    def _cause_of_death(self) -> str:
        code = self._process.wait()
        self._errors.seek(0)
        errors = self._errors.read().decode(errors="replace").strip()[-2000:]
        return f"the recording process ended with code {code}" + (f"\n{errors}" if errors else "")


class WorkerPool(contextlib.AbstractContextManager["WorkerPool"]):
    """Workers for several threads: each recording uses an idle worker, or starts another."""

    def __init__(self) -> None:
        """Make a pool without workers."""
        self._idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()

    def __exit__(self, *_: object) -> None:
        """Close the idle workers; all are idle once every `record` has returned."""
        while not self._idle.empty():
            self._idle.get().close()

    def record(
        self, corridor: Corridor, seed: int, path: Path, source: Mapping[str, object]
    ) -> None:
        """Record in a worker, and again in another one if it dies.

        Raises:
            RecordingError: The recording fails, or `ATTEMPTS` workers in a row died on it.
        """
        for attempt in range(1, ATTEMPTS + 1):
            try:
                self._record_once(corridor, seed, path, source)
                return
            except WorkerDiedError as error:
                if attempt == ATTEMPTS:
                    raise RecordingError(
                        f"{error}\n(tried {ATTEMPTS} times; no worker survived it)"
                    ) from error
                logger.warning("attempt %d of %d: %s", attempt, ATTEMPTS, error)

    def _record_once(
        self, corridor: Corridor, seed: int, path: Path, source: Mapping[str, object]
    ) -> None:
        try:
            worker = self._idle.get_nowait()
        except queue.Empty:
            worker = Worker()
        try:
            worker.record(corridor, seed, path, source)
        finally:
            if worker.alive:
                self._idle.put(worker)
            else:
                worker.close()


def simulate_in_child(corridor: Corridor, seed: int) -> Record:
    """Simulate and record one scenario in a child process; see `dptse_env.traffic.sumo.simulate`.

    Raises:
        RecordingError: The recording fails, or the child dies `ATTEMPTS` times.
    """
    with tempfile.TemporaryDirectory(prefix="dptse-record-") as directory, WorkerPool() as pool:
        path = Path(directory) / "record"
        pool.record(corridor, seed, path, {})
        return Record.load(path, {})
