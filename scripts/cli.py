"""What every script does around its job: arguments, logging, one line on bad input."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import sys
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import tyro

from dptse_env.traffic import NetworkError, RecordingError, SumoVersionError

ArgsT = TypeVar("ArgsT")


def run(main: Callable[[ArgsT], None], arguments: type[ArgsT], description: str | None) -> None:
    """Parse the command line into ``arguments`` and call ``main`` with them.

    Bad input, a file that cannot be read or written and a failed recording end the program with
    status 2 and their one message; anything else is a fault of the program and keeps its traceback.
    """
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    args = tyro.cli(arguments, description=description)
    try:
        main(args)
    except (OSError, ValueError, NetworkError, RecordingError, SumoVersionError) as problem:
        print(f"error: {problem}", file=sys.stderr)
        raise SystemExit(2) from problem


@contextlib.contextmanager
def resumable() -> Iterator[None]:
    """End with status 130 on Ctrl-C in the body, and say that the program can be gone on with."""
    try:
        yield
    except KeyboardInterrupt:
        print("interrupted: the same command goes on from here", file=sys.stderr)
        raise SystemExit(130) from None


def command(script: str, args: Any) -> str:
    """Return the command that makes the same results, whatever the machine and the folder.

    Args:
        script: Name of the script.
        args: Its arguments, a dataclass; those that are not at their default are named.
    """
    words = [f"python scripts/{script}.py"]
    for field in dataclasses.fields(args):
        value = getattr(args, field.name)
        if value == field.default or field.name in ("workers", "records", "output"):
            continue
        words.append("--" + field.name.replace("_", "-"))
        if value is not True:
            words += map(str, value) if isinstance(value, tuple) else [str(value)]
    return " ".join(words)
