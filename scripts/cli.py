"""Shared parts of all commands: their options, logging, and one line on bad input."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import logging
import os
import shutil
import signal
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, takewhile
from pathlib import Path
from typing import Annotated, Any, TextIO, cast

import tyro
from rich.table import Table
from tqdm.contrib.logging import logging_redirect_tqdm
from tyro.conf import arg

from agents.environments import parse_env, preset_of, quietly
from agents.executors import Executor, ExecutorError, ExecutorName, make_executor
from agents.play import PlayError, record
from agents.study import Place
from agents.terminal import print_table, told
from dptse_env.config import resolve
from dptse_env.traffic import (
    Corridor,
    NetconvertError,
    RecordingError,
    RecordLibrary,
    SumoVersionError,
)
from dptse_env.utils import progress
from dptse_env.utils.files import require_writable
from dptse_env.utils.registry import MissingExtraError
from dptse_env.utils.threads import n_cores
from dptse_env.utils.validation import integer, require

ROUND = 4
"""Records of each process after which a file is told of them."""

MOST_WORKERS = 10_000
"""Most processes of this machine that may be asked for."""

# Options, one name for one thing in all commands. A command has those that it takes among its
# bases, and gives them defaults of its own.


@dataclass(frozen=True)
class Command:
    """Options of every command."""

    json: bool = False
    """Print JSON, for a program, in place of text."""
    quiet: bool = False
    """Print errors alone, and JSON where it is asked for."""

    def answer(self, found: Any, *parts: str | Table) -> None:
        """Print the result: as JSON, as texts and tables, or not at all."""
        if self.json:
            print(json.dumps(found, indent=2))
        elif not self.quiet:
            for part in parts:
                if isinstance(part, Table):
                    print_table(part)
                else:
                    print(part)

    def remark(self, text: str) -> None:
        """Print a line on what is going on, beside the result."""
        if not self.quiet:
            print(text, file=sys.stderr)

    def require_unset(self, mode: str, *names: str) -> None:
        """Refuse options that do not apply in a mode, such as ``with --tune``.

        Raises:
            ValueError: One of them is not at its default.
        """
        for option in dataclasses.fields(self):
            if option.name in names and getattr(self, option.name) != option.default:
                given = f"--{option.name.replace('_', '-')}"
                raise ValueError(f"{given} must be left out {mode}")


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
class Environments:
    """Several environments."""

    env: tuple[str, ...] = ()
    """Environments: each an id, or an id and keywords as JSON, 'ID {"bandwidth": 3}'."""


@dataclass(frozen=True)
class Policies:
    """Query policies."""

    policies: tuple[str, ...] = ()
    """Query policies: schedules by name, saved policies by file or shipped name, or
    "module:Class"."""


@dataclass(frozen=True)
class Estimators:
    """Estimators."""

    estimators: tuple[str, ...] = ()
    """State estimators by name, or "module:Class"."""


@dataclass(frozen=True)
class TrainSeeds:
    """Traffic for training."""

    train_seeds: str | None = None
    """Traffic seeds to train on, first:stop, of 0 to 999."""


@dataclass(frozen=True)
class ValidationSeeds:
    """Traffic for choices."""

    validation_seeds: str | None = None
    """Traffic seeds to choose on, first:stop, of 1000 to 1999."""


@dataclass(frozen=True)
class TestSeeds:
    """Traffic for results."""

    test_seeds: str | None = None
    """Traffic seeds that nothing was trained or chosen on, first:stop, of 2000 to 2999."""


@dataclass(frozen=True)
class Seed:
    """The seed of all that is drawn beside the traffic."""

    seed: int = 0
    """Seeds what is drawn beside the traffic."""


@dataclass(frozen=True)
class Output:
    """The place of the results."""

    output: Path = Path("results")
    """Folder of the results."""


@dataclass(frozen=True)
class Replacing(Output):
    """The place of results that an earlier run may have left."""

    force: bool = False
    """Replace the results of an earlier run."""


@dataclass(frozen=True)
class Recording:
    """Processes of this machine, and the folder of records. Results depend on neither."""

    workers: Annotated[int | None, arg(metavar="INT")] = None
    """Processes on this machine; one for each core if not given."""
    records: Annotated[Path | None, arg(metavar="PATH")] = None
    """Folder of the record cache; the user's if not given."""

    def check(self) -> None:
        """Check them before anything else is done.

        Raises:
            ValueError: A number is out of range, or the folder is none and cannot be made.
        """
        if self.workers is not None:
            integer("workers", self.workers, 1, MOST_WORKERS)
        given = self.records
        if given is not None and not os.path.isdir(given):  # noqa: PTH112 (it may be too long)
            require_writable("records", given)

    def library(self, corridor: Corridor, seeds: Sequence[int]) -> RecordLibrary:
        """Return the library of records, after recording what is missing."""
        library = RecordLibrary(self.records)
        if not sys.stderr.isatty():  # which a bar is for
            self._record_in_rounds(corridor, library.missing(corridor, seeds), library)
        record(corridor, seeds, library, progress=True, workers=self.workers)
        return library

    def _record_in_rounds(
        self, corridor: Corridor, missing: Sequence[int], library: RecordLibrary
    ) -> None:
        """Record traffic, and tell after every round how much of it there is."""
        size = ROUND * (n_cores() if self.workers is None else self.workers)
        for first in range(0, len(missing) - size, size):
            seeds = missing[first : first + size]
            record(corridor, seeds, library, progress=True, workers=self.workers)
            told.info("recorded %d of %d", first + size, len(missing))


@dataclass(frozen=True)
class Machines(Recording):
    """Machines that run tasks. Results do not depend on them."""

    executor: ExecutorName = "local"
    """Place of the tasks: this machine, or a Ray cluster."""
    address: Annotated[str | None, arg(metavar="STR")] = None
    """Address of the Ray cluster, or auto; see RAY_ADDRESS, too."""

    def start_executor(self) -> Executor:
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


GIVEN = ("traffic_seeds", "records", "threads", "autoreset_mode", "render_mode")
"""Keywords of an environment that a command that plays it gives, or has no use for."""


def require_open(keywords: Mapping[str, Any], *others: str) -> None:
    """Refuse keywords in ``--env`` that would be ignored: `GIVEN`, and others of a command.

    Raises:
        ValueError: There is one.
    """
    for key in (*others, *GIVEN):
        require(key not in keywords, f"env.{key}", "left out", keywords.get(key))


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
    try:
        given = parse(arguments, description, program, words)
        is_quiet = getattr(given, "quiet", False)
        with (
            _said(not is_quiet),
            logging_redirect_tqdm(),
            warnings_told_once(),
            interrupted_by_sigterm(),
        ):
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
def _said(is_said: bool) -> Iterator[None]:
    """Show warnings and progress, or errors alone."""
    root = logging.getLogger()
    before = root.level
    root.setLevel(logging.WARNING if is_said else logging.ERROR)
    told.setLevel(logging.INFO if is_said else logging.ERROR)
    progress.set_quiet(not is_said)
    try:
        yield
    finally:
        root.setLevel(before)
        told.setLevel(logging.NOTSET)
        progress.set_quiet(False)


def parse(
    arguments: Any, description: str | None, program: str | None, words: Sequence[str] | None
) -> Any:
    """Return the arguments that a command line gives; see `run`.

    Raises:
        ValueError: It cannot be parsed; the message is one line.
        SystemExit: It asked for help, which is printed.
    """
    words = sys.argv[1:] if words is None else words
    boxes, folded = io.StringIO(), cast(TextIO, _Folded(sys.stdout))
    try:
        with contextlib.redirect_stdout(folded), contextlib.redirect_stderr(boxes):
            return tyro.cli(
                arguments, prog=program, args=words, description=description,
                config=(tyro.conf.FlagCreatePairsOff,),
            )  # fmt: skip
    except SystemExit as end:
        if not end.code:
            raise
        raise ValueError(_unboxed(boxes.getvalue())) from None


class _Folded:
    """Standard output of help, whose paragraphs are folded to the width of the terminal."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, text: str) -> int:
        width = shutil.get_terminal_size().columns
        folded = (
            # What has colours is a table, which fits already.
            line if len(line) <= width or "\33" in line else textwrap.fill(line, width)
            for line in text.split("\n")
        )
        return self._file.write("\n".join(folded))


def _unboxed(box: str) -> str:
    """Return what a box says of an error, in one line, without the help on options in it."""
    lines = [line.strip("│").removeprefix(" ").rstrip() for line in box.splitlines()]
    said = []
    for is_rule, section in groupby(lines, key=_is_rule):
        first = takewhile(bool, section)  # what follows a blank line are details
        words = " ".join(line.strip() for line in first if not line.startswith(" " * 8))
        if not is_rule and not words.startswith(("For full", "Argument helptext")):
            said.append(words.rstrip("."))
    # Where stdout is not in UTF-8 the title is above a rule, not in it.
    return "; ".join(said if box.startswith("╭") else said[1:])


def _is_rule(line: str) -> bool:
    return line[:1] in ("╭", "─", "╰") or set(line.strip()) == {"-"}


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
    texts, before = set(), warnings.showwarning

    def tell(message: Warning | str, *_: Any, **__: Any) -> None:
        text = str(message)
        if text not in texts:
            texts.add(text)
            told.warning("warning: %s", text)

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
