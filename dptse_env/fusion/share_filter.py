"""The share of connected vehicles as a state, beside the estimator's."""

import numpy as np

from dptse_env.fusion.settings import FusionSettings
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

LEAST_SHARE = 1e-3
"""Least share that is taken: counts are divided by it."""


class ShareFilter:
    """A Kalman filter for the share p of connected vehicles in each of n episodes.

    A query that counts y connected vehicles per km, where the estimator predicts a density of
    r with variance P, measures p by ``y = p r``, with the variance of the mechanism's noise, of
    the binomial count ``p (1 - p) r / l``, and of the prediction, ``p^2 P``. In between p follows a
    random walk. It runs beside the estimator (dual estimation: Nelson and Stear, 1976), so that
    every estimator can have it.

    Attributes:
        mean: Estimated shares, shape (n,).
        variance: Their variances, shape (n,).
    """

    def __init__(self, settings: FusionSettings, published: float, n_episodes: int) -> None:
        """Begin at the published share."""
        self._published = published
        self._prior = (settings.share_deviation * published) ** 2
        self._walk = (settings.share_walk * published) ** 2
        self.mean = np.full(n_episodes, published)
        self.variance = np.full(n_episodes, self._prior)

    def reset(self, episodes: IntArray) -> None:
        """Begin new episodes, shape (k,), at the published share."""
        self.mean[episodes] = self._published
        self.variance[episodes] = self._prior

    def update(
        self,
        episodes: IntArray,
        observed: BoolArray,
        values: FloatArray,
        sigma: FloatArray,
        density: FloatArray,
        deviation: FloatArray,
        length: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Take a second's answers; return the share and its variance, shape (k, 1) each.

        Args:
            episodes: Shape (k,).
            observed: Queries that answered, shape (k, G).
            values: Released densities of connected vehicles [veh/km], shape (k, G).
            sigma: Standard deviations of their noise, shape (k, G).
            density: Predicted densities of all vehicles [veh/km], shape (k, G).
            deviation: Standard deviations of the predictions, shape (k, G).
            length: Lengths [km], shape (G,).
        """
        p, variance = self.mean[episodes], self.variance[episodes] + self._walk
        share = p[:, None]
        count = np.maximum(density * length, 1.0)
        noise = sigma**2 + share * (1.0 - share) * count / length**2 + (share * deviation) ** 2
        information = np.where(observed, density**2 / noise, 0.0).sum(axis=1)
        residual = np.where(observed, density * (values - share * density) / noise, 0.0).sum(axis=1)
        variance = variance / (1.0 + variance * information)
        p = np.clip(p + variance * residual, LEAST_SHARE, 1.0)
        self.mean[episodes], self.variance[episodes] = p, variance
        return p[:, None], variance[:, None]
