"""Shared parts of all scripts: arguments, logging, and one line on bad input."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import tyro

from agents.environments import given_keywords
from agents.executors import AnyExecutor, ExecutorError, ExecutorName, make_executor
from agents.play import Cell, PlayError, record
from agents.study import Place
from dptse_env.config import resolve
from dptse_env.traffic import (
    Corridor,
    NetworkError,
    RecordingError,
    RecordLibrary,
    SumoVersionError,
)
from dptse_env.utils.registry import MissingExtraError
from dptse_env.utils.threads import n_cores


@dataclass(frozen=True)
class Recording:
    """Processes of this machine, and the folder of records. Results depend on neither."""

    workers: int | None = None
    """Processes of this machine; one for each core if not given."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""

    def library(self, corridor: Corridor, seeds: Sequence[int]) -> RecordLibrary:
        """Return the library of records, after recording what is missing."""
        library = RecordLibrary(self.records)
        record(corridor, seeds, library, progress=True, workers=self.workers)
        return library


@dataclass(frozen=True)
class Machines(Recording):
    """Machines that run tasks. Results do not depend on them."""

    executor: ExecutorName = "local"
    """Where tasks run: in processes of this machine (local), or on a Ray cluster (ray)."""
    address: str | None = None
    """Address of the Ray cluster, host:port of its head node, or auto for the one on this machine;
    RAY_ADDRESS if not given, or else a new one on this machine."""

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


@dataclass(frozen=True)
class Road:
    """An environment and its road."""

    corridor: str | None = None
    """Corridor: the name of a shipped one, a road file that ends in .toml, or a JSON object of
    fields that replace those of the environment's corridor; the environment's own if not given."""
    env: str = "dptse_env:dptse/PaperHighway-v0"
    """Environment id."""
    keywords: str = "{}"
    """Keywords of the environment as JSON, such as '{"incident": "random"}'."""

    def given_keywords(self) -> dict[str, Any]:
        """Return the keywords of the environment, with the corridor if one is given."""
        return given_keywords(self.keywords, self.corridor)


BAD_INPUT = (
    ValueError, FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError,
    PermissionError,
)  # fmt: skip
"""Errors of what a program was given, which end it with status 2 and their message alone."""

FAILURES = (
    OSError, MissingExtraError, NetworkError, RecordingError, SumoVersionError, ExecutorError,
    PlayError,
)  # fmt: skip
"""Errors of a run, which end a program with status 1 and their message alone."""

NOT_RESULTS = ("executor", "address", "workers", "records", "output", "json", "force")
"""Arguments that results do not depend on."""


def run(
    main: Callable[[Any], None],
    arguments: Any,
    description: str | None,
    *,
    program: str | None = None,
    words: Sequence[str] | None = None,
) -> None:
    """Parse the command line into ``arguments`` and call ``main`` with them.

    Bad input ends the program with status 2, and a run that fails with status 1, both with a
    message in one line. Ctrl-C ends it with status 130. Any other exception is a mistake of the
    program, and keeps its traceback.

    Args:
        main: The program.
        arguments: A dataclass, or a union of dataclasses for subcommands.
        description: Text for ``--help``.
        program: Name of the program in its help; that of the file if None.
        words: The command line; that of the process if None.
    """
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    # Examples stand in lines of their own; the help would run them together.
    description = re.sub(r"\n(?=python |dptse )", "\n\n", description or "")
    try:
        main(tyro.cli(arguments, prog=program, args=words, description=description))
    except (*BAD_INPUT, *FAILURES) as problem:
        print(f"error: {_in_words(problem)}", file=sys.stderr)
        raise SystemExit(2 if isinstance(problem, BAD_INPUT) else 1) from problem
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None


def _in_words(problem: BaseException) -> str:
    """Return the message of an error; of one of the system without its number."""
    if isinstance(problem, OSError) and problem.strerror and problem.filename:
        return f"{problem.filename}: {problem.strerror}"
    return str(problem)


@contextlib.contextmanager
def resumable() -> Iterator[None]:
    """End with status 130 on Ctrl-C in the body, and print how to resume the program."""
    try:
        yield
    except KeyboardInterrupt:
        print("interrupted: the same command goes on from here", file=sys.stderr)
        raise SystemExit(130) from None


def command(script: str, args: Any) -> str:
    """Return the command that makes the same results, whatever the machine and the folder.

    Args:
        script: Name of the script, with its subcommands.
        args: Its arguments, a dataclass; fields may be dataclasses of more arguments.
    """
    return " ".join([f"python scripts/{script}", *_words(args)])


def _words(args: Any) -> Iterator[str]:
    """Yield the arguments that are not at their default."""
    for field in dataclasses.fields(args):
        value = getattr(args, field.name)
        if dataclasses.is_dataclass(value):
            yield from _words(value)
        elif value != field.default and field.name not in NOT_RESULTS:
            yield "--" + field.name.replace("_", "-")
            if value is not True:
                values = value if isinstance(value, tuple) else (value,)
                yield from (shlex.quote(str(each)) for each in values)


def make_corridor(env: str, keywords: Mapping[str, Any]) -> Corridor:
    """Return the corridor of an environment with some keywords.

    Raises:
        ValueError: A field or keyword is unknown or out of range.
    """
    # Traffic does not depend on queries, and a short road may have fewer segments.
    queries = {"bandwidth": 1, "query_spans": [1]} if "corridor" in keywords else {}
    given = {**queries, **keywords}
    with warnings.catch_warnings():
        # They are about the guarantee and the estimator; only the corridor is wanted.
        warnings.simplefilter("ignore", UserWarning)
        return resolve(gym.spec(env.rpartition(":")[2]).kwargs["preset"], given).corridor


def suitable(cells: Sequence[Cell], what: str) -> tuple[Cell, ...]:
    """Return the cells that can be played, and say how many do not suit what was given, and why.

    Raises:
        FileNotFoundError: There is no such policy.
        ValueError: None can be played.
    """
    taken, refused = [], []
    for cell in cells:
        try:
            cell.check()
        except ValueError as problem:
            refused.append(problem)
        else:
            taken.append(cell)
    if not taken:
        raise refused[0]
    if refused:
        n = f"{len(refused)} of {len(cells)} cells"
        print(f"{n} do not suit {what} and are left out: {refused[0]}", file=sys.stderr)
    return tuple(taken)
