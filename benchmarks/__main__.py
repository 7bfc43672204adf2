"""Times of a step: estimators, environments, learning and long roads beside their peers.

python -m benchmarks --parts estimators

Each part runs in a process of its own, and what it compares takes turns there. Nothing else should
run beside them.
"""

from __future__ import annotations

import platform
import traceback
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Literal, get_args

from agents.tables import markdown
from benchmarks.turns import HEADER, Line, as_cells, measure, show
from dptse_env.utils.files import write_atomically
from dptse_env.utils.threads import n_cores
from dptse_env.versions import versions_with
from scripts.cli import run

Part = Literal["estimators", "environment", "learning", "long_roads"]
PACKAGES = ("libsumo", "gymnasium", "numba", "numpy", "stable-baselines3")


@dataclass(frozen=True)
class Args:
    """Measure and print a table for each part."""

    parts: tuple[Part, ...] = get_args(Part)
    """Parts to measure."""
    output: Path | None = None
    """File for one table of all parts, as Markdown."""
    quick: bool = False
    """Smallest sizes: whether it runs, not how fast it is."""


def main(args: Args) -> None:
    """Measure, and print and write what there is after each part.

    Raises:
        SystemExit: A part failed; the others were measured.
    """
    versions = ", ".join(map(" ".join, versions_with(*PACKAGES).items()))
    title = f"Python {platform.python_version()}, {n_cores()} cores; {versions}"
    if args.output is not None:
        args.output.parent.mkdir(parents=True, exist_ok=True)
    lines: list[Line] = []
    failed: list[str] = []
    for part in args.parts:
        try:
            with ProcessPoolExecutor(1, get_context("spawn")) as alone:
                measured = alone.submit(measure, part, args.quick).result()
        except Exception:
            traceback.print_exc()
            failed.append(part)
            continue
        show(f"{part}: {title}", measured)
        lines += measured
        if args.output is not None:
            table = markdown(HEADER, map(as_cells, lines), ":--", "--:")
            write_atomically(args.output, f"# Time of a step\n\n{title}\n\n{table}\n")
    if failed:
        raise SystemExit(f"error: {', '.join(failed)} failed, see above")


if __name__ == "__main__":
    run(main, Args, __doc__)
