"""Compiling in other processes what this one will need next, and taking turns at it.

numba's compiler holds a lock of its process, so that threads do not help. A few processes compile
the functions of a list, see `dptse_env.utils.kernel_list`, and keep them on disk, where this one
finds them. They are started at the first of these functions that is not on disk, where more than
one core is usable, and by one process at a time.

When the process that started them ends in any way, their stdin is closed, and they end too.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from dptse_env.utils import kernel_list, python_process
from dptse_env.utils.registry import name_of_class
from dptse_env.utils.threads import n_cores

logger = logging.getLogger(__name__)

PROCESSES_VARIABLE = "DPTSE_COMPILE_PROCESSES"
"""Environment variable: how many processes compile ahead, 0 for none."""

MOST_PROCESSES = 3
"""Processes that are started at most by default."""

LONGEST_WAIT = 180.0
"""Seconds to wait for a function that another process compiles; none takes more than 25 s."""

SILENT_WAIT = 1.0
"""Seconds to wait before saying so."""

CHILD = "dptse_env.utils.compile_child"

_expected: list[str] = []
_unlocked: set[Path] = set()


def expect(estimator: str) -> None:
    """Say that the functions of an estimator's list will be needed."""
    if estimator not in _expected:
        _expected.append(estimator)


def is_taken(function: Callable[..., Any], folder: Path) -> bool:
    """Return whether another process is compiling a function."""
    lock = _lock_of(function, folder)
    if not _taken(lock, 0.0):
        return True
    lock.release()
    return False


def take_turn(function: Callable[..., Any], folder: Path, wait: float = LONGEST_WAIT) -> Any:
    """Return the lock of a function once no other process has it.

    After `wait` seconds it is returned all the same, not taken, since compiling a function twice
    loses time only.
    """
    lock, path = _lock_of(function, folder), name_of_class(function)
    if not _taken(lock, min(SILENT_WAIT, wait)):
        logger.warning("Waiting for another process, which compiles %s", path)
        if not _taken(lock, wait):
            logger.warning("It has not ended after %g s; compiling %s here too", wait, path)
    return lock


def start(function: Callable[..., Any], signature: Any, folder: Path) -> None:
    """Start processes where a function that has to be compiled is one of those expected."""
    n_processes = _n_processes()
    if n_processes == 0:
        return
    missing = kernel_list.Listed(name_of_class(function), tuple(signature))
    for estimator in _expected:
        if missing in kernel_list.listed(estimator):
            _expected.remove(estimator)
            _start(estimator, n_processes, folder)
            return


def _start(estimator: str, n_processes: int, folder: Path) -> None:
    lock = _lock(folder / "compile_ahead.lock")
    if not _taken(lock, 0.0):  # another process has started some
        return
    logger.warning(
        "Compiling what %r needs next in %d more process%s",
        estimator, n_processes, "" if n_processes == 1 else "es",
    )  # fmt: skip
    children = [_Child(estimator) for _ in range(n_processes)]

    def accompany() -> None:
        try:
            for child in children:
                child.wait()
        finally:
            lock.release()

    # A daemon, so that this process can end while they compile.
    threading.Thread(target=accompany, name="dptse-compile-ahead", daemon=True).start()


class _Child:
    """A process that compiles the functions of a list."""

    def __init__(self, estimator: str) -> None:
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [*python_process.command(CHILD), estimator],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            env=python_process.environment(),
        )

    def wait(self) -> None:
        """Wait for the end, and say so where it failed."""
        code = self._process.wait()
        assert self._process.stdin is not None
        self._process.stdin.close()
        with self._errors:
            if code != 0:
                self._errors.seek(0)
                errors = self._errors.read().decode(errors="replace").strip()[-2000:]
                message = "A process that compiled ahead ended with code %d; going on without it"
                logger.warning(f"{message}\n%s", code, errors)


def _n_processes() -> int:
    """Return how many processes to start.

    Raises:
        ValueError: The environment variable is not a whole number of 0 or more.
    """
    asked = os.environ.get(PROCESSES_VARIABLE)
    if asked is not None:
        if not asked.isdecimal():
            raise ValueError(f"{PROCESSES_VARIABLE} must be a whole number >= 0, got {asked!r}")
        return int(asked)
    # The executable of a frozen application is the application.
    if not sys.executable or getattr(sys, "frozen", False):
        return 0
    return min(n_cores() - 1, MOST_PROCESSES)


def _lock_of(function: Callable[..., Any], folder: Path) -> Any:
    return _lock(folder / f"{function.__module__}.{function.__qualname__}.lock")


def _lock(path: Path) -> Any:
    from filelock import FileLock  # noqa: PLC0415  (slow to import)

    return FileLock(path, thread_local=False)


def _taken(lock: Any, wait: float) -> bool:
    """Try to take a lock for some seconds; return whether no other process has it."""
    from filelock import Timeout  # noqa: PLC0415  (slow to import)

    try:
        lock.acquire(timeout=wait)
    except Timeout:
        return False
    except (OSError, NotImplementedError) as error:
        _say_unlocked(Path(lock.lock_file).parent, error)
    return True


def _say_unlocked(folder: Path, error: Exception) -> None:
    """Say once that a folder, whose file system may have no locks, takes none."""
    if folder not in _unlocked:
        _unlocked.add(folder)
        message = "%s takes no locks (%s); processes may compile the same function there"
        logger.warning(message, folder, error)
