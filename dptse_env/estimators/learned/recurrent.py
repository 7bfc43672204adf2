"""A recurrent network as an estimator: it learned from simulated traffic what releases mean."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.learned import kernels, network
from dptse_env.estimators.learned.cells import input_channels, make_cells
from dptse_env.estimators.learned.channels import (
    LONGEST_AGE,
    make_released,
    make_rows,
    read_rows,
)
from dptse_env.estimators.learned.weights import SavedNetwork, member_for, read_network
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.estimators.simple import estimated_traffic
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class Recurrent(BatchEstimator):
    """Base class of both backends: a gated recurrent unit in every cell of the road.

    All cells share the weights and see the releases that cover them, the predictions of the second
    before, the model's inputs at their ends, and the hidden states of the cells next to them. The
    traffic model is not used. Deviations are those that the network reports; estimates of
    different cells and of density and speed count as independent.

    Attributes:
        saved: The network in force, with its card.
        hidden: Hidden states, shape (n, S, H).
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        flows = model.reference_speed is not None
        self.saved = read_network(member_for(settings.recurrent.weights, flows))
        self.cells = make_cells(model)
        S, n = model.n_segments, n_episodes
        self.hidden = np.zeros((n, S, self.saved.network.width), dtype=np.float32)
        self._present = np.zeros((n, S, 4))
        self._ahead = np.zeros((n, S, 4))
        self._prior = np.zeros((n, S, 4))
        self._age = np.full((n, S), LONGEST_AGE)
        self._inputs = np.zeros((n, model.n_inputs))
        deviation = np.sqrt(settings.initial_variance)
        spread = deviation * np.array([model.density_scale, model.speed_scale])
        self._present[..., 2:] = self._prior[..., 2:] = spread

    @staticmethod
    def check_settings(model: ARZModel, settings: EstimatorSettings) -> None:
        """Refuse weights that are missing, and roads and releases that they do not know."""
        flows = model.reference_speed is not None
        saved = read_network(member_for(settings.recurrent.weights, flows))
        if not settings.recurrent.outside:
            check_ranges(saved, model)

    @property
    def means(self) -> FloatArray:
        """Densities [veh/km] and speeds [km/h], shape (n, S, 2)."""
        return self._present[..., :2]

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        density, speed = estimated_traffic(self.model, states[:, : 2 * self.model.n_segments])
        self._prior[episodes, :, 0], self._prior[episodes, :, 1] = density, speed
        self._restart(episodes)

    def _restart(self, episodes: IntArray) -> None:
        self.hidden[episodes] = 0.0
        self._present[episodes] = self._ahead[episodes] = self._prior[episodes]
        self._age[episodes] = LONGEST_AGE

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        self._present[episodes] = self._ahead[episodes]
        self._inputs[episodes] = inputs

    def _update(self, measured: Measurements) -> None:
        episodes, seen = measured.episodes, measured.observed[..., None]
        values = np.where(seen, measured.values, 0.0)
        sound = np.all(np.isfinite(values), axis=(1, 2))
        sound = sound & np.all(np.isfinite(self._inputs[episodes]), axis=1)
        kept = _part(measured._replace(values=values), sound)
        if kept.episodes.size > 0:
            self._advance(kept)
        self._check(episodes, sound)

    @abstractmethod
    def _advance(self, measured: Measurements) -> None:
        """Advance the network by measurements that are finite."""

    def _check(self, episodes: IntArray, sound: BoolArray) -> None:
        """Reset episodes with releases, inputs or a hidden state that are not finite."""
        finite = np.isfinite(self.hidden[episodes]).all(axis=(1, 2))
        self.diverged[episodes] = ~(sound & finite)
        lost = episodes[self.diverged[episodes]]
        if lost.size > 0:
            self._restart(lost)
            self.innovations[lost] = 0.0

    def _estimate(self) -> Estimate:
        return Estimate(*(self._present[..., j].copy() for j in range(4)))


class CompiledRecurrent(Recurrent):
    """The recurrent network, compiled."""

    is_compiled: ClassVar[bool] = True

    def _advance(self, measured: Measurements) -> None:
        episodes, S = measured.episodes, self.model.n_segments
        n_inputs = len(self.saved.network.inputs)
        x = np.empty((episodes.size, S, n_inputs), dtype=np.float32)
        kernels.read(
            self.cells, episodes, measured.observed, measured.values, measured.sigma,
            measured.centre, self._inputs, self._present, self._age, self.innovations, x,
        )  # fmt: skip
        kernels.advance(
            self.cells, self.saved.network, episodes, x, self.hidden, self._present, self._ahead
        )


class ReferenceRecurrent(Recurrent):
    """The recurrent network in numpy."""

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self._rows = make_rows(model.rows)

    def _advance(self, measured: Measurements) -> None:
        episodes, cells = measured.episodes, self.cells
        x, self.innovations[episodes] = read_rows(
            np,
            cells,
            self._rows,
            make_released(measured),
            self._present[episodes],
            self._age[episodes],
        )
        outside = input_channels(cells, self._inputs[episodes])
        fixed = np.broadcast_to(cells.fixed, (*x.shape[:2], cells.fixed.shape[1]))
        x = np.concatenate([x, outside, fixed], axis=-1).astype(np.float32)
        h = network.advance(self.saved.network, cells.edges, x, self.hidden[episodes])
        self.hidden[episodes] = h
        present, ahead = network.outputs(self.saved.network, cells.unit, cells.limit, h)
        self._present[episodes], self._ahead[episodes] = present, ahead
        queried = x[..., 0] > 0.0
        self._age[episodes] = np.where(queried, 0.0, self._age[episodes] + 1.0)


def check_ranges(saved: SavedNetwork, model: ARZModel) -> None:
    """Refuse a road or a kind of release that a network was not trained on.

    Raises:
        ValueError: A property lies outside of the card's range; the message names it.
    """
    network = model.network
    found = {
        "n_mainline": (network.n_mainline, network.n_mainline),
        "segment_length": (min(network.segment_lengths), max(network.segment_lengths)),
        "speed_limit": (min(network.speed_limits), max(network.speed_limits)),
        "lanes": (min(network.segment_lanes), max(network.segment_lanes)),
        "span": (int(model.rows.span.min()), int(model.rows.span.max())),
        "flows": (int(model.reference_speed is not None),) * 2,
    }
    for name, bounds in saved.card["ranges"].items():
        low, high = found.get(name, bounds)
        if not bounds[0] <= low <= high <= bounds[1]:
            raise ValueError(
                f"estimator_settings.recurrent.weights {saved.source!r} were trained on {name} in "
                f"[{bounds[0]:g}, {bounds[1]:g}], this environment has [{low:g}, {high:g}]; choose "
                "others, or set estimator_settings.recurrent.outside to true"
            )


def _part(measured: Measurements, rows: BoolArray) -> Measurements:
    """Return the measurements of some of the episodes."""
    if rows.all():
        return measured
    parts: Any = [np.ascontiguousarray(array[rows]) for array in measured]
    return Measurements(*parts)
