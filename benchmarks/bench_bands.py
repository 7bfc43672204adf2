"""Error and time of filters with bands of several widths, on recorded traffic of a long road.

python benchmarks/bench_bands.py

The road is that of `benchmarks.long_roads`, the environment ``dptse/PrivateHighway-v1`` otherwise,
queried round robin. Errors are means over the seconds after the warm-up of the root mean square
errors over the mainline. All filters see the same traffic, and under ``paper`` the same releases;
under ``paced`` these depend on what a filter predicts.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from agents.terminal import make_table, print_table
from benchmarks.long_roads import long_road
from dptse_env.config import parse_seeds
from dptse_env.schedules import make_schedule
from scripts.cli import run

WARM_UP = 300  # [s]
ID = "dptse_env:dptse/PrivateHighway-v1"


@dataclass(frozen=True)
class Args:
    """Measure the error of a filter by the width of its band."""

    estimators: tuple[str, ...] = ("ekf", "ukf")
    """Filters."""
    bands: tuple[int, ...] = (2, 4, 6, 10, 15)
    """Bands [segments]; the filter without one comes first."""
    length: int = 60
    """Mainline segments of the road."""
    queried: int = 20
    """Segments queried a second."""
    privacy: str = "paper"
    """Release model."""
    parameters: str = "w99-3lane"
    """ARZ parameter set."""
    traffic_seeds: str = "0:3"
    """Traffic seeds, first:stop."""
    quick: bool = False
    """Smallest sizes: whether it runs, not what the errors are."""


def measure(args: Args, estimator: str, band: int | None, last: int) -> np.ndarray:
    """Return the errors of density [veh/km] and speed [km/h], and the time of a step [s]."""
    seeds = parse_seeds(args.traffic_seeds, "traffic_seeds")
    env: Any = gym.make(
        ID,
        corridor=long_road(args.length),
        parameters=args.parameters,
        bandwidth=args.queried,
        privacy=args.privacy,
        estimator=estimator,
        estimator_settings={"band": band},
        traffic_seeds=seeds,
    )
    schedule = make_schedule("round-robin", env)
    errors, spent, n_steps = [], 0.0, 0
    for seed in range(len(seeds)):
        observation, _ = env.reset(seed=seed, options={"traffic_seed": seeds[seed]})
        state = None
        for second in range(last):
            action, state = schedule.predict(observation, state)
            begun = time.perf_counter()
            observation, _, _, _, info = env.step(action)
            spent += time.perf_counter() - begun if second > 0 else 0.0
            n_steps += 1
            if second >= min(WARM_UP, last - 1):
                errors.append([info["rmse_density"], info["rmse_speed"]])
    return np.array([*np.mean(errors, axis=0), spent / n_steps])


def main(args: Args) -> None:
    """Measure and print."""
    last = long_road(args.length).duration
    if args.quick:
        args = replace(args, length=12, queried=4, bands=(4,), traffic_seeds="0:1")
        last = 5
    columns = ("density RMSE", "", "speed RMSE", "", "time of a step")
    title = f"{args.length} segments, {args.queried} queried, {args.privacy}"
    table = make_table(title, "filter", "band", *columns, left=1)
    for estimator in args.estimators:
        full = measure(args, estimator, None, last)
        table.add_row(estimator, "none", f"{full[0]:.2f}", "", f"{full[1]:.2f}", "", "1.00")
        for band in args.bands:
            found = measure(args, estimator, band, last)
            change = [f"{100.0 * (ratio - 1.0):+.1f} %" for ratio in found[:2] / full[:2]]
            row = f"{found[0]:.2f}", change[0], f"{found[1]:.2f}", change[1]
            table.add_row("", f"{band}", *row, f"{found[2] / full[2]:.2f}")
        table.add_section()
    print_table(table)


if __name__ == "__main__":
    run(main, Args, __doc__)
