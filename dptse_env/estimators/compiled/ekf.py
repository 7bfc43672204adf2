"""The extended Kalman filter, compiled: the default estimator."""

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
from dptse_env.estimators.compiled import kernels
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.model import ARZModel
from dptse_env.model.network import BoolArray, FloatArray, IntArray
from dptse_env.model.road import road_of


class CompiledEKF:
    """Extended Kalman filter on the ARZ model, analytic Jacobians, sequential Joseph updates.

    All rows of a step are linearised at its prediction, which makes the sequence of scalar
    updates equal to one update by all rows. Means are projected after predict and update;
    covariances are not touched by it. See `Estimator` for the methods.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        self.model = model
        self.settings = settings
        self.n_episodes = n_episodes
        self.innovations = np.zeros((n_episodes, model.n_segments, 2))
        self.diverged = np.zeros(n_episodes, dtype=np.bool_)
        n_states = model.n_states
        start = model.project(np.zeros((n_episodes, n_states)), settings.bounds)
        self._filters = kernels.Filters(
            means=start,
            covariances=np.zeros((n_episodes, n_states, padded(n_states))),
            priors=start.copy(),
            innovations=self.innovations,
            diverged=self.diverged,
            process_variance=np.array(settings.process_noise, dtype=np.float64) ** 2,
            initial_variance=float(settings.initial_variance),
            density_scale=float(model.density_scale),
            is_box=settings.bounds == "box",
        )
        self._packed = tuple(road_of(model)), tuple(self._filters)
        self._restart(np.arange(n_episodes))

    @property
    def states(self) -> FloatArray:
        """Means `(n, 2 S)` [veh/km, veh/h], a copy."""
        return self._filters.means.copy()

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f, a copy."""
        return self._filters.covariances[:, :, : self.model.n_states].copy()

    def reset(
        self,
        episodes: IntArray,
        states: FloatArray,
        generators: Sequence[np.random.Generator],
    ) -> None:
        """Start episodes over from prior means `(k, 2 S)`."""
        indices = checked_episodes(episodes, self.n_episodes)
        states = checked_rows("states", states, (indices.size, self.model.n_states))
        self._filters.priors[indices] = self.model.project(states, self.settings.bounds)
        self._restart(indices)
        self.diverged[indices] = False

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """Move episodes one step ahead under inputs `(k, n_u)`."""
        indices = checked_episodes(episodes, self.n_episodes)
        inputs = checked_rows("inputs", inputs, (indices.size, self.model.n_inputs))
        kernels.predict(*self._packed, indices, inputs)

    def update(
        self, episodes: IntArray, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        """Take in measurements; what is not finite where observed makes the filter diverge."""
        given = checked_measurements(
            self.n_episodes, self.model.n_segments, episodes, observed, values, sigma
        )
        observed, values, sigma = given.observed, given.values, given.sigma
        kernels.update(*self._packed, given.episodes, observed, values, sigma)

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        kernels.summarise(*self._packed, out)
        return Estimate(*out)

    def _restart(self, indices: IntArray) -> None:
        for episode in indices.tolist():
            kernels.restart(self._filters, episode)
