"""The extended Kalman filter on filterpy: what the compiled one is checked against."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.linalg import LinAlgError, LinAlgWarning

from dptse_env.estimators.base import Estimate, EstimatorSettings
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.open_loop import estimated_traffic
from dptse_env.model import ARZModel
from dptse_env.model.network import BoolArray, FloatArray, IntArray


class _Filter(ExtendedKalmanFilter):  # type: ignore[misc]
    """One episode's filter in normalised units; filterpy's equations, the ARZ model's motion."""

    def __init__(self, model: ARZModel, settings: EstimatorSettings) -> None:
        super().__init__(dim_x=model.n_states, dim_z=2 * model.n_segments)
        self.model = model
        self.bounds = settings.bounds
        rho_m, v_f = model.density_scale, model.speed_scale
        self.scale = np.tile([rho_m, rho_m * v_f], model.n_segments)
        self.measurement_scale = np.array([rho_m, v_f])
        self.Q = np.diag(np.tile(np.square(settings.process_noise), model.n_segments))
        self.prior = np.zeros(model.n_states)
        self.prior_covariance = settings.initial_variance * np.eye(model.n_states)
        self.restart()

    @property
    def state(self) -> FloatArray:
        """Mean `(1, 2 S)` in physical units."""
        return np.asarray(self.x[None] * self.scale)

    @state.setter
    def state(self, state: FloatArray) -> None:
        self.x = self.model.project(state, self.bounds)[0] / self.scale

    def restart(self) -> None:
        self.state = self.prior[None]
        self.P = self.prior_covariance.copy()

    def predict_x(self, u: FloatArray) -> None:
        """Replace filterpy's linear motion by the model's."""
        before, inputs = self.state, u[None]
        jacobian = self.model.jacobian(before, inputs)[0]
        self.F = jacobian * self.scale[None] / self.scale[:, None]
        self.state = self.model.step(before, inputs)

    def measurement(self, observed: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Measurement `(m,)` of the observed segments and its Jacobian `(m, 2 S)`."""
        predicted = self.model.measure(self.state)[0] / self.measurement_scale
        blocks = self.model.measurement_jacobian(self.state)[0]
        jacobian = np.zeros((self.model.n_segments, 2, self.dim_x))
        for s in range(self.model.n_segments):
            jacobian[s, :, 2 * s : 2 * s + 2] = blocks[s]
        jacobian *= self.scale / self.measurement_scale[:, None]
        return predicted[observed].ravel(), jacobian[observed].reshape(-1, self.dim_x)

    def take_in(self, observed: BoolArray, values: FloatArray, sigma: FloatArray) -> FloatArray:
        """Update by the observed segments; returns their normalised innovations `(m, 2)`."""
        predicted, jacobian = self.measurement(observed)
        measured = (values[observed] / self.measurement_scale).ravel()
        noise = np.diag(np.tile(np.square(sigma / self.measurement_scale), int(observed.sum())))
        if predicted.size == 0:
            return np.zeros((0, 2))
        self.update(measured, lambda _: jacobian, lambda _: predicted, R=noise)
        self.state = self.state
        return np.asarray((self.y / np.sqrt(np.diag(self.S))).reshape(-1, 2))

    def is_sound(self) -> bool:
        """Whether the mean is finite and no variance is negative and no correlation above one."""
        if not (np.isfinite(self.x).all() and np.isfinite(self.P).all()):
            return False
        variance = np.diag(self.P)
        allowed = (1.0 + 1e-9) * np.outer(variance, variance) + 1e-24
        return bool(np.all(variance >= 0.0) and np.all(allowed >= self.P**2))


class ReferenceEKF(BatchEstimator):
    """Extended Kalman filter on the ARZ model by filterpy, one filter an episode."""

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self._filters = [_Filter(model, settings) for _ in range(n_episodes)]

    @property
    def states(self) -> FloatArray:
        """Means `(n, 2 S)` [veh/km, veh/h]."""
        return np.concatenate([one.state for one in self._filters])

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f."""
        return np.stack([one.P for one in self._filters])

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        for episode, state in zip(episodes.tolist(), states, strict=True):
            self._filters[episode].prior = state
            self._filters[episode].restart()

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        with np.errstate(all="ignore"):  # what overflows here is found by the update
            for episode, u in zip(episodes.tolist(), inputs, strict=True):
                self._filters[episode].predict(u)

    def _update(self, given: Measurements) -> None:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("error", LinAlgWarning)
            for episode, mask, row in zip(
                given.episodes.tolist(), given.observed, given.values, strict=True
            ):
                self._update_one(episode, mask, row, given.sigma)

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
        density, speed = estimated_traffic(self.model, self.states)
        variance = np.empty((self.n_episodes, self.model.n_segments, 2))
        everywhere = np.ones(self.model.n_segments, dtype=np.bool_)
        for episode, one in enumerate(self._filters):
            _, jacobian = one.measurement(everywhere)
            spread = np.einsum("ij,jk,ik->i", jacobian, one.P, jacobian).reshape(-1, 2)
            variance[episode] = np.maximum(spread, 0.0) * one.measurement_scale**2
        deviation = np.sqrt(variance)
        return Estimate(density, speed, deviation[..., 0].copy(), deviation[..., 1].copy())

    def _update_one(
        self, episode: int, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        one = self._filters[episode]
        self.innovations[episode] = 0.0
        sound = one.is_sound() and bool(np.isfinite(values[observed]).all())
        if sound:
            try:
                self.innovations[episode, observed] = one.take_in(observed, values, sigma)
                sound = one.is_sound()
            except (LinAlgError, LinAlgWarning):  # no inverse to be had, or none to be trusted
                sound = False
        self.diverged[episode] = not sound
        if not sound:
            one.restart()
            self.innovations[episode] = 0.0
