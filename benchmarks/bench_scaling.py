"""Time of an estimator's step on roads of growing length.

python benchmarks/bench_scaling.py

A step is `predict` and `update` of one episode on one core, a third of the mainline segments
queried. All roads and estimators are measured in turns in one run. The exponent is the slope of a
line fitted to the logarithms of time and length: 1 where a road twice as long costs twice as much.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass, replace

import numpy as np

from agents.figures import LABELS
from agents.terminal import make_table, print_table
from benchmarks.long_roads import long_road
from benchmarks.replay import replay_of
from benchmarks.steps import Row, Steps, step_times
from dptse_env.config import EnvConfig
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.arrays import FloatArray
from scripts.cli import run

WARM_UP = 300  # [s] of the record, while the road fills
ESTIMATORS = ("ekf", "ukf", "enkf", "mhe", "recurrent")


@dataclass(frozen=True)
class Args:
    """Time a step of each estimator on roads of several lengths."""

    estimators: tuple[str, ...] = ESTIMATORS
    """Estimators to measure."""
    lengths: tuple[int, ...] = (30, 60, 120, 200)
    """Mainline segments of the roads, ascending."""
    parameters: str = "w99-3lane"
    """ARZ parameter set."""
    steps: int = 100
    """Steps of an episode."""
    block: int = 10
    """Steps of one row before the next one has its turn."""
    passes: int = 3
    """Times that all rows go through the steps."""
    quick: bool = False
    """Smallest sizes: whether it runs, not how fast."""


def measure(args: Args) -> dict[str, FloatArray]:
    """Return the time of a step [us] by estimator, on each road."""
    rows: dict[str, Row] = {}
    for n in args.lengths:
        corridor = long_road(n)
        RecordLibrary().ensure(corridor, (0,))
        config = EnvConfig(
            corridor=corridor, parameters=args.parameters, bandwidth=n // 3, traffic_seeds=(0,)
        )
        replay = replay_of(config, 1, args.steps, WARM_UP)
        settings = replace(
            replay.settings,
            recurrent=replace(replay.settings.recurrent, outside=True),
        )
        for name in args.estimators:
            rows[f"{name} {n}"] = Steps(name, "compiled", replace(replay, settings=settings))
    times = step_times(rows, args.steps, args.block, args.passes)
    return {
        name: np.array([np.median(times[f"{name} {n}"]) for n in args.lengths])
        for name in args.estimators
    }


def exponent(lengths: tuple[int, ...], times: FloatArray) -> float:
    """Return the slope of a line fitted to the logarithms of times and lengths."""
    return float(np.polyfit(np.log(lengths), np.log(times), 1)[0])


def main(args: Args) -> None:
    """Measure and print."""
    if args.quick:
        args = replace(args, lengths=(12, 18), steps=6, block=3, passes=1)
    columns = [f"S = {n}" for n in args.lengths]
    columns = [f"us/step, {columns[0]}", *columns[1:], "exponent"]
    title = f"time of a step as a ratio to S = {args.lengths[0]}"
    table = make_table(title, "estimator", *columns, left=1)
    for name, times in measure(args).items():
        ratios = [f"{ratio:.2f}" for ratio in times[1:] / times[0]]
        found = f"{exponent(args.lengths, times):.2f}"
        table.add_row(LABELS[name], f"{times[0]:.0f}", *ratios, found)
    print_table(table)


if __name__ == "__main__":
    run(main, Args, __doc__)
