"""Episodes of scenarios, with an estimator's inputs and the true traffic, and batches of them.

A batch mixes scenarios on any roads. The features of the network depend on its own predictions, so
every pass computes them anew, with the estimator's own kernel.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.environments import make_vector, quietly
from agents.filters.network import Roads
from agents.filters.scenarios import Scenario
from agents.play import record
from dptse_env.estimators import Measurement
from dptse_env.estimators.recurrent_kernels import (
    N_FEATURES,
    Cells,
    Memory,
    make_cells,
    read,
)
from dptse_env.evaluation import Row, evaluate
from dptse_env.model import Channels
from dptse_env.process import QueryProcess
from dptse_env.traffic import Corridor, Records, open_library
from dptse_env.utils.arrays import AnyArray, FloatArray
from dptse_env.utils.kernels import Bundle
from dptse_env.vector_env import SensorQueryVectorEnv


@dataclass(frozen=True)
class Episodes:
    """The seconds 1 to T of k episodes of a scenario, on S cells, with M channels.

    Attributes:
        corridor: The road.
        is_taught: Whether initial weights may teach what to say of it (`Scenario.is_taught`).
        channels: What is measured.
        cells: The features of the road.
        start: Density [veh/km] and speed [km/h] of the prior and their deviations, (k, S, 4).
        observed: Which channels were measured, (T, k, M).
        values: Measurements, (T, k, M, 2).
        sigma: Their deviations, (T, k, M, 2).
        centre: Speeds [km/h] that flows are centred at, (T, k, S).
        inputs: The model's inputs, (T, k, n_u).
        truth: Density [veh/km] and speed [km/h], (T, k, S, 2).
    """

    corridor: Corridor
    is_taught: bool
    channels: Channels
    cells: Cells
    start: AnyArray
    observed: AnyArray
    values: AnyArray
    sigma: AnyArray
    centre: AnyArray
    inputs: AnyArray
    truth: AnyArray

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
    seeds, library = scenario.seeds, open_library(records)
    keywords = {**scenario.keywords, **estimator, "traffic_seeds": list(seeds), "records": library}
    # One thread, so that the estimator is given all episodes in one call.
    keywords |= {"action": "scores", "threads": 1}
    with contextlib.ExitStack() as stack:
        stack.enter_context(quietly())
        if scenario.section is not None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dptse-section-")))
            keywords["corridor"] = str(scenario.section.write(folder, library))
        env = make_vector(scenario.env, len(seeds), keywords)
        record(env.config.corridor, seeds, library)
        return _play(env, scenario)


def _play(env: SensorQueryVectorEnv, scenario: Scenario) -> Episodes:
    process = env.process
    recorder = _Recorder(process)
    process.estimator = recorder  # type: ignore[assignment]
    evaluate(
        env,
        scenario.policy,
        scenario.seeds,
        scenario.noise_seed,
        watchers=[lambda _: recorder],
    )
    env.close()
    measured = [np.stack(arrays) for arrays in zip(*recorder.measured, strict=True)]
    observed, values, sigma, centre = measured
    return Episodes(
        corridor=process.config.corridor,
        is_taught=scenario.is_taught,
        channels=process.model.channels,
        cells=make_cells(process.model),
        start=recorder.start,
        observed=observed,
        values=_single(values),
        sigma=_single(sigma),
        centre=_single(centre),
        inputs=_single(np.stack(recorder.inputs)),
        truth=np.stack(recorder.truth),
    )


class _Recorder:
    """An estimator that records its inputs, and a watcher that records the prior and the truth."""

    def __init__(self, process: QueryProcess) -> None:
        self._estimator, self._process = process.estimator, process
        self.measured: list[tuple[AnyArray, ...]] = []
        self.inputs: list[FloatArray] = []
        self.start: AnyArray = np.empty(0)
        self.truth: list[AnyArray] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._estimator, name)

    def predict(self, episodes: Any, inputs: Any) -> None:
        """Record the inputs, and predict."""
        self.inputs.append(inputs.copy())
        self._estimator.predict(episodes, inputs)

    def update(self, episodes: Any, measured: Measurement) -> None:
        """Record the measurements, and update."""
        model = self._process.model
        own = measured.on_road(model.channels.size, model.n_segments)
        self.measured.append(tuple(array.copy() for array in own))
        self._estimator.update(episodes, measured)

    def __call__(self) -> None:
        """Record the prior at the reset, and the truth of every second."""
        process = self._process
        if self.start.size == 0:
            said = process.estimate
            table = said.density, said.speed, said.density_std, said.speed_std
            self.start = _single(np.stack(table, -1))
        else:
            self.truth.append(_single(process.truth(np.arange(process.n_episodes))))

    def rows(self) -> list[Row]:
        """Add nothing to the results."""
        return [{}] * self._process.n_episodes


def _single(array: AnyArray) -> AnyArray:
    return array.astype(np.float32)


def draw_batch(rng: np.random.Generator, collected: Sequence[Episodes], n: int) -> Batch:
    """Return `n` episodes, each of a scenario that is drawn anew."""
    parts = []
    for _ in range(n):
        drawn = collected[int(rng.integers(len(collected)))]
        parts.append(drawn.pick(rng.integers(len(drawn.start), size=1)))
    return Batch(sorted(parts, key=lambda part: not part.is_taught))


class Batch:
    """Episodes of several scenarios, with the C cells of all their roads in one array.

    Attributes:
        roads: The cells.
        start: Density, speed and their deviations of the prior, double precision, (C, 4).
        truth: Density and speed in the seconds 1 to T, (T, C, 2).
    """

    def __init__(self, parts: Sequence[Episodes]) -> None:
        """Take episodes with the same number of seconds."""
        self._parts = parts
        sizes = [len(part.start) * part.corridor.road.n_segments for part in parts]
        ends = np.cumsum([0, *sizes])
        self._places = [slice(*pair) for pair in itertools.pairwise(ends)]
        self.roads = _roads(parts)
        self.start = np.concatenate([part.start.reshape(-1, 4) for part in parts])
        truth = [part.truth.reshape(len(part.truth), -1, 2) for part in parts]
        self.truth = torch.from_numpy(np.concatenate(truth, axis=1)).float()

    @property
    def taught(self) -> Batch | None:
        """The episodes that a teacher knows, which come first; None if there are none."""
        parts = [part for part in self._parts if part.is_taught]
        return Batch(parts) if parts else None

    def features(self, t: int, predicted: FloatArray, age: FloatArray) -> Tensor:
        """Return the features of second t + 1, shape (C, `N_FEATURES`).

        Args:
            t: Index of the second.
            predicted: Prediction of that second with its deviations, shape (C, 4).
            age: Seconds since the last measurement, shape (C,); updated.
        """
        x = np.empty((len(age), N_FEATURES), dtype=np.float32)
        for part, place in zip(self._parts, self._places, strict=True):
            k = len(part.start)
            memory = Memory(
                inputs=part.inputs[t],
                present=predicted[place].reshape(k, -1, 4),
                age=age[place].reshape(k, -1),
                innovations=np.empty(part.sigma[t].shape),
            )
            measured = Measurement(part.observed[t], part.values[t], part.sigma[t], part.centre[t])
            bundle = Bundle(part.corridor.road, part.channels, part.cells, memory)
            read(bundle, np.arange(k), measured, x[place].reshape(k, -1, N_FEATURES))
        return torch.from_numpy(x)


def _roads(parts: Sequence[Episodes]) -> Roads:
    """Return the cells of all episodes."""
    columns: list[tuple[AnyArray, ...]] = []
    first = n_episodes = 0
    for part in parts:
        cells, corridor, k = part.cells, part.corridor, len(part.start)
        S = corridor.road.n_segments
        units = [corridor.scales.density_scale, corridor.scales.speed_scale]
        offsets = first + S * np.arange(k)[:, None, None]
        columns.append((
            np.tile(cells.unit[:S], k),
            np.full(k * S, cells.speed_unit),
            np.full(k * S, cells.fastest),
            (corridor.road.edges + offsets).reshape(-1, 2),
            np.tile(units, (k * S, 1)),
            np.tile(np.arange(S) < corridor.geometry.n_mainline, k),
            n_episodes + np.repeat(np.arange(k), S),
            np.full(k, part.is_taught),
        ))  # fmt: skip
        first, n_episodes = first + k * S, n_episodes + k
    arrays = [np.concatenate(column) for column in zip(*columns, strict=True)]
    tensors = map(torch.from_numpy, arrays)
    unit, speed_unit, fastest, edges, scales, mainline, episode, taught = tensors
    return Roads(
        unit=unit.float(),
        speed_unit=speed_unit.float(),
        fastest=fastest.float(),
        edges=edges.long(),
        scales=scales.float(),
        mainline=mainline.float(),
        episode=episode.long(),
        taught=taught.float(),
        n_episodes=n_episodes,
    )
