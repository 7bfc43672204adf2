"""Time of an estimator's step: compiled, the reference, and filterpy's.

python benchmarks/bench_estimators.py

A step is `predict` and `update` of one episode, 28 outputs, on one core; all rows are measured in
turns in one run. Compare the ratios: absolute times drift between machines and moments.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass, replace

from agents.figures import LABELS
from agents.terminal import make_table, print_table
from benchmarks.peers import FILTERS, FilterPeer
from benchmarks.replay import recorded
from benchmarks.steps import REFERENCES, Row, Steps, step_times
from dptse_env.config import parse_seeds
from scripts.cli import run


@dataclass(frozen=True)
class Args:
    """Time a step of each estimator."""

    parameters: str = "w99-3lane"
    """ARZ parameter set."""
    traffic_seeds: str = "0:4"
    """Traffic seeds of the episodes, first:stop; single episodes replay the first."""
    queried: int = 11
    """Segments queried a step beside the three with a sensor."""
    batch: int = 64
    """Episodes in a batch."""
    steps: int = 700
    """Steps of an episode, from the empty road on."""
    block: int = 50
    """Steps of one row before the next one has its turn."""
    passes: int = 3
    """Times that all rows go through the steps."""
    quick: bool = False
    """Smallest sizes: whether it runs, not how fast."""


AIMS = {"ekf": (20.0, 14.0), "ukf": (60.0, 50.0), "enkf": (120.0, 90.0), "mhe": (700.0, 200.0)}
"""Target and more ambitious goal for a compiled step of each estimator [us]."""


def measure(args: Args) -> dict[str, dict[str, float]]:
    """Return the mean time of a step [us] by estimator and row."""
    seeds = parse_seeds(args.traffic_seeds, "traffic_seeds")
    replay = recorded(args.parameters, seeds, args.batch, args.queried, args.steps)
    alone = replay.first(1)
    rows: dict[str, dict[str, Row]] = {}
    for name in AIMS:
        rows[name] = {
            "compiled, one episode": Steps(name, "compiled", alone),
            f"compiled, batch of {args.batch}": Steps(name, "compiled", replay),
        }
        if name in REFERENCES:
            rows[name]["reference"] = Steps(name, "reference", alone)
        if name in FILTERS:
            rows[name]["filterpy"] = FilterPeer(name, alone, args.block)
    named = {f"{name}, {label}": row for name in rows for label, row in rows[name].items()}
    times = step_times(named, args.steps, args.block, args.passes)
    return {
        name: {label: float(times[f"{name}, {label}"].mean()) for label in rows[name]}
        for name in rows
    }


def main(args: Args) -> None:
    """Measure and print; the ratio is to filterpy, or to the reference where that is the peer."""
    if args.quick:
        args = replace(args, traffic_seeds="0:1", batch=2, steps=16, block=8, passes=1)
    columns = ("us/step", "peer / it", "target", "", "goal", "")
    table = make_table("time of a step", "estimator", "", *columns, left=2)
    for name, times in measure(args).items():
        peer = times["filterpy" if name in FILTERS else "reference"]
        for label, time in times.items():
            aims = AIMS[name] if label.startswith("compiled") else ()
            judged = [text for aim in aims for text in (f"{aim:g}", "met" if time <= aim else "no")]
            table.add_row(LABELS[name], label, f"{time:.1f}", f"{peer / time:.2f}", *judged)
        table.add_section()
    print_table(table)


if __name__ == "__main__":
    run(main, Args, __doc__)
