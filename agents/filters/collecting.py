"""Episodes of scenarios: what an estimator is given, beside the true traffic, and batches of them.

A batch mixes the scenarios of one road. What the network reads of releases depends on what it
predicted, so that it is read anew in every pass, by the estimator's own kernel.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.environments import make_vector
from agents.filters.network import Road
from agents.filters.scenarios import Scenario
from agents.play import record
from dptse_env.estimators import Measurement
from dptse_env.estimators.recurrent_kernels import N_CHANNELS, Cells, make_cells, read
from dptse_env.evaluation import Row, evaluate
from dptse_env.process import QueryProcess
from dptse_env.traffic import Corridor, Records
from dptse_env.traffic.corridor import GEOMETRY
from dptse_env.utils.arrays import AnyArray, FloatArray

_SAME = (*GEOMETRY, "duration", "density_scale", "speed_scale")
"""Fields of a corridor that the episodes of a batch share."""


@dataclass(frozen=True)
class Episodes:
    """The seconds 1 to T of k episodes of a scenario, on S cells, with M rows of measurements.

    Attributes:
        corridor: The road.
        cells: The same as the network sees it.
        start: Density [veh/km] and speed [km/h] of the prior and their deviations, (k, S, 4).
        observed: Which rows were measured, (T, k, M).
        values: Measurements, (T, k, M, 2).
        sigma: Their deviations, (T, k, M, 2).
        centre: Speeds [km/h] that flows are centred at, (T, k, S).
        inputs: The model's inputs, (T, k, n_u).
        truth: Density [veh/km] and speed [km/h], (T, k, S, 2).
    """

    corridor: Corridor
    cells: Cells
    start: AnyArray
    observed: AnyArray
    values: AnyArray
    sigma: AnyArray
    centre: AnyArray
    inputs: AnyArray
    truth: AnyArray

    @property
    def road(self) -> list[object]:
        """Values that the episodes of a batch have in common."""
        return [getattr(self.corridor, name) for name in _SAME]

    def pick(self, chosen: AnyArray) -> Episodes:
        """Return some of the episodes, in double precision."""
        names = ("observed", "values", "sigma", "centre", "inputs", "truth")
        arrays = {name: getattr(self, name)[:, chosen] for name in names}
        doubles = {name: arrays[name].astype(float) for name in names[1:]}
        start = self.start[chosen].astype(float)
        return dataclasses.replace(self, start=start, observed=arrays["observed"], **doubles)


def collect(scenario: Scenario, estimator: Mapping[str, Any], records: Records) -> Episodes:
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
    record(env.config.corridor, seeds, records)
    process = env.process
    recorder, watcher = _Recorder(process), _Watcher(process)
    process.estimator = recorder  # type: ignore[assignment]
    evaluate(env, scenario.schedule, seeds, scenario.noise_seed, watchers=[lambda _: watcher])
    env.close()
    measured = [np.stack(arrays) for arrays in zip(*recorder.measured, strict=True)]
    observed, values, sigma, centre = measured
    return Episodes(
        corridor=process.config.corridor,
        cells=make_cells(process.model),
        start=watcher.start,
        observed=observed,
        values=_single(values),
        sigma=_single(sigma),
        centre=_single(centre),
        inputs=_single(np.stack(recorder.inputs)),
        truth=np.stack(watcher.truth),
    )


class _Recorder:
    """An estimator that writes down what it is given."""

    def __init__(self, process: QueryProcess) -> None:
        self._estimator, self._process = process.estimator, process
        self.measured: list[tuple[AnyArray, ...]] = []
        self.inputs: list[FloatArray] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._estimator, name)

    def predict(self, episodes: Any, inputs: Any) -> None:
        """Write down the inputs, and predict."""
        self.inputs.append(inputs.copy())
        self._estimator.predict(episodes, inputs)

    def update(self, episodes: Any, measured: Measurement) -> None:
        """Write down the measurements, and update."""
        model = self._process.model
        own = measured.on_road(model.rows.n_rows, model.n_segments)
        self.measured.append(tuple(array.copy() for array in own))
        self._estimator.update(episodes, measured)


class _Watcher:
    """Writes down the prior, and the truth of every second; adds no columns to rows."""

    def __init__(self, process: QueryProcess) -> None:
        self._process = process
        self.start: AnyArray = np.empty(0)
        self.truth: list[AnyArray] = []

    def __call__(self) -> None:
        process = self._process
        if self.start.size == 0:
            said = process.estimate
            table = said.density, said.speed, said.density_std, said.speed_std
            self.start = _single(np.stack(table, -1))
        else:
            self.truth.append(_single(process.truth(np.arange(process.n_episodes))))

    def rows(self) -> list[Row]:
        return [{}] * self._process.n_episodes


def _single(array: AnyArray) -> AnyArray:
    return array.astype(np.float32)


def draw_batch(rng: np.random.Generator, collected: Sequence[Episodes], n: int) -> Batch:
    """Return `n` episodes, drawn from all scenarios on the road of one that is drawn first."""
    road = collected[int(rng.integers(len(collected)))].road
    scenarios = [each for each in collected if each.road == road]
    ends = np.cumsum([len(each.start) for each in scenarios])
    drawn = np.sort(rng.choice(ends[-1], size=min(n, int(ends[-1])), replace=False))
    owners = np.searchsorted(ends, drawn, side="right")
    return Batch(
        [
            each.pick(drawn[owners == k] - (ends[k] - len(each.start)))
            for k, each in enumerate(scenarios)
            if k in owners
        ]
    )


class Batch:
    """Episodes of several scenarios on one road, as a training takes them.

    Attributes:
        road: The road.
        start: Density, speed and their deviations of the prior, double precision, (k, S, 4).
        truth: Density and speed in the seconds 1 to T, (T, k, S, 2).
    """

    def __init__(self, parts: Sequence[Episodes]) -> None:
        """Take scenarios of one road."""
        self._parts, first = parts, parts[0]
        self._owners = np.cumsum([0, *(len(part.start) for part in parts)])
        cells, corridor = first.cells, first.corridor
        upstream = torch.zeros(2 * (cells.lanes.size,))
        upstream[cells.edges[:, 1], cells.edges[:, 0]] = 1.0
        self.road = Road(
            torch.from_numpy(cells.unit).float(),
            cells.limit,
            upstream,
            (corridor.density_scale, corridor.speed_scale),
            corridor.n_mainline,
        )
        self.start = np.concatenate([part.start for part in parts])
        truth = np.concatenate([part.truth for part in parts], axis=1)
        self.truth = torch.from_numpy(truth).float()

    def channels(self, t: int, predicted: FloatArray, age: FloatArray) -> Tensor:
        """Return what the network reads in second t + 1, shape (k, S, C).

        Args:
            t: Index of the second.
            predicted: Prediction of that second and its deviations, shape (k, S, 4).
            age: Seconds since the last measurement, shape (k, S), counted on.
        """
        x = np.empty((*age.shape, N_CHANNELS), dtype=np.float32)
        for part, first, last in zip(self._parts, self._owners, self._owners[1:], strict=False):
            own = slice(first, last)
            read(
                part.cells, np.arange(last - first), part.observed[t], part.values[t],
                part.sigma[t], part.centre[t], part.inputs[t], predicted[own], age[own],
                np.empty(part.sigma[t].shape), x[own],
            )  # fmt: skip
        return torch.from_numpy(x)
