"""Time of a step of the environment with each estimator, over that with the EKF."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from agents.environments import make_vector
from agents.statistics import geometric_mean_interval
from agents.studies.estimators.plan import EstimatorDesign
from dptse_env.traffic import Records

N_EPISODES, TURNS, STEPS = 1024, 15, 5


@dataclass(frozen=True)
class StepTime:
    """Time of a step of an environment of 1,024 episodes, on one core.

    Attributes:
        ratio: Geometric mean over the turns of the time over that with the EKF.
        low: Low end of its 95 % interval.
        high: High end of it.
    """

    estimator: str
    ratio: float
    low: float
    high: float


def measure(
    design: EstimatorDesign,
    world: str,
    records: Records,
    n_episodes: int = N_EPISODES,
    turns: int = TURNS,
) -> list[StepTime]:
    """Measure the quick estimators in turns, so that all meet the same state of the machine."""
    envs = {}
    for estimator in design.quick_estimators:
        cell = design.cell(world, estimator)
        keywords = {**design.keywords(cell), "action": "scores", "threads": 1, "records": records}
        keywords["traffic_seeds"] = list(design.traffic_seeds[:32])
        env = envs[estimator] = make_vector(cell.place.env, n_episodes, keywords)
        env.reset(seed=0)
    n_segments = env.process.interface.n_mainline
    scores = np.random.default_rng(0).random((n_episodes, n_segments), dtype=np.float32)
    seconds: dict[str, list[float]] = {name: [] for name in envs}
    for turn in range(turns + 1):
        for name, env in envs.items():
            started = time.perf_counter()
            for _ in range(STEPS):
                env.step(scores)
            if turn > 0:  # the first turn compiles
                seconds[name].append(time.perf_counter() - started)
    base, found = np.array(seconds["ekf"]), []
    for name, values in seconds.items():
        ratio = geometric_mean_interval(np.array(values) / base)
        found.append(StepTime(name, ratio.mean, ratio.low, ratio.high))
    return found
