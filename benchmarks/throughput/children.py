"""Rows measured in child processes, one at a time.

The child is this module, `python -m benchmarks.throughput.children JOB`. JOB is JSON with ``work``
(``module:function`` of this package), ``seconds`` and ``options``. The result goes to stdout as
JSON; the output of libraries goes to stderr.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.throughput.measure import Measured
from benchmarks.throughput.results import Result
from benchmarks.throughput.rows import LONGEST, Row


class RowError(RuntimeError):
    """A child ended without a result; the last line of the message is the cause."""


def measure(row: Row, seconds: float, limit: float = LONGEST) -> Measured:
    """Measure a row in a separate process.

    Raises:
        RowError: The child failed or took longer than ``limit`` [s].
    """
    job = json.dumps({"work": row.work, "seconds": seconds, "options": row.options})
    try:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.throughput.children", job],
            cwd=Path(__file__).resolve().parents[2],
            # One thread unless a row sets more: BLAS would take all cores otherwise.
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True, timeout=limit,
        )  # fmt: skip
    except subprocess.TimeoutExpired as late:
        raise RowError(f"took longer than {limit:.0f} s") from late
    except subprocess.CalledProcessError as failed:
        code = f"ended with code {failed.returncode}"
        raise RowError(failed.stderr.strip() or code) from failed
    return Measured.from_plain(json.loads(done.stdout))


def measure_all(
    rows: Sequence[Row], seconds: float, repeats: int, log: Callable[[str], None]
) -> dict[str, Result]:
    """Measure all rows, then all of them again, so that a drift of the machine shows.

    A row that fails is not tried again, and does not keep the rest from being measured.
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
                log(str(problem))
                result.problem = f"failed: {str(problem).splitlines()[-1]}"
            place = f"{repeat + 1}/{repeats} {k + 1}/{len(rows)}"
            log(f"{place} {row.name} {time.monotonic() - start:.1f} s")
    return results


def main() -> None:
    """Do the job of the command line, in the child."""
    job = json.loads(sys.argv[1])
    answer = os.dup(1)
    os.dup2(2, 1)
    module, function = job["work"].split(":")
    work = getattr(importlib.import_module(f"benchmarks.throughput.{module}"), function)
    measured = work(job["seconds"], **job["options"])
    with os.fdopen(answer, "w") as out:
        out.write(json.dumps(asdict(measured)) + "\n")


if __name__ == "__main__":
    main()
