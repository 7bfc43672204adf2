"""Collect what an estimator is given in a scenario, beside the true traffic."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.environments import make_vector
from agents.filters.scenarios import Scenario
from agents.play import record
from dptse_env.estimators import Measurement
from dptse_env.estimators.recurrent_kernels import Cells, make_cells
from dptse_env.evaluation import Row, evaluate
from dptse_env.model import MeasurementRows
from dptse_env.process import QueryProcess
from dptse_env.traffic import Corridor, Records
from dptse_env.utils.arrays import FloatArray

Float32Array = NDArray[np.float32]


class Rows(NamedTuple):
    """The rows of a measurement; for k episodes of different roads with a leading axis."""

    covers: Any  # (M, S) flags of the cells that each row covers
    share: Any  # (M,) 1 / number of these cells


class Released(NamedTuple):
    """Measurements of a second in k episodes; values and sigma are 0 where there is none."""

    observed: Any  # (k, M), 1 or 0
    values: Any  # (k, M, 2)
    sigma: Any  # (k, M, 2)
    centre: Any  # (k, S), 0 where speeds are released


def make_rows(rows: MeasurementRows) -> Rows:
    """Return a model's rows as `agents.filters.torch_network` takes them."""
    return Rows((rows.weights > 0.0).astype(float), 1.0 / rows.span)


def make_released(measured: Measurement) -> Released:
    """Return measurements as `agents.filters.torch_network` takes them."""
    seen = measured.observed[..., None]
    return Released(
        measured.observed.astype(float),
        np.where(seen, measured.values, 0.0),
        np.where(seen, measured.sigma, 0.0),
        np.nan_to_num(measured.centre),
    )


def input_channels(cells: Cells, inputs: FloatArray) -> FloatArray:
    """Return inflow and density outside, shape (k, S, 2), of the model's inputs (k, n_u)."""
    table = np.zeros((len(inputs), cells.lanes.size, 2))
    lanes = cells.lanes[cells.entries]
    table[:, cells.entries, 0] = inputs[:, cells.entry_inputs] / (2000.0 * lanes)
    table[:, cells.exits, 1] = inputs[:, cells.exit_inputs] / cells.exit_units
    return table


@dataclass(frozen=True)
class Collected:
    """The seconds 1 to T of n episodes, S cells each.

    Attributes:
        corridor: The road.
        cells: The same as the network sees it.
        rows: The rows of the measurements.
        start: Density [veh/km] and speed [km/h] of the prior and their deviations, shape
            (n, S, 4).
        released: The measurements, each array with a leading axis of T.
        outside: `input_channels`, shape (T, n, S, 2).
        truth: Density [veh/km] and speed [km/h], shape (T, n, S, 2).
    """

    corridor: Corridor
    cells: Cells
    rows: Rows
    start: Float32Array
    released: Released
    outside: Float32Array
    truth: Float32Array


class _Recorder:
    """An estimator that writes down what it is given."""

    def __init__(self, process: QueryProcess) -> None:
        self._estimator, self._process = process.estimator, process
        self.cells = make_cells(process.model)
        self.released: list[Released] = []
        self.outside: list[Float32Array] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._estimator, name)

    def predict(self, episodes: Any, inputs: Any) -> None:
        """Write down the inputs, and predict."""
        self.outside.append(_single(input_channels(self.cells, inputs)))
        self._estimator.predict(episodes, inputs)

    def update(self, episodes: Any, measured: Measurement) -> None:
        """Write down the measurements, and update."""
        model = self._process.model
        own = make_released(measured.on_road(model.rows.n_rows, model.n_segments))
        self.released.append(Released(*(_single(array) for array in own)))
        self._estimator.update(episodes, measured)


class _Watcher:
    """Writes down the prior, and the truth of every second; adds no columns to rows."""

    def __init__(self, process: QueryProcess) -> None:
        self._process = process
        self.seen: list[Float32Array] = []

    def __call__(self) -> None:
        process = self._process
        if self.seen:
            self.seen.append(_single(process.truth(np.arange(process.n_episodes))))
        else:
            said = process.estimate
            table = said.density, said.speed, said.density_std, said.speed_std
            self.seen.append(_single(np.stack(table, -1)))

    def rows(self) -> list[Row]:
        return [{}] * self._process.n_episodes


def collect(scenario: Scenario, estimator: Mapping[str, Any], records: Records) -> Collected:
    """Play a scenario with an estimator.

    Args:
        scenario: The scenario.
        estimator: Keywords ``estimator`` and ``estimator_settings``.
        records: Library of records, or its folder; None for the user's cache.
    """
    seeds = scenario.traffic_seeds
    keywords = {**scenario.keywords, **estimator, "traffic_seeds": list(seeds), "records": records}
    # One thread, so that the estimator is given all episodes in one call.
    keywords |= {"action": "scores", "threads": 1}
    env = make_vector(scenario.env, len(seeds), keywords)
    process = env.process
    record(env.config.corridor, seeds, records)
    recorder, watcher = _Recorder(process), _Watcher(process)
    process.estimator = recorder  # type: ignore[assignment]
    evaluate(env, scenario.schedule, seeds, scenario.noise_seed, watchers=[lambda _: watcher])
    env.close()
    start, *truths = watcher.seen
    return Collected(
        corridor=process.config.corridor,
        cells=recorder.cells,
        rows=make_rows(process.model.rows),
        start=start,
        released=Released(*(np.stack(arrays) for arrays in zip(*recorder.released, strict=True))),
        outside=np.stack(recorder.outside),
        truth=np.stack(truths),
    )


@dataclass(frozen=True)
class CollectTask:
    """A scenario and the estimator that plays it, with everything that a worker needs.

    Attributes:
        estimator: Name of the estimator.
        network: Weights file of the recurrent network, as bytes, where that is the estimator.
        records: Library of records, or its folder; None for the user's cache.
    """

    scenario: Scenario
    estimator: str
    network: bytes | None
    records: Records


def run_collect(task: CollectTask) -> Collected:
    """Play a scenario."""
    if task.network is None:
        return collect(task.scenario, {"estimator": task.estimator}, task.records)
    with tempfile.TemporaryDirectory(prefix="dptse-network-") as folder:
        path = Path(folder) / "network.safetensors"
        path.write_bytes(task.network)
        settings = {"recurrent": {"weights": str(path), "outside": True}}
        estimator = {"estimator": task.estimator, "estimator_settings": settings}
        return collect(task.scenario, estimator, task.records)


def _single(array: Any) -> Float32Array:
    rounded: Float32Array = np.asarray(array, dtype=np.float32)
    return rounded
