"""Runs rows in child processes, one at a time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.throughput.measure import Measured
from benchmarks.throughput.results import Result
from benchmarks.throughput.rows import LONGEST, Row

ROOT = Path(__file__).resolve().parents[2]


class RowError(RuntimeError):
    """A child ended without a result.

    Attributes:
        said: All that it wrote to stderr.
    """

    def __init__(self, message: str, said: str = "") -> None:
        """Keep what the child said beside the message."""
        super().__init__(message)
        self.said = said.strip() or message


def measure(row: Row, seconds: float, limit: float = LONGEST) -> Measured:
    """Measure a row in a process of its own, which is gone when this returns, however it does.

    Raises:
        RowError: The child failed or took longer than ``limit`` [s]; the message says what it said.
    """
    job = json.dumps({"work": row.work, "seconds": seconds, "options": row.options})
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.throughput.child", job],
        cwd=ROOT,
        # One thread unless a row asks for more: BLAS would take all cores otherwise.
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        out, said = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired as late:
        raise RowError(f"took longer than {limit:.0f} s") from late
    finally:
        if process.poll() is None:
            # With its own children: it leads a group.
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    if process.returncode != 0:
        lines = said.strip().splitlines() or [f"ended with code {process.returncode}"]
        raise RowError(lines[-1], said)
    return Measured.from_plain(json.loads(out))


def measure_all(
    rows: Sequence[Row], seconds: float, repeats: int, say: Callable[[str], None]
) -> dict[str, Result]:
    """Measure all rows, then all of them again, so that a drift of the machine shows.

    A row that fails is not tried again, and does not keep the others.
    """
    results = {row.name: Result(row, problem=row.missing) for row in rows}
    for repeat in range(repeats):
        for k, row in enumerate(rows):
            result = results[row.name]
            if result.problem is not None:
                continue
            start = time.monotonic()
            try:
                result.repeats.append(measure(row, seconds))
            except RowError as problem:
                say(problem.said)
                result.problem = f"failed: {problem}"
            place = f"{repeat + 1}/{repeats} {k + 1}/{len(rows)}"
            say(f"{place} {row.name} {time.monotonic() - start:.1f} s")
    return results


def to_plain(result: Result) -> dict[str, object]:
    """Return a result as plain JSON."""
    return {
        "row": result.row.name,
        "work": result.row.work,
        "options": result.row.options,
        "problem": result.problem,
        "repeats": [asdict(one) for one in result.repeats],
    }
