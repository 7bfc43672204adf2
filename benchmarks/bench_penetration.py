"""Time of a step with some vehicles connected, over that with all of them, in turns.

python benchmarks/bench_penetration.py

Both are batches of ``dptse/PrivateHighway-v1`` with the EKF, on one thread, and take blocks of
steps in turns; a ratio is that of two turns in a row, and its mean the geometric one.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from agents.environments import quietly
from agents.statistics import Interval, geometric_mean_interval
from agents.terminal import make_table, print_table
from benchmarks.throughput.measure import queries, take_turns
from scripts.cli import run

ID = "dptse_env:dptse/PrivateHighway-v1"
TRAFFIC_SEEDS = "0:16"
N_MAINLINE, N_QUERIED = 15, 5
BASE = "all vehicles"
ARMS: Mapping[str, dict[str, Any]] = {
    BASE: {},
    "a tenth": {"penetration": 0.1},
}
"""Keywords of what is measured."""


@dataclass(frozen=True)
class Args:
    """Measure what a penetration below 1 costs in time."""

    episodes: int = 256
    """Episodes of a batch."""
    releases: tuple[str, ...] = ("paper", "capped", "paced")
    """Release models."""
    block: int = 20
    """Steps of a turn."""
    turns: int = 25
    """Turns of each."""
    quick: bool = False
    """Smallest sizes: whether it runs, not how fast it is."""


def measure(args: Args, release: str) -> dict[str, Interval]:
    """Return by arm the time of a step over that of `BASE`, with its 95 % interval."""
    work = {
        name: steps({"privacy": release, "epsilon": 5.0, **more}, args.episodes, args.block)
        for name, more in ARMS.items()
    }
    # The first turn compiles.
    rates = {
        name: np.array(samples.rates[1:])
        for name, samples in take_turns(work, 0.0, least=1 + args.turns).items()
    }
    return {name: geometric_mean_interval(rates[BASE] / rates[name]) for name in ARMS}


def steps(keywords: Mapping[str, Any], n_episodes: int, block: int) -> Callable[[], int]:
    """Return a function that takes a block of steps of a batch and returns their number."""
    with quietly():
        env = gym.make_vec(
            ID, num_envs=n_episodes, threads=1, traffic_seeds=TRAFFIC_SEEDS, **keywords
        )
    env.reset(seed=0)
    actions = queries(block, n_episodes, N_MAINLINE, N_QUERIED)

    def take() -> int:
        for action in actions:
            env.step(action)
        return block * n_episodes

    return take


def main(args: Args) -> None:
    """Measure and print."""
    if args.quick:
        args = replace(args, episodes=4, releases=("paced",), block=2, turns=2)
    title = f"time of a step over that with all vehicles connected, {args.episodes} episodes, EKF"
    table = make_table(title, "connected", *args.releases)
    found = [measure(args, release) for release in args.releases]
    for name in ARMS:
        ratios = (each[name] for each in found)
        table.add_row(name, *(f"{r.mean:.3f} [{r.low:.3f}, {r.high:.3f}]" for r in ratios))
    print_table(table)


if __name__ == "__main__":
    run(main, Args, __doc__)
