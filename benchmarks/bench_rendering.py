"""Pictures a second of `render`, and of a step with its picture, on every road that ships.

python benchmarks/bench_rendering.py
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from dataclasses import dataclass

import gymnasium as gym

from agents.terminal import make_table, print_table
from dptse_env.registration import ENVIRONMENTS
from dptse_env.utils.fields import integer
from scripts.cli import run

WARM_UP = 5
"""Steps before the clock starts, which compile and lay out."""


@dataclass(frozen=True)
class Args:
    """Time the pictures of an episode."""

    pictures: int = 200
    """Pictures of each road."""


def main(args: Args) -> None:
    """Measure every id in turn, and print pictures a second."""
    n = integer("pictures", args.pictures, 1, 200)
    table = make_table("pictures a second", "id", "render", "step and render")
    for env_id in ENVIRONMENTS:
        env = gym.make(env_id, render_mode="rgb_array", disable_env_checker=True)
        env.reset(seed=0)
        drawing = everything = 0.0
        for step in range(WARM_UP + n):
            start = time.perf_counter()
            env.step(env.action_space.sample())
            between = time.perf_counter()
            env.render()
            end = time.perf_counter()
            if step >= WARM_UP:
                drawing += end - between
                everything += end - start
        table.add_row(env_id, f"{n / drawing:.0f}", f"{n / everything:.0f}")
        env.close()
    print_table(table)


if __name__ == "__main__":
    run(main, Args, __doc__)
