"""Base class of compiled filters with a covariance: their state and its summary."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator
from dptse_env.estimators.compiled import ekf_kernels as kernels
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.estimators.noise import count_variance, initial_variance, process_variance
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.model import make_road_arrays
from dptse_env.utils.arrays import FloatArray, IntArray


class CompiledFilter(BatchEstimator):
    """Means and covariances of all episodes as arrays for kernels."""

    is_compiled: ClassVar[bool] = True

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        n_states = model.n_states
        start = model.project(np.zeros((n_episodes, n_states)), settings.bounds)
        self._filters = kernels.Filters(
            means=start,
            covariances=np.zeros((n_episodes, n_states, padded(n_states))),
            priors=start.copy(),
            innovations=self.innovations,
            diverged=self.diverged,
            process_variance=process_variance(model, settings),
            growth_variance=float(settings.density_growth) ** 2,
            count_variance=count_variance(model, settings),
            initial_variance=initial_variance(model, settings),
            density_scale=float(model.density_scale),
            is_box=settings.bounds == "box",
        )
        self._packed = tuple(make_road_arrays(model)), tuple(self._filters)
        for episode in range(n_episodes):
            kernels.restart(self._filters, episode)

    @property
    def states(self) -> FloatArray:
        """Means `(n, n_x)` [veh/km, veh/h], then demand factors if there are any; a copy."""
        return self._filters.means.copy()

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f, a copy."""
        return self._filters.covariances[:, :, : self.model.n_states].copy()

    def _estimate(self) -> Estimate:
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        kernels.summarise(*self._packed, out)
        return Estimate(*out)

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._filters.priors[episodes] = self.model.project(states, self.settings.bounds)
        self._restart(episodes)

    def _restart(self, episodes: IntArray) -> None:
        for episode in episodes.tolist():
            kernels.restart(self._filters, episode)
