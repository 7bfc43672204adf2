"""An estimator without a traffic model: a random walk of each segment's density and speed."""

from collections.abc import Sequence

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.open_loop import estimated_traffic
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.parameters import MEASUREMENT_FLOOR
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class RandomWalk(BatchEstimator):
    """Independent scalar Kalman filters on (rho, v) of each segment, a baseline of estimators.

    Means are clipped to [0, rho_m] and [0, 1.1 v_f]. A released flow rho (v - v_0) is converted to
    a speed by the density just estimated, which is treated as exact and at least a hundredth of
    rho_m. A row of several segments corrects each of them by its share of the uncertainty; what it
    says of their errors together, their covariance, is dropped.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        scale = np.array([model.density_scale, model.speed_scale])
        self._process_variance = (np.array(settings.walk_noise) * scale) ** 2
        self._initial_variance = settings.initial_variance * scale**2
        speeds = np.full(model.n_segments, model.largest_speed)
        self._least_density = MEASUREMENT_FLOOR * model.jam_density[:, None]
        self._upper = np.stack([model.jam_density, speeds], axis=-1)

        shape = (n_episodes, model.n_segments, 2)
        self.means = np.zeros(shape)  # [veh/km, km/h]
        self.variances = np.broadcast_to(self._initial_variance, shape).copy()
        self._prior = self.means.copy()

    @property
    def states(self) -> FloatArray:
        """Means `(n, 2 S)` [veh/km, veh/h]."""
        return self.model.states(self.means[..., 0], self.means[..., 1])

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f.

        To first order: `traffic_jacobian` turns them into the variances of density and speed.
        """
        rho_m, v_f = self.model.density_scale, self.model.speed_scale
        inverse = np.linalg.inv(self.model.traffic_jacobian(self.states))
        inverse /= np.array([[rho_m], [rho_m * v_f]])
        blocks = inverse * self.variances[..., None, :] @ inverse.swapaxes(-1, -2)
        n_episodes, n_segments = self.means.shape[:2]
        joint = np.zeros((n_episodes, n_segments, 2, n_segments, 2))
        every = np.arange(n_segments)
        joint[:, every, :, every] = blocks.swapaxes(0, 1)
        return joint.reshape(n_episodes, 2 * n_segments, 2 * n_segments)

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        means = np.stack(estimated_traffic(self.model, states), axis=-1)
        self.means[episodes] = self._prior[episodes] = np.clip(means, 0.0, self._upper)
        self.variances[episodes] = self._initial_variance

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        # A random walk does not depend on the inputs.
        self.variances[episodes] += self._process_variance

    def _update(self, measured: Measurements) -> None:
        if self.model.rows.are_single:
            self._update_segments(measured)
        else:
            self._update_rows(measured)
        finite = np.isfinite(measured.values).all(axis=2) | ~measured.observed
        self._restart(measured.episodes, np.all(finite, axis=1))

    def _update_segments(self, measured: Measurements) -> None:
        """Update all segments at once, by rows of single segments in their order."""
        values, sigma = measured.values, measured.sigma
        self._update_quantity(measured, slice(0, 1), values[..., :1], sigma[..., :1])
        speeds, sigma = values[..., 1:], sigma[..., 1:]
        if self.model.reference_speed is not None:
            density = np.maximum(self.means[measured.episodes, :, :1], self._least_density)
            speeds = measured.centre[..., None] + speeds / density
            sigma = sigma / density
        self._update_quantity(measured, slice(1, 2), speeds, sigma)

    def _update_quantity(
        self, measured: Measurements, which: slice, values: FloatArray, sigma: FloatArray
    ) -> None:
        """Update densities or speeds `(k, S, 1)`."""
        episodes, seen = measured.episodes, measured.observed[:, :, None]
        mean, variance = self.means[episodes, :, which], self.variances[episodes, :, which]
        noise = sigma**2
        total = variance + noise
        # Values that are not finite have no effect here: the episode is reset.
        informative = seen & (total > 0.0) & np.isfinite(values)
        held = np.where(informative, total, 1.0)
        residual = np.where(informative, values, mean) - mean
        gain = np.where(informative, variance / held, 0.0)
        self.innovations[episodes, :, which] = residual / np.sqrt(held)
        upper = self._upper[:, which]
        self.means[episodes, :, which] = np.clip(mean + gain * residual, 0.0, upper)
        # Joseph form: no difference of nearly equal numbers.
        self.variances[episodes, :, which] = (1.0 - gain) ** 2 * variance + gain**2 * noise

    def _update_rows(self, measured: Measurements) -> None:
        """Update the segments of one row after the other: by its density, then its other number."""
        rows = self.model.rows
        self.innovations[measured.episodes] = 0.0
        for m in range(rows.n_rows):
            seen = measured.observed[:, m]
            if not seen.any():
                continue
            covered = slice(rows.first[m], rows.first[m] + rows.span[m])
            episodes = measured.episodes[seen]
            values, noise = measured.values[seen, m], measured.sigma[seen, m] ** 2
            centre = measured.centre[seen, covered]
            share = np.full(centre.shape, 1.0 / rows.span[m])
            self._update_average(episodes, m, covered, 0, share, values[:, 0], noise[:, 0])
            second = values[:, 1]
            if self.model.reference_speed is not None:
                density = self.means[episodes, covered, 0]
                share = np.maximum(density, self._least_density[covered, 0]) * share
                second = second + np.sum(share * centre, axis=1)
            self._update_average(episodes, m, covered, 1, share, second, noise[:, 1])

    def _update_average(
        self,
        episodes: IntArray,
        row: int,
        covered: slice,
        quantity: int,
        weights: FloatArray,
        values: FloatArray,
        noise: FloatArray,
    ) -> None:
        """Update densities (0) or speeds (1) of segments, of which a weighted sum is measured.

        Args:
            episodes: Shape (k,).
            row: The row that measures it.
            covered: The segments, c of them.
            quantity: 0 or 1.
            weights: Shape (k, c).
            values: The measured sums, shape (k,).
            noise: Variances of their noise, shape (k,).
        """
        mean = self.means[episodes, covered, quantity]
        variance = self.variances[episodes, covered, quantity]
        parts = weights**2 * variance
        total = parts.sum(axis=1) + noise
        informative = (total > 0.0) & np.isfinite(values)
        held = np.where(informative, total, 1.0)
        residual = np.where(informative, values - np.sum(weights * mean, axis=1), 0.0)
        gain = np.where(informative, 1.0 / held, 0.0)[:, None] * weights * variance
        self.innovations[episodes, row, quantity] = residual / np.sqrt(held)
        upper = self._upper[covered, quantity]
        moved = np.clip(mean + gain * residual[:, None], 0.0, upper)
        self.means[episodes, covered, quantity] = moved
        # Joseph form: what the row says of a segment is blurred by the noise and by the others.
        blur = noise[:, None] + parts.sum(axis=1, keepdims=True) - parts
        self.variances[episodes, covered, quantity] = (
            1.0 - gain * weights
        ) ** 2 * variance + gain**2 * blur

    def _estimate(self) -> Estimate:
        deviations = np.sqrt(self.variances)
        return Estimate(
            self.means[..., 0].copy(),
            self.means[..., 1].copy(),
            deviations[..., 0].copy(),
            deviations[..., 1].copy(),
        )

    def _restart(self, episodes: IntArray, sound: BoolArray) -> None:
        """Reset episodes that are not sound or not finite to their prior, and flag them."""
        finite = np.isfinite(self.means[episodes]).all(axis=(1, 2))
        self.diverged[episodes] = ~(sound & finite)
        lost = episodes[self.diverged[episodes]]
        self.means[lost] = self._prior[lost]
        self.variances[lost] = self._initial_variance
        self.innovations[lost] = 0.0
