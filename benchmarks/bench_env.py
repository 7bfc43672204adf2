"""Where the time of one environment step goes: SUMO, the estimator, and everything beside it.

python benchmarks/bench_env.py

All figures come from one run on one core; compare the ratios, absolute times drift between
machines and moments. The estimator alone follows the same traffic under the paper's schedule.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import dataclasses

import gymnasium as gym
import numpy as np

from benchmarks.replay import recorded
from benchmarks.timing import Steps, interleave, per_call
from dptse_env.config import EnvConfig
from dptse_env.estimators import ESTIMATORS
from dptse_env.traffic.sumo import simulate

PARAMETERS, STEPS = "w99-3lane", 600


def env_step(env_id: str, estimator: str, repeats: int) -> tuple[float, float]:
    """Return the time of an unwrapped step, and of its estimator alone [us]."""
    env = gym.make(
        f"dptse_env:dptse/{env_id}",
        estimator=estimator,
        parameters=PARAMETERS,
        traffic_seeds="0:1",
    ).unwrapped
    config: EnvConfig = env.config  # type: ignore[attr-defined]
    replay = recorded(PARAMETERS, (0,), 1, config.bandwidth, STEPS)
    replay = dataclasses.replace(replay, settings=config.settings())
    actions = replay.observed[:, 0, : config.corridor.n_mainline].astype(np.int8)
    actions[:, np.intersect1d(np.arange(actions.shape[1]), config.corridor.fixed_sensors)] = 0

    def episode() -> None:
        env.reset(seed=0)
        for action in actions:
            env.step(action)

    total = per_call(episode, STEPS, repeats)
    own = Steps(estimator, "compiled", "compiled", replay)
    interleave([own], STEPS, STEPS, repeats)
    return total, own.mean + own.reading.mean


def main() -> None:
    """Print one row per estimator beside a live SUMO second."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7, help="runs behind each median")
    repeats = parser.parse_args().repeats
    env = gym.make("dptse_env:dptse/PaperHighway-v0").unwrapped
    corridor = env.config.corridor  # type: ignore[attr-defined]
    live = per_call(lambda: simulate(corridor, 0), corridor.duration, max(repeats // 2, 1))
    print(f"{'':20}{'step [us]':>10}{'estimator':>11}{'beside it':>11}{'SUMO / step':>13}")
    rows = [("PaperHighway-v0", estimator) for estimator in ESTIMATORS]
    for env_id, estimator in [*rows, ("PrivateHighway-v0", "ekf")]:
        total, own = env_step(env_id, estimator, repeats)
        name = estimator if env_id.startswith("Paper") else f"{estimator}, capped"
        print(f"{name:20}{total:10.1f}{own:11.1f}{total - own:11.1f}{live / total:13.1f}")
    print(f"{'live SUMO':20}{live:10.1f}   per simulated second, recorded")


if __name__ == "__main__":
    main()
