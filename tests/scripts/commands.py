"""Commands as their users call them, in the process of the test."""

import contextlib
import io
from typing import NamedTuple

from scripts import dptse

ROAD = "n_mainline = 4\nduration = 90\n[demand]\nmainline = [[0, 2400]]\n"
"""A road file."""


class Done(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


def run_command(*words):
    """Run a command line of ``dptse``; return its status and its output as text."""
    out, err, status = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            dptse.main([str(word) for word in words])
        except SystemExit as ended:
            status = ended.code or 0
    return Done(status, out.getvalue(), err.getvalue())


def refused(*words, status=2):
    """Run a command line that must be refused; return its one line."""
    done = run_command(*words)
    assert (done.returncode, done.stdout) == (status, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    return line
