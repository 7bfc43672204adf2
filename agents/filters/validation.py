"""Errors and honesty of a trained network in the environment, on validation traffic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from agents.environments import make_vector, parse_env
from agents.evaluation.episodes import WARM_UP, run_episodes
from agents.seeds import TUNING
from dptse_env.process import QueryProcess
from dptse_env.schedules import make_schedule
from dptse_env.traffic import Records

SCHEDULE = "round-robin"


class Score(NamedTuple):
    """Results of a cell.

    Attributes:
        error: Mean error of a second as the environment scores it.
        density: Density RMSE [veh/km].
        speed: Speed RMSE [km/h].
        chi2_density: Mean square of the density error over its reported deviation.
        chi2_speed: The same for speeds of occupied segments.
    """

    error: float
    density: float
    speed: float
    chi2_density: float
    chi2_speed: float


class Honesty:
    """Mean squares of errors over their reported deviations, gathered second by second."""

    def __init__(self, process: QueryProcess) -> None:
        """Begin with nothing."""
        self._process = process
        self._sums, self._counts = np.zeros(2), np.zeros(2)

    def __call__(self) -> None:
        """Add the present second, unless it is part of the warm-up."""
        process = self._process
        if process.time[0] <= WARM_UP:
            return
        n, estimate = process.interface.n_mainline, process.estimate
        truth = process.truth(np.arange(process.n_episodes))[:, :n]
        occupied = truth[..., 0] > 0.0
        density = (estimate.density[:, :n] - truth[..., 0]) / estimate.density_std[:, :n]
        speed = (estimate.speed[:, :n] - truth[..., 1]) / estimate.speed_std[:, :n]
        self._sums += np.sum(density**2), np.sum(speed[occupied] ** 2)
        self._counts += density.size, occupied.sum()

    def chi2(self) -> tuple[float, float]:
        """Return the mean squares of densities and of speeds; 1 where deviations are honest."""
        density, speed = self._sums / self._counts
        return float(density), float(speed)


def score(
    env: str,
    keywords: Mapping[str, Any],
    schedule: str,
    seeds: Sequence[int],
    records: Records = None,
) -> Score:
    """Run a cell over traffic seeds, all episodes at once."""
    keywords = {**keywords, "traffic_seeds": list(seeds), "records": records}
    made = make_vector(env, len(seeds), keywords)
    honesty = Honesty(made.process)
    scores = run_episodes(
        made, make_schedule(schedule, made), traffic_seeds=seeds,
        seeds=[TUNING.start + seed for seed in seeds], on_second=honesty,
    )  # fmt: skip
    made.close()
    chi2_density, chi2_speed = honesty.chi2()
    return Score(
        error=-float(np.mean([each.reward for each in scores])),
        density=float(np.mean([each.rmse_density for each in scores])),
        speed=float(np.mean([each.rmse_speed for each in scores])),
        chi2_density=chi2_density,
        chi2_speed=chi2_speed,
    )


def validate(
    weights: str, envs: Sequence[str], seeds: Sequence[int], records: Records = None
) -> dict[str, Score]:
    """Return the scores of a network, given by name or file, in some environments."""
    settings = {"recurrent": {"weights": weights, "outside": True}}
    own = {"estimator": "recurrent", "estimator_settings": settings}
    cells = {text: parse_env(text) for text in envs}
    return {
        text: score(env, {**keywords, **own}, SCHEDULE, seeds, records)
        for text, (env, keywords) in cells.items()
    }
