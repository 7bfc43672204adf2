"""sumo-rl's single intersection on libsumo, for comparison."""

from __future__ import annotations

import os
from pathlib import Path

import sumo

# sumo-rl and traci read both when they are imported.
os.environ["SUMO_HOME"] = sumo.SUMO_HOME
os.environ["LIBSUMO_AS_TRACI"] = "1"

import gymnasium as gym
import sumo_rl

from benchmarks.throughput.measure import Measured, resident, take_turns

DELTA_TIME = 5  # [s] of an action, sumo-rl's default
EPISODE = 3600  # [s]


def intersection(seconds: float) -> Measured:
    """Measure whole episodes of random actions, resets left out."""
    nets = Path(sumo_rl.__file__).parent / "nets" / "single-intersection"
    env = gym.make(
        "sumo-rl-v0",
        net_file=str(nets / "single-intersection.net.xml"),
        route_file=str(nets / "single-intersection.rou.xml"),
        delta_time=DELTA_TIME,
        num_seconds=EPISODE,
        sumo_warnings=False,
    )
    env.action_space.seed(0)
    loaded = resident()

    def reset() -> None:
        env.reset(seed=0)

    def episode() -> int:
        steps, over = 0, False
        while not over:
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
            steps += 1
        return steps

    arms = take_turns({"environment": episode}, seconds, reset)
    env.close()
    return Measured(arms, resident("VmHWM"), loaded)
