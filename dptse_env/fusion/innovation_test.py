"""An innovation test: measurements that keep disagreeing with the prediction have less weight."""

import math

import numpy as np

from dptse_env.fusion.settings import FusionSettings
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class InnovationTest:
    """Running means of the innovations of every row, in n episodes.

    An innovation z is the difference of a measurement and its prediction, over the standard
    deviation of the difference. The mean of z over the last ``memory`` seconds in which the row was
    measured has a deviation of ``s = sqrt(a / (2 - a))``, with a = 1 / memory, if sensors and
    prediction agree. Where it exceeds ``threshold s``, what it exceeds by is taken for a bias, and
    its square is added to the measurement's variance.

    Attributes:
        mean: Mean normalised innovations, shape (n, M, 2).
    """

    def __init__(self, settings: FusionSettings, n_episodes: int, n_rows: int) -> None:
        """Begin without a disagreement."""
        self._rate = 1.0 / settings.memory
        self._bound = settings.threshold * math.sqrt(self._rate / (2.0 - self._rate))
        self.mean = np.zeros((n_episodes, n_rows, 2))
        self._bias = np.zeros((n_episodes, n_rows, 2))

    def reset(self, episodes: IntArray) -> None:
        """Begin new episodes, shape (k,)."""
        self.mean[episodes] = 0.0
        self._bias[episodes] = 0.0

    def weigh(
        self,
        episodes: IntArray,
        observed: BoolArray,
        innovation: FloatArray,
        sigma: FloatArray,
        deviation: FloatArray,
    ) -> FloatArray:
        """Take a second's innovations; return standard deviations with the bias that is suspected.

        Args:
            episodes: Shape (k,).
            observed: Rows that were measured, shape (k, M).
            innovation: Measurement less prediction, shape (k, M, 2).
            sigma: Standard deviations of the measurements' noise, shape (k, M, 2).
            deviation: Standard deviations of the predictions, shape (k, M, 2).
        """
        rate = np.where(observed, self._rate, 0.0)[..., None]
        spread = np.hypot(sigma, deviation)
        mean = self.mean[episodes]
        mean = mean + rate * (innovation / spread - mean)
        self.mean[episodes] = mean
        bias = self._bias[episodes]
        bias = bias + rate * (innovation - bias)
        self._bias[episodes] = bias
        size = np.abs(mean)
        excess = np.maximum(size - self._bound, 0.0) / np.maximum(size, 1e-12)
        weighed: FloatArray = np.hypot(sigma, excess * bias)
        return weighed
