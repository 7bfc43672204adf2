"""Wall time of the estimators, measured in episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from tqdm import tqdm

from agents.environments import unwrap
from agents.evaluation.episodes import run_episode
from agents.experiments.ledger import Ledger
from agents.experiments.runner import make_env
from agents.studies.paper.plan import PaperCell, PaperDesign
from dptse_env.schedules import make_schedule
from dptse_env.traffic import Records

PAPER_SECONDS = {"ekf": 0.06, "ukf": 0.026, "enkf": 0.040, "mhe": 0.045}
"""The paper's seconds a step: MATLAB R2019b, a 3.6 GHz i7-7700."""


@dataclass(frozen=True)
class StepTime:
    """Time of an estimator in one episode.

    Attributes:
        seconds: Wall time of predict, update and estimate, mean over the episode's steps [s].
    """

    traffic_seed: int
    seconds: float


class Stopwatch:
    """Adds up the time spent in some methods of an object."""

    def __init__(self, timed: Any, names: Sequence[str]) -> None:
        """Replace the methods of this object by timed methods."""
        self.seconds = 0.0
        for name in names:
            setattr(timed, name, self._timed(getattr(timed, name)))

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **keywords: Any) -> Any:
            start = time.perf_counter()
            try:
                return method(*args, **keywords)
            finally:
                self.seconds += time.perf_counter() - start

        return call


def step_time(env: gym.Env[Any, Any], schedule: str, seed: int) -> StepTime:
    """Run one episode and return the mean time of an estimator's step, batch of one.

    The estimate at the reset is counted with the steps.
    """
    process, methods = unwrap(env).process, ("predict", "update", "estimate")
    watch = Stopwatch(process.estimator, methods)
    try:
        run_episode(env, make_schedule(schedule, env), traffic_seed=seed, seed=seed)
    finally:
        for name in methods:
            delattr(process.estimator, name)  # which hides the method of the class
    return StepTime(seed, watch.seconds / float(process.elapsed[0]))


def untimed(
    design: PaperDesign, ledger: Ledger[PaperCell, StepTime]
) -> list[tuple[PaperCell, int]]:
    """Return the timed episodes that a ledger lacks."""
    return [episode for episode in design.timed() if episode not in ledger.rows]


def time_all(
    design: PaperDesign,
    ledger: Ledger[PaperCell, StepTime],
    records: Records,
    progress: bool = True,
) -> None:
    """Time the episodes that a ledger lacks, one after the other in this process."""
    envs: dict[PaperCell, gym.Env[Any, Any]] = {}
    bar = tqdm(
        untimed(design, ledger), desc="timing", unit="episode", mininterval=0.5,
        disable=not progress,
    )  # fmt: skip
    for cell, seed in bar:
        if cell not in envs:
            envs[cell] = make_env(design.env, design.keywords(cell), design.traffic_seeds, records)
            # Kernels load and traffic is read before anything counts.
            step_time(envs[cell], design.schedule, seed)
        ledger.append(cell, [step_time(envs[cell], design.schedule, seed)])
