"""An estimator without a traffic model: density and speed of each segment wander by themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dptse_env.estimators.base import (
    Estimate,
    EstimatorSettings,
    checked_episodes,
    checked_measurements,
    checked_rows,
)
from dptse_env.estimators.open_loop import estimated_traffic
from dptse_env.model import ARZModel
from dptse_env.model.network import BoolArray, FloatArray, IntArray


class RandomWalk:
    """Independent scalar Kalman filters on (rho, v) of each segment, plain numpy over the batch.

    What any estimator with a model must beat. Means are held to [0, rho_m] and [0, 1.1 v_f].
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        self.model = model
        self.n_episodes = n_episodes
        scale = np.array([model.density_scale, model.speed_scale])
        self._process_variance = (np.array(settings.walk_noise) * scale) ** 2
        self._initial_variance = settings.initial_variance * scale**2
        speeds = np.full(model.n_segments, model.largest_speed)
        self._upper = np.stack([model.jam_density, speeds], axis=-1)

        shape = (n_episodes, model.n_segments, 2)
        self.means = np.zeros(shape)  # [veh/km, km/h]
        self.variances = np.broadcast_to(self._initial_variance, shape).copy()
        self.innovations = np.zeros(shape)
        self.diverged = np.zeros(n_episodes, dtype=np.bool_)
        self._prior = self.means.copy()

    def reset(
        self,
        episodes: IntArray,
        states: FloatArray,
        generators: Sequence[np.random.Generator],
    ) -> None:
        """Start episodes over from the densities and speeds of states `(k, 2 S)`."""
        indices = checked_episodes(episodes, self.n_episodes)
        states = checked_rows("states", states, (indices.size, self.model.n_states))
        means = np.stack(estimated_traffic(self.model, states), axis=-1)
        self.means[indices] = self._prior[indices] = np.clip(means, 0.0, self._upper)
        self.variances[indices] = self._initial_variance
        self.innovations[indices] = 0.0
        self.diverged[indices] = False

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """Widen the variances; the inputs `(k, n_u)` say nothing to a walk."""
        indices = checked_episodes(episodes, self.n_episodes)
        checked_rows("inputs", inputs, (indices.size, self.model.n_inputs))
        self.variances[indices] += self._process_variance

    def update(
        self, episodes: IntArray, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        """Take in measurements, each by its own scalar Kalman filter."""
        given = checked_measurements(
            self.n_episodes, self.model.n_segments, episodes, observed, values, sigma
        )
        indices, seen = given.episodes, given.observed[:, :, None]
        mean, variance = self.means[indices], self.variances[indices]
        noise = given.sigma**2
        total = variance + noise
        informative = seen & (total > 0.0)
        held = np.where(informative, total, 1.0)
        residual = np.where(informative, given.values, mean) - mean
        gain = np.where(informative, variance / held, 0.0)
        self.innovations[indices] = residual / np.sqrt(held)
        self.means[indices] = np.clip(mean + gain * residual, 0.0, self._upper)
        # Joseph form: no difference of nearly equal numbers.
        self.variances[indices] = (1.0 - gain) ** 2 * variance + gain**2 * noise
        self._restart(indices)

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
        deviations = np.sqrt(self.variances)
        return Estimate(
            self.means[..., 0].copy(),
            self.means[..., 1].copy(),
            deviations[..., 0].copy(),
            deviations[..., 1].copy(),
        )

    def _restart(self, indices: IntArray) -> None:
        """Put episodes that have become non-finite back to their prior, and flag them."""
        self.diverged[indices] = ~np.all(np.isfinite(self.means[indices]), axis=(1, 2))
        lost = indices[self.diverged[indices]]
        self.means[lost] = self._prior[lost]
        self.variances[lost] = self._initial_variance
        self.innovations[lost] = 0.0
