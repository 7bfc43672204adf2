"""A plain process of this interpreter.

Unlike a multiprocessing worker it never imports the caller's ``__main__``, so it works from a
notebook, a pipe or an unguarded script.
"""

import os
import sys
from pathlib import Path


def command(module: str) -> list[str]:
    """Return the command that runs a module of this package."""
    return [sys.executable, "-P", "-m", module]


def environment() -> dict[str, str]:
    """Return this process's environment, with its path of modules.

    The process then finds the same packages in any working directory.
    """
    path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
    return os.environ | {"PYTHONPATH": path}
