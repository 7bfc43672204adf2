"""The unscented Kalman filter, compiled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dptse_env.estimators.base import Estimate, EstimatorSettings
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.compiled import kernels, ukf_kernels
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.model import ARZModel
from dptse_env.model.network import FloatArray, IntArray
from dptse_env.model.road import road_of


class CompiledUKF(BatchEstimator):
    """Unscented Kalman filter on the ARZ model (Wan and van der Merwe, 2000), paper's weights.

    Points are drawn once a step, moved and projected one by one; mean, covariance and what is
    measured are all computed from these same points, never redrawn. The step's process noise is
    added to P after the points have moved, and first carried by those of the next step. Means
    are projected after predict and update, too.

    Attributes:
        alpha: Spread of the points.
        kappa: Secondary spread; n + kappa must be positive.
        beta: Weight of the first point in covariances; 2 suits normal distributions.
    """

    alpha: float = 0.1
    kappa: float = -4.0
    beta: float = 2.0

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`.

        Raises:
            ValueError: The model has too few states for kappa.
        """
        super().__init__(model, n_episodes, settings)
        n_states = model.n_states
        if n_states + self.kappa <= 0.0:
            raise ValueError(f"kappa must be > -{n_states}, minus the states, got {self.kappa}")
        spread = self.alpha**2 * (n_states + self.kappa)
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
        self._points = ukf_kernels.Points(
            swarms=np.zeros((n_episodes, n_states, padded(2 * n_states + 1))),
            centres=np.zeros((n_episodes, n_states)),
            moved=np.zeros(n_episodes, dtype=np.bool_),
            weight=0.5 / spread,
            surplus=self.beta - self.alpha**2,
            spread=float(np.sqrt(spread)),
        )
        self._road = tuple(road_of(model))
        self._packed = self._road, tuple(self._filters), tuple(self._points)
        self._restart(np.arange(n_episodes))

    @property
    def states(self) -> FloatArray:
        """Means `(n, 2 S)` [veh/km, veh/h], a copy."""
        return self._filters.means.copy()

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f, a copy."""
        return self._filters.covariances[:, :, : self.model.n_states].copy()

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._filters.priors[episodes] = self.model.project(states, self.settings.bounds)
        self._restart(episodes)

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        ukf_kernels.predict(*self._packed, episodes, inputs)

    def _update(self, given: Measurements) -> None:
        observed, values, sigma = given.observed, given.values, given.sigma
        ukf_kernels.update(*self._packed, given.episodes, observed, values, sigma)

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        kernels.summarise(*self._packed[:2], out)
        return Estimate(*out)

    def _restart(self, indices: IntArray) -> None:
        self._points.moved[indices] = False
        for episode in indices.tolist():
            kernels.restart(self._filters, episode)
