"""Shared parts of all commands: arguments, logging, and one line on bad input."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from tqdm.contrib.logging import logging_redirect_tqdm

from agents.environments import parse_env, preset_of, quietly
from agents.executors import AnyExecutor, ExecutorError, ExecutorName, make_executor
from agents.play import PlayError, record
from agents.study import Place
from dptse_env.config import resolve
from dptse_env.traffic import (
    Corridor,
    NetconvertError,
    RecordingError,
    RecordLibrary,
    SumoVersionError,
)
from dptse_env.utils.files import require_writable
from dptse_env.utils.registry import MissingExtraError
from dptse_env.utils.threads import n_cores
from dptse_env.utils.validation import integer


@dataclass(frozen=True)
class Environment:
    """One environment."""

    env: str = "dptse_env:dptse/PaperHighway-v0"
    """Environment: an id, or an id and keywords as JSON, 'ID {"bandwidth": 3}'."""

    def corridor(self) -> Corridor:
        """Return its road.

        Raises:
            ValueError: The environment is unknown, or a keyword is unknown or out of range.
        """
        env, keywords = parse_env(self.env)
        # Traffic does not depend on queries, and a short road may have fewer segments.
        queries = {"bandwidth": 1, "query_spans": [1]} if "corridor" in keywords else {}
        with quietly():
            return resolve(preset_of(env), {**queries, **keywords}).corridor


@dataclass(frozen=True)
class Recording:
    """Processes of this machine, and the folder of records. Results depend on neither."""

    workers: int | None = None
    """Processes on this machine; one for each core if not given."""
    records: Path | None = None
    """Folder of the record cache; the user's if not given."""

    def check(self) -> None:
        """Check them before anything else is done.

        Raises:
            ValueError: A number is out of range, or the folder is none and cannot be made.
        """
        if self.workers is not None:
            integer("workers", self.workers, 1)
        given = self.records
        if given is not None and not os.path.isdir(given):  # noqa: PTH112 (it may be too long)
            require_writable("records", given)

    def library(self, corridor: Corridor, seeds: Sequence[int]) -> RecordLibrary:
        """Return the library of records, after recording what is missing."""
        library = RecordLibrary(self.records)
        record(corridor, seeds, library, progress=True, workers=self.workers)
        return library


@dataclass(frozen=True)
class Machines(Recording):
    """Machines that run tasks. Results do not depend on them."""

    executor: ExecutorName = "local"
    """Place of the tasks: this machine, or a Ray cluster."""
    address: str | None = None
    """Address of the Ray cluster, or auto; see RAY_ADDRESS, too."""

    def start_executor(self) -> AnyExecutor:
        """Return what runs the tasks.

        Raises:
            ExecutorError: There is no suitable cluster.
            MissingExtraError: Ray is not installed.
            ValueError: An argument is out of range or of another executor.
        """
        workers = n_cores() if self.workers is None else self.workers
        return make_executor(self.executor, workers, self.address)

    def place(self, folder: Path) -> Place:
        """Return a folder with the executor that works for it."""
        return Place(folder, self.start_executor(), self.records)


BAD_INPUT = (
    ValueError, FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError,
    PermissionError,
)  # fmt: skip
"""Errors of what a program was given, which end it with status 2 and their message alone."""

FAILURES = (
    OSError, MissingExtraError, NetconvertError, RecordingError, SumoVersionError, ExecutorError,
    PlayError,
)  # fmt: skip
"""Errors of a run, which end a program with status 1 and their message alone."""


def run(
    main: Callable[[Any], None],
    arguments: Any,
    description: str | None,
    *,
    program: str | None = None,
    words: Sequence[str] | None = None,
    resumes: bool = True,
) -> None:
    """Parse the command line into ``arguments`` and call ``main`` with them.

    Bad input ends the program with status 2, and a run that fails with status 1, both with a
    message in one line. Ctrl-C ends it with status 130, and SIGTERM as Ctrl-C does, with status
    143: what runs is ended, and what is half written goes. Any other exception is a mistake of the
    program, and keeps its traceback.

    Args:
        main: The program.
        arguments: A dataclass, or a union of dataclasses for subcommands.
        description: Text for ``--help``: a sentence, and an example in a paragraph of its own.
        program: Name of the program in its help; that of the file if None.
        words: The command line; that of the process if None.
        resumes: Whether the program goes on from what an interrupted run has done.
    """
    logging.basicConfig(format="%(message)s")
    config = (tyro.conf.FlagCreatePairsOff,)
    try:
        given = tyro.cli(
            arguments, prog=program, args=words, description=description, config=config
        )
        with logging_redirect_tqdm(), warnings_told_once(), interrupted_by_sigterm():
            if isinstance(given, Recording):
                given.check()
            main(given)
    except BrokenPipeError:  # an OSError that is no failure; dptse_env.command_line ends it
        raise
    except (*BAD_INPUT, *FAILURES) as problem:
        print(f"error: {_in_words(problem)}", file=sys.stderr)
        raise SystemExit(2 if isinstance(problem, BAD_INPUT) else 1) from problem
    except KeyboardInterrupt as interrupt:
        goes_on = "goes on from what is done" if resumes else "begins anew"
        print(f"\ninterrupted: the same command {goes_on}", file=sys.stderr)
        raise SystemExit(128 + (*interrupt.args, signal.SIGINT)[0]) from None


@contextlib.contextmanager
def interrupted_by_sigterm() -> Iterator[None]:
    """Let SIGTERM, by which schedulers of clusters end programs, be as Ctrl-C."""

    def interrupt(number: int, _: object) -> None:
        raise KeyboardInterrupt(number)

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def warnings_told_once() -> Iterator[None]:
    """Log every warning once, as a line.

    Python's own record of what it has shown is forgotten whenever somebody changes a filter.
    """
    told, before = set(), warnings.showwarning

    def tell(message: Warning | str, *_: Any, **__: Any) -> None:
        text = str(message)
        if text not in told:
            told.add(text)
            logging.getLogger("dptse").warning("warning: %s", text)

    warnings.showwarning = tell
    try:
        yield
    finally:
        warnings.showwarning = before


def _in_words(problem: BaseException) -> str:
    """Return the message of an error; of one of the system without its number."""
    if isinstance(problem, OSError) and problem.strerror and problem.filename:
        return f"{problem.filename}: {problem.strerror}"
    return str(problem)
