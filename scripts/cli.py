"""What every script does around its job: arguments, logging, one line on bad input."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from typing import TypeVar

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
