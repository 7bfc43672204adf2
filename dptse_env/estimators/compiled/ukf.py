"""The unscented Kalman filter, compiled."""

import numpy as np

from dptse_env.estimators.batch import Measurements
from dptse_env.estimators.compiled import ukf_kernels
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.estimators.compiled.kalman import CompiledFilter
from dptse_env.estimators.compiled.sigma_points import Points
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.validation import require


class CompiledUKF(CompiledFilter):
    """Unscented Kalman filter on the ARZ model (Wan and van der Merwe, 2000), paper's weights.

    Points are made once per step, predicted and projected; mean, covariance and measurements are
    all computed from these points, without new ones for the update. The step's process noise is
    added to P after the prediction, so it affects the points of the next step. Means are also
    projected after predict and update.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        n_states = model.n_states
        alpha, beta, kappa = settings.ukf.alpha, settings.ukf.beta, settings.ukf.kappa
        spread = alpha**2 * (n_states + kappa)
        self._points = Points(
            states=np.zeros((n_episodes, n_states, padded(2 * n_states + 1))),
            centres=np.zeros((n_episodes, n_states)),
            noise=np.zeros((n_episodes, n_states)),
            moved=np.zeros(n_episodes, dtype=np.bool_),
            scale=model.state_scale,
            weight=0.5 / spread,
            surplus=beta - alpha**2,
            spread=float(np.sqrt(spread)),
        )
        self._points_packed = tuple(self._points)

    @staticmethod
    def check_settings(model: ARZModel, settings: EstimatorSettings) -> None:
        """Refuse a kappa at or below minus the number of states, where points have no spread."""
        n_states, kappa = model.n_states, settings.ukf.kappa
        require(n_states + kappa > 0.0, "estimator_settings.ukf.kappa", f"> -{n_states}", kappa)

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        ukf_kernels.predict(*self._packed, self._points_packed, episodes, inputs)

    def _update(self, measured: Measurements) -> None:
        episodes, observed, values, sigma, centre = measured
        points = self._points_packed
        ukf_kernels.update(*self._packed, points, episodes, observed, values, sigma, centre)

    def _restart(self, episodes: IntArray) -> None:
        self._points.moved[episodes] = False
        super()._restart(episodes)
