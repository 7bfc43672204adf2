"""The extended Kalman filter, compiled: the default estimator."""

from dptse_env.estimators.batch import Measurements
from dptse_env.estimators.compiled import band_ekf, ekf_kernels
from dptse_env.estimators.compiled.band_filter import CompiledBandFilter
from dptse_env.utils.arrays import FloatArray, IntArray


class CompiledEKF(CompiledBandFilter):
    """Extended Kalman filter on the ARZ model, analytic Jacobians, sequential Joseph updates.

    All rows of a step are linearised at its prediction, which makes the sequence of scalar
    updates equal to a joint update by all rows. Means are projected after predict and update;
    covariances are not.

    With a `band` rows are taken in one after the other in the same way, but what a row would
    correlate beyond the band is left out, so that their order has a small effect.
    """

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        if self._band is None:
            ekf_kernels.predict(*self._packed, episodes, inputs)
        else:
            band_ekf.predict(*self._band_packed, episodes, inputs)

    def _update(self, measured: Measurements) -> None:
        episodes, observed, values, sigma, centre = measured
        if self._band is None:
            ekf_kernels.update(*self._packed, episodes, observed, values, sigma, centre)
        else:
            band_ekf.update(*self._band_packed, episodes, observed, values, sigma, centre)
