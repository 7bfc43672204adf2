"""Recording in child processes: for isolation from another simulation, and for many at once.

The child is a plain ``python -m dptse_env.traffic.child``. Unlike a multiprocessing worker it never
imports the caller's ``__main__``, so it works from a notebook, a pipe or an unguarded script.

No child outlives its parent for long: when the parent goes, however it does, the child's stdin
ends, and the child with it after the record it is making.
"""

import contextlib
import json
import logging
import os
import pickle
import queue
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.record import Record
from dptse_env.traffic.sumo import RecordingError

ATTEMPTS = 3
"""How often a record is tried whose worker is killed each time, by a lack of memory for instance.
A failure that the worker reports is final: the same seed would fail in the same way again."""

logger = logging.getLogger(__name__)


class WorkerDiedError(RecordingError):
    """A child process ended without an answer; the message names corridor, seed and exit code."""


class Worker:
    """A child process that records scenarios one after another."""

    def __init__(self) -> None:
        """Start the child."""
        # The parent's own path, so that the child finds the same packages wherever it stands.
        path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
        # Open as long as the child lives.
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        # The child's temporary files go with it, even if it is killed.
        self._folder = tempfile.TemporaryDirectory(prefix="dptse-worker-")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "dptse_env.traffic.child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=os.environ | {"PYTHONPATH": path, "TMPDIR": self._folder.name},
        )

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the child is still running."""
        return self._process.poll() is None

    def record(
        self, corridor: Corridor, seed: int, path: Path, source: Mapping[str, object]
    ) -> None:
        """Record one scenario and save it to `path` (see `Record.save`).

        Raises:
            RecordingError: if the recording fails.
            WorkerDiedError: if the child dies.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            pickle.dump((corridor, seed, path, dict(source)), self._process.stdin)
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = b""
        if not answer.endswith(b"\n"):  # the child died before, or while, it answered
            raise WorkerDiedError.from_cause(corridor, seed, self._last_words())
        failure = json.loads(answer)["failure"]
        if failure is not None:
            raise RecordingError(failure)

    def close(self) -> None:
        """Let the child end; it finishes what it is writing. Closing twice is fine."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # dead already, with a task unread in the pipe
            self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()
        self._errors.close()
        self._folder.cleanup()

    def _last_words(self) -> str:
        code = self._process.wait()
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip()[-2000:]
        return f"the recording process ended with code {code}" + (f"\n{said}" if said else "")


class WorkerPool:
    """Workers for several threads: each recording borrows an idle one, or starts another."""

    def __init__(self) -> None:
        """Start nothing yet."""
        self._idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()

    def __enter__(self) -> "WorkerPool":
        """Enter."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Let the idle workers end; all are idle once every `record` has returned."""
        while not self._idle.empty():
            self._idle.get().close()

    def record(
        self, corridor: Corridor, seed: int, path: Path, source: Mapping[str, object]
    ) -> None:
        """Record in some worker, and again in another one if it dies.

        Raises:
            RecordingError: if the recording fails, or `ATTEMPTS` workers in a row died on it.
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
    """Do what `dptse_env.traffic.sumo.simulate` does, in a child process.

    Raises:
        RecordingError: if the recording fails, or the child dies `ATTEMPTS` times.
    """
    with tempfile.TemporaryDirectory(prefix="dptse-record-") as directory, WorkerPool() as pool:
        path = Path(directory) / "record"
        pool.record(corridor, seed, path, {})
        record = Record.load(path, {})
        # Off the files, which vanish with the directory.
        return record.in_memory()
