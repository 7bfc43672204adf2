"""A weighted mean of an extended Kalman filter's estimates and a random walk's."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.random_walk import RandomWalk
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray


class Blend(BatchEstimator):
    """An EKF and a random walk on the same measurements, and the weighted mean of what they report.

    With x_1 the EKF's density (or speed), x_2 the walk's and c the weight of `BlendSettings`, the
    estimate is `c x_1 + (1 - c) x_2` and its standard deviation `c s_1 + (1 - c) s_2`: that of
    perfectly correlated errors, the largest for errors of deviations s_1 and s_2. Both parts read
    the same releases, so that their errors are far from independent.

    A ``speed_cap`` holds the speeds of each part. `innovations` are the weighted means of the
    parts' own. Where a part diverges, both are reset to their prior.

    Attributes:
        ekf: The EKF.
        walk: The random walk.
    """

    _filter_type: ClassVar[type[Any]]

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self.ekf = self._filter_type(model, n_episodes, settings)
        self.walk = RandomWalk(model, n_episodes, settings)
        self._priors = np.zeros((n_episodes, 2 * model.n_segments))
        self._weights = np.array([settings.blend.density_weight, settings.blend.speed_weight])

    @property
    def states(self) -> FloatArray:
        """The EKF's means `(n, n_x)` [veh/km, veh/h], then demand factors if there are any."""
        return np.asarray(self.ekf.states)

    @property
    def covariances(self) -> FloatArray:
        """The EKF's covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f."""
        return np.asarray(self.ekf.covariances)

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._priors[episodes] = states[:, : self._priors.shape[1]]
        self._restart(episodes)

    def _restart(self, episodes: IntArray) -> None:
        for part in (self.ekf, self.walk):
            part.reset(episodes, self._priors[episodes], ())  # neither part draws

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        self.ekf.predict(episodes, inputs)
        self.walk.predict(episodes, inputs)

    def _update(self, measured: Measurements) -> None:
        for part in (self.ekf, self.walk):
            part._update(measured)
        episodes, c = measured.episodes, self._weights
        first, second = self.ekf.innovations[episodes], self.walk.innovations[episodes]
        self.innovations[episodes] = c * first + (1.0 - c) * second
        self.diverged[episodes] = self.ekf.diverged[episodes] | self.walk.diverged[episodes]
        lost = episodes[self.diverged[episodes]]
        if lost.size > 0:
            self.innovations[lost] = 0.0
            self._restart(lost)

    def _estimate(self) -> Estimate:
        one, other = self.ekf.estimate(), self.walk.estimate()
        of_density, of_speed = self._weights.tolist()
        return Estimate(
            _mean(of_density, one.density, other.density),
            _mean(of_speed, one.speed, other.speed),
            _mean(of_density, one.density_std, other.density_std),
            _mean(of_speed, one.speed_std, other.speed_std),
        )


def _mean(weight: float, one: FloatArray, other: FloatArray) -> FloatArray:
    return weight * one + (1.0 - weight) * other
