"""Wall time of the estimators, measured where they are used: in episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from tqdm import tqdm

from agents.evaluation.episodes import run_episode
from agents.experiments.ledger import Ledger
from agents.experiments.runner import make_env
from agents.studies.paper.plan import SCHEDULE, Cell, Design
from dptse_env.schedules import make_schedule

PAPER_SECONDS = {"ekf": 0.06, "ukf": 0.026, "enkf": 0.040, "mhe": 0.045}
"""The paper's seconds a step: MATLAB R2019b, a 3.6 GHz i7-7700."""


@dataclass(frozen=True)
class StepTime:
    """How long an estimator took in one episode.

    Attributes:
        traffic_seed: The traffic it followed.
        seconds: Wall time of predict, update and estimate, mean over the episode's steps [s].
    """

    traffic_seed: int
    seconds: float


class Stopwatch:
    """Adds up the time spent in some methods of an object."""

    def __init__(self, timed: Any, names: Sequence[str]) -> None:
        """Replace the methods of this one object by timed ones."""
        self.seconds = 0.0
        for name in names:
            setattr(timed, name, self._timed(getattr(timed, name)))

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            start = time.perf_counter()
            try:
                return method(*args)
            finally:
                self.seconds += time.perf_counter() - start

        return call


def step_time(env: Any, seed: int) -> StepTime:
    """Run one episode and return the mean time of an estimator's step, batch of one.

    The one estimate at the reset is counted with the steps.
    """
    process = env.unwrapped.process
    own = process.estimator
    watch = Stopwatch(own, ("predict", "update", "estimate"))
    try:
        run_episode(env, make_schedule(SCHEDULE, env), traffic_seed=seed, seed=seed)
    finally:
        for name in ("predict", "update", "estimate"):
            delattr(own, name)  # what hides the class's own method
    return StepTime(seed, watch.seconds / float(process.elapsed[0]))


def time_all(
    design: Design, ledger: Ledger[Cell, StepTime], records: str | None, progress: bool = True
) -> None:
    """Time what the ledger lacks, one episode after the other in this process."""
    todo = [pair for pair in design.timed() if pair not in ledger.rows]
    envs: dict[Cell, Any] = {}
    for cell, seed in tqdm(
        todo, desc="timing", unit="episode", mininterval=0.5, disable=not progress
    ):
        if cell not in envs:
            envs[cell] = make_env(design.env, cell, design.seeds, records)
            step_time(envs[cell], seed)  # kernels load and traffic is read before anything counts
        ledger.append(cell, [step_time(envs[cell], seed)])
