"""Base class of compiled filters whose covariances may reach a band along the road."""

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.compiled import band_ekf
from dptse_env.estimators.compiled.band import expanded, make_band
from dptse_env.estimators.compiled.ekf_kernels import Packed
from dptse_env.estimators.compiled.kalman import CompiledFilter
from dptse_env.estimators.localisation import band_in_force
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray


class CompiledBandFilter(CompiledFilter):
    """A filter with `EstimatorSettings.band`, whose covariances are full without one."""

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        reach = band_in_force(model, settings.band)
        self._band = None if reach is None else make_band(model, reach)
        super().__init__(model, n_episodes, settings)
        if self._band is not None:
            road, filters = self._packed
            self._band_packed: tuple[Packed, Packed, Packed] = road, filters, tuple(self._band)

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f, a copy.

        With a band they are zero beyond it, and positive semidefinite all the same.
        """
        if self._band is None:
            return super().covariances
        return expanded(self._band, self._filters.covariances)

    def _estimate(self) -> Estimate:
        if self._band is None:
            return super()._estimate()
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        band_ekf.summarise(*self._band_packed, out)
        return Estimate(*out)

    def _restart_one(self, episode: int) -> None:
        if self._band is None:
            super()._restart_one(episode)
        else:
            band_ekf.restart(self._filters, self._band, episode)

    def _width(self, n_states: int) -> int:
        return super()._width(n_states) if self._band is None else self._band.reach + 1
