"""Times of a step: estimators, environments, learning, long roads and streams beside their peers.

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
from agents.terminal import make_table
from benchmarks.turns import HEADER, Row, measure
from dptse_env.utils.files import write_atomically
from dptse_env.utils.threads import n_cores
from dptse_env.versions import versions_with
from scripts.cli import Command, run

Part = Literal["estimators", "environment", "learning", "long_roads", "stream"]
PACKAGES = ("libsumo", "gymnasium", "numba", "numpy", "stable-baselines3")


@dataclass(frozen=True, kw_only=True)
class Args(Command):
    """Measure and print a table of each part."""

    parts: tuple[Part, ...] = get_args(Part)
    """Parts to measure."""
    output: Path | None = None
    """Folder of one table of all parts, tables.md; none is written if not given."""
    quick: bool = False
    """Smallest sizes: whether it runs, not how fast it is."""


def main(args: Args) -> None:
    """Measure, and print and write what there is after each part.

    Raises:
        SystemExit: A part failed; the others were measured.
    """
    versions = ", ".join(map(" ".join, versions_with(*PACKAGES).items()))
    title = f"Python {platform.python_version()}, {n_cores()} cores; {versions}"
    measured: list[Row] = []
    failed: list[str] = []
    for part in args.parts:
        try:
            with ProcessPoolExecutor(1, get_context("spawn")) as alone:
                rows = alone.submit(measure, part, args.quick).result()
        except Exception:
            traceback.print_exc()
            failed.append(part)
            continue
        if not args.json:  # one document comes at the end
            args.answer(rows, make_table(f"{part}: {title}", *HEADER, rows=rows))
        measured += rows
        if args.output is not None:
            args.output.mkdir(parents=True, exist_ok=True)
            table = f"# Time of a step\n\n{title}\n\n{markdown(HEADER, measured, ':--', '--:')}\n"
            write_atomically(args.output / "tables.md", table)
    if args.json:
        args.answer(measured)
    if failed:
        raise SystemExit(f"error: {', '.join(failed)} failed, see above")


if __name__ == "__main__":
    run(main, Args, __doc__)
