"""Environment steps a second: SUMO, its records, one episode, thousands, PPO, and peers.

python benchmarks/bench_throughput.py

Prints the tables and writes them to `results/throughput`. Rows run one at a time, each in a
separate process; nothing else should run beside them.
"""

from __future__ import annotations

import json
import platform
import signal
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

from benchmarks.throughput import tables
from benchmarks.throughput.children import measure_all
from benchmarks.throughput.results import Results
from benchmarks.throughput.rows import HORIZON, QUICK, Row, Sizes, catalogue, chosen
from dptse_env.config import PRESETS, parse_seeds
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.threads import n_cores
from scripts.cli import run

PRESET_OF = {"PaperHighway": "paper-highway", "PrivateHighway": "private-highway"}


@dataclass(frozen=True)
class Args:
    """Measure and write the table of throughput."""

    rows: tuple[str, ...] = ()
    """Rows to measure, by name or pattern (vector-ekf-*); all of them if not given."""
    repeats: int = 2
    """Times that the whole list is measured."""
    seconds: float = 1.5
    """Time that a row's turns take [s], beside its start."""
    output: Path = Path("results/throughput")
    """Folder of tables.md, throughput.csv and throughput.json."""
    quick: bool = False
    """Fewer rows, records and repeats: whether it runs, not how fast."""


def record(rows: list[Row]) -> None:
    """Record the traffic of rows that is not there yet, off the clock."""
    for row in rows:
        name = PRESET_OF.get(row.options.get("preset", ""))
        if name is not None:
            seeds = parse_seeds(row.options["traffic_seeds"])
            RecordLibrary().ensure(PRESETS[name].corridor, seeds, progress=True)


def report(results: Results, repeats: int) -> str:
    """Return all tables and their origin."""
    packages = ("dptse-env", "libsumo", "gymnasium", "numba", "numpy", "stable-baselines3")
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    machine = f"Python {platform.python_version()}, {n_cores()} cores ({platform.machine()})"
    problems = [f"- {name}: {found.problem}" for name, found in results.items() if found.problem]
    return "\n\n".join(
        [
            "## In short",
            tables.summary(results),
            "## Many episodes in one process",
            tables.vectorised(results),
            "## All other rows",
            tables.remaining(results),
            *(["## Not measured", "\n".join(problems)] if problems else []),
            f"Measured {repeats} times, episodes of {HORIZON} s; {machine}; {versions}.\n",
        ]
    )


def main(args: Args) -> None:
    """Measure, print and write; status 1 if a row has no result."""
    if args.repeats < 1 or args.seconds <= 0.0:
        raise ValueError(
            f"repeats and seconds must be positive, got {args.repeats} and {args.seconds}"
        )
    # So that a child is ended with this process.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    rows = chosen(list(catalogue(QUICK if args.quick else Sizes())), args.rows)
    repeats, seconds = (1, 0.3) if args.quick else (args.repeats, args.seconds)
    for row in rows:
        if row.missing:
            print(f"{row.name}: {row.missing}", file=sys.stderr)
    record(rows)
    results = measure_all(rows, seconds, repeats, lambda line: print(line, file=sys.stderr))
    text = report(results, repeats)
    print(text)
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "tables.md").write_text(text, encoding="utf-8")
    tables.write_csv(args.output / "throughput.csv", results)
    plain = [
        {"row": each.row.name, "work": each.row.work, "options": each.row.options,
         "problem": each.problem, "repeats": [asdict(measured) for measured in each.repeats]}
        for each in results.values()
    ]  # fmt: skip
    content = json.dumps(plain, indent=1) + "\n"
    (args.output / "throughput.json").write_text(content, encoding="utf-8")
    if any(result.problem for result in results.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    run(main, Args, __doc__)
