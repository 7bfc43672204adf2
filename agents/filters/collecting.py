"""Collect what an estimator is given in a scenario, beside the true traffic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.episodes import make_vector, run_episodes
from agents.filters.scenarios import Scenario
from dptse_env.estimators.batch import checked_measurements
from dptse_env.estimators.learned.cells import (
    Cells,
    cell_measurements,
    input_channels,
    make_cells,
)
from dptse_env.process import QueryProcess
from dptse_env.schedules import make_schedule

Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class Collected:
    """The seconds 1 to T of n episodes, S cells each.

    Attributes:
        cells: The road.
        scales: Units of density [veh/km] and of speed [km/h] in the environment's error.
        n_mainline: Number of mainline segments.
        start: Density [veh/km] and speed [km/h] of the prior, shape (n, S, 2).
        measured: `cell_measurements`, shape (T, n, S, 9).
        outside: `input_channels`, shape (T, n, S, 2).
        truth: Density [veh/km] and speed [km/h], shape (T, n, S, 2).
        errors: The environment's error of the estimator that was played, shape (T, n).
    """

    cells: Cells
    scales: tuple[float, float]
    n_mainline: int
    start: Float32Array
    measured: Float32Array
    outside: Float32Array
    truth: Float32Array
    errors: Float32Array


class _Recorder:
    """An estimator that writes down what it is given."""

    def __init__(self, process: QueryProcess) -> None:
        self._estimator, self._process = process.estimator, process
        self.cells = make_cells(process.model)
        self.measured: list[Float32Array] = []
        self.outside: list[Float32Array] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._estimator, name)

    def predict(self, episodes: Any, inputs: Any) -> None:
        """Write down the inputs, and predict."""
        self.outside.append(input_channels(self.cells, inputs).astype(np.float32))
        self._estimator.predict(episodes, inputs)

    def update(self, *arguments: Any) -> None:
        """Write down the measurements, and update."""
        n, model = self._process.n_episodes, self._process.model
        measured = checked_measurements(n, model, *arguments)
        self.measured.append(cell_measurements(self.cells, measured).astype(np.float32))
        self._estimator.update(*arguments)


def collect(scenario: Scenario, estimator: Mapping[str, Any], records: str | None) -> Collected:
    """Play a scenario with an estimator.

    Args:
        scenario: The scenario.
        estimator: Keywords ``estimator`` and ``estimator_settings``.
        records: Folder of the record cache; None for the user's cache.
    """
    seeds = scenario.traffic_seeds
    keywords = {**scenario.keywords, **estimator, "traffic_seeds": list(seeds), "records": records}
    # One thread, so that the estimator is given all episodes in one call.
    keywords |= {"action": "scores", "threads": 1}
    env = make_vector(scenario.env, len(seeds), keywords)
    process, n = env.process, len(seeds)
    recorder = _Recorder(process)
    process.estimator = recorder  # type: ignore[assignment]
    truths: list[Float32Array] = []
    errors: list[Float32Array] = []
    starts: list[Float32Array] = []
    corridor = process.config.corridor

    def on_second() -> None:
        if not starts:
            estimate = process.estimate
            starts.append(np.stack([estimate.density, estimate.speed], -1).astype(np.float32))
            return
        truths.append(process.truth(np.arange(n)).astype(np.float32))
        density = process.error.density / corridor.density_scale
        speed = process.error.speed / corridor.speed_scale
        occupied, segments = process.error.n_occupied, corridor.n_mainline
        squares = segments * density**2 + occupied * speed**2
        errors.append(np.sqrt(squares / (segments + occupied)).astype(np.float32))

    policy = make_schedule(scenario.schedule, env)
    noise = [scenario.noise_seed + seed for seed in seeds]
    run_episodes(env, policy, traffic_seeds=seeds, seeds=noise, on_second=on_second)
    env.close()
    return Collected(
        cells=recorder.cells,
        scales=(corridor.density_scale, corridor.speed_scale),
        n_mainline=corridor.n_mainline,
        start=starts[0],
        measured=np.stack(recorder.measured),
        outside=np.stack(recorder.outside),
        truth=np.stack(truths),
        errors=np.stack(errors),
    )
