"""The extended Kalman filter, compiled: the default estimator."""

from dptse_env.estimators.batch import Measurements
from dptse_env.estimators.compiled import ekf_kernels
from dptse_env.estimators.compiled.kalman import CompiledFilter
from dptse_env.utils.arrays import FloatArray, IntArray


class CompiledEKF(CompiledFilter):
    """Extended Kalman filter on the ARZ model, analytic Jacobians, sequential Joseph updates.

    All rows of a step are linearised at its prediction, which makes the sequence of scalar
    updates equal to a joint update by all rows. Means are projected after predict and update;
    covariances are not.
    """

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        ekf_kernels.predict(*self._packed, episodes, inputs)

    def _update(self, measured: Measurements) -> None:
        episodes, observed, values, sigma, centre = measured
        ekf_kernels.update(*self._packed, episodes, observed, values, sigma, centre)
