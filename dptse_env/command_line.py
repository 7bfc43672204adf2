"""``dptse``: the package's tools as commands, with or without a checkout."""

import importlib
import io
import os
import sys
from pathlib import Path

from dptse_env.tools import add_tools_path
from dptse_env.utils.registry import MissingExtraError, needed_for


def main() -> None:
    """Run the command that the arguments name."""
    add_tools_path()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # it was closed, as with ``>&-``
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A pipe on Windows takes fewer letters than a terminal does.
        sys.stdout.reconfigure(errors="replace")
    # Policies and parts of one's own, "module:Class", are found as by ``python -m``.
    try:
        here = str(Path.cwd())
    except FileNotFoundError:
        print("error: the folder that this runs in is gone: choose another one", file=sys.stderr)
        raise SystemExit(2) from None
    if here not in sys.path:
        sys.path.append(here)
    try:
        with needed_for("dptse"):
            importlib.import_module("scripts.dptse").main(sys.argv[1:])
        sys.stdout.flush()
    except MissingExtraError as problem:
        print(f"error: {problem}", file=sys.stderr)
        raise SystemExit(1) from problem
    except BrokenPipeError:  # the reader of a pipe has seen enough, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    except KeyboardInterrupt:  # while it loads
        print("\ninterrupted before it began", file=sys.stderr)
        raise SystemExit(130) from None
