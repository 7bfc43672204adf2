"""Scripts as their users call them, in the process of the test."""

import contextlib
import importlib
import io
from pathlib import Path
from typing import NamedTuple

from scripts.cli import run

ROOT = Path(__file__).parents[2]


class Done(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


def run_script(name, *words):
    """Run a script with the words of a command line; return its status and its output as text."""
    module = importlib.import_module(f"scripts.{name.removesuffix('.py')}")
    out, err, status = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            run(module.main, module.Args, module.__doc__, program=name, words=words)
        except SystemExit as ended:
            status = ended.code or 0
    return Done(status, out.getvalue(), err.getvalue())


def refused(name, *words, status=2):
    """Run a script that must refuse its words; return its one line."""
    done = run_script(name, *map(str, words))
    assert (done.returncode, done.stdout) == (status, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    return line
