"""Where the time of one environment step goes: SUMO, the estimator, and everything beside it.

python benchmarks/bench_env.py

All figures come from one run on one core; compare the ratios, absolute times drift between
machines and moments. The estimator alone meets one measurement over and over, which is less work
than traffic for the MHE, whose time beside it then reads too long.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from dptse_env.estimators import ESTIMATORS
from dptse_env.traffic.sumo import simulate


def per_call(run: Callable[[], Any], calls: int, repeats: int) -> float:
    """Return the median time of a call [us]; ``run`` makes ``calls`` of them."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append((time.perf_counter() - start) / calls)
    return statistics.median(times) * 1e6


def env_step(estimator: str, repeats: int) -> tuple[float, float]:
    """Return the time of an unwrapped step, and of its estimator alone [us]."""
    env = gym.make(
        "dptse_env:dptse/PaperHighway-v0",
        estimator=estimator,
        parameters="w99-3lane",
        traffic_seeds="0:1",
    ).unwrapped
    steps = 600
    actions = np.zeros((steps, 15), dtype=np.int8)
    for k in range(steps):
        actions[k, (np.arange(5) * 3 + k) % 15] = 1

    def episode() -> None:
        env.reset(seed=0)
        for action in actions:
            env.step(action)

    total = per_call(episode, steps, repeats)
    process = env.process  # type: ignore[attr-defined]
    only = np.zeros(1, dtype=np.int64)
    inputs = process.boundary_inputs[0, 100:101]
    observed = np.zeros((1, 19), dtype=bool)
    observed[0, [0, 3, 6, 9, 12, 14, 17, 18]] = True
    values = process.released.copy()
    sigma = process.mechanism.sigma
    own = process.estimator

    def estimates() -> None:
        for _ in range(steps):
            own.predict(only, inputs)
            own.update(only, observed, values, sigma)
            own.estimate()

    return total, per_call(estimates, steps, repeats)


def main() -> None:
    """Print one row per estimator beside a live SUMO second."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7, help="runs behind each median")
    repeats = parser.parse_args().repeats
    env = gym.make("dptse_env:dptse/PaperHighway-v0").unwrapped
    corridor = env.config.corridor  # type: ignore[attr-defined]
    live = per_call(lambda: simulate(corridor, 0), corridor.duration, max(repeats // 2, 1))
    print(f"{'':14}{'step [us]':>10}{'estimator':>11}{'beside it':>11}{'SUMO / step':>13}")
    for estimator in ESTIMATORS:
        total, own = env_step(estimator, repeats)
        print(f"{estimator:14}{total:10.1f}{own:11.1f}{total - own:11.1f}{live / total:13.1f}")
    print(f"{'live SUMO':14}{live:10.1f}   per simulated second, recorded")


if __name__ == "__main__":
    main()
