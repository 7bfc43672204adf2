"""A recurrent network as an estimator: it learned from simulated traffic what releases mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from dptse_env.estimators.base import BatchEstimator, Estimate, Measurement
from dptse_env.estimators.recurrent_kernels import LONGEST_AGE, advance, make_cells, read
from dptse_env.estimators.recurrent_weights import SavedNetwork, member_for, read_network
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.estimators.simple import estimated_traffic
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray


class Recurrent(BatchEstimator):
    """A gated recurrent unit in every cell of the road.

    All cells share the weights and see the releases that cover them, the predictions of the second
    before, the model's inputs at their ends, and the hidden states of the cells next to them. The
    traffic model is not used. Deviations are those that the network reports; estimates of
    different cells and of density and speed count as independent.

    Attributes:
        saved: The network in force, with its card.
        cells: The cells of the road.
        hidden: Hidden states, shape (n, S, H).
    """

    is_compiled: ClassVar[bool] = True

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        flows = model.reference_speed is not None
        self.saved = read_network(member_for(settings.recurrent.weights, flows))
        self.cells = make_cells(model)
        S, n = model.n_segments, n_episodes
        self.hidden = np.zeros((n, S, self.saved.network.width), dtype=np.float32)
        self._present, self._ahead, self._prior = np.zeros((3, n, S, 4))
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
        self.innovations[episodes] = 0.0

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        self._present[episodes] = self._ahead[episodes]
        self._inputs[episodes] = inputs

    def _update(self, episodes: IntArray, measured: Measurement) -> None:
        network = self.saved.network
        shape = episodes.size, self.model.n_segments, len(network.inputs)
        x = np.empty(shape, dtype=np.float32)
        state = self._inputs, self._present, self._age, self.innovations
        observed, values, sigma, centre = measured
        read(self.cells, episodes, observed, values, sigma, centre, *state, x)
        advance(self.cells, network, episodes, x, self.hidden, self._present, self._ahead)
        # Gates hold what is not finite to their range: the state does not show it.
        sound = np.all(np.isfinite(measured.values) | ~measured.observed[..., None], axis=(1, 2))
        sound &= np.isfinite(self._inputs[episodes]).all(axis=1)
        sound &= np.isfinite(self.hidden[episodes]).all(axis=(1, 2))
        self.diverged[episodes] = ~sound
        if not sound.all():
            self._restart(episodes[~sound])

    def _estimate(self) -> Estimate:
        return Estimate(*(self._present[..., j].copy() for j in range(4)))


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
