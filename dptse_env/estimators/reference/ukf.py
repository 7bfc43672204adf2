"""The unscented Kalman filter on filterpy: what the compiled one is checked against."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter, unscented_transform
from scipy.linalg import LinAlgError, LinAlgWarning

from dptse_env.estimators.base import Estimate, EstimatorSettings
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.open_loop import estimated_traffic
from dptse_env.model import ARZModel
from dptse_env.model.network import BoolArray, FloatArray, IntArray


class _Points(MerweScaledSigmaPoints):  # type: ignore[misc]
    """Sigma points that `predict` draws once: the second call in a step gives the moved ones."""

    moved: FloatArray | None = None

    def sigma_points(self, x: FloatArray, P: FloatArray) -> FloatArray:
        if self.moved is None:
            return np.asarray(super().sigma_points(x, P))
        moved, self.moved = self.moved, None
        return moved


def _mean(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted mean, from the first point: weights near -110 lose two digits to rounding."""
    return np.asarray(points[0] + weights[1:] @ (points[1:] - points[0]))


class _Filter(UnscentedKalmanFilter):  # type: ignore[misc]
    """One episode's filter in normalised units; filterpy's equations, the ARZ model's motion.

    filterpy would draw new points at the end of `predict`. With projected points these no longer
    belong to the mean and the covariance, and P loses definiteness within a few steps.
    """

    def __init__(
        self,
        model: ARZModel,
        settings: EstimatorSettings,
        alpha: float,
        beta: float,
        kappa: float,
    ) -> None:
        points = _Points(model.n_states, alpha=alpha, beta=beta, kappa=kappa)
        super().__init__(
            model.n_states,
            2 * model.n_segments,
            model.time_step,
            None,
            None,
            points,
            x_mean_fn=_mean,
            z_mean_fn=_mean,
        )
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
        """Mean `(1, 2 S)` in physical units, projected."""
        return self.model.project(self.x[None] * self.scale, self.bounds)

    def restart(self) -> None:
        self.points_fn.moved = None
        self.has_moved = False
        self.x = self.prior / self.scale
        self.P = self.prior_covariance.copy()

    def compute_process_sigmas(
        self, dt: float, fx: object = None, inputs: FloatArray | None = None
    ) -> None:
        """Draw points, move all of them at once and project them; without inputs they stay."""
        self.x = self.state[0] / self.scale
        points = self.points_fn.sigma_points(self.x, self.P) * self.scale
        if inputs is not None:
            points = self.model.step(points, np.repeat(inputs[None], len(points), axis=0))
        self.sigmas_f = self.model.project(points, self.bounds) / self.scale
        self.points_fn.moved = self.sigmas_f

    def cross_variance(
        self, x: FloatArray, z: FloatArray, sigmas_f: FloatArray, sigmas_h: FloatArray
    ) -> FloatArray:
        """Compute filterpy's loop over points at once."""
        return np.asarray((sigmas_f - x).T @ (self.Wc[:, None] * (sigmas_h - z)))

    def move(self, inputs: FloatArray) -> None:
        self.predict(inputs=inputs)
        self.has_moved = True

    def linearise(self, observed: BoolArray) -> FloatArray:
        """Jacobian `(m, 2 S)` of the measurement of the observed segments at the mean."""
        blocks = self.model.measurement_jacobian(self.x[None] * self.scale)[0]
        jacobian = np.zeros((self.model.n_segments, 2, self._dim_x))
        for s in range(self.model.n_segments):
            jacobian[s, :, 2 * s : 2 * s + 2] = blocks[s]
        jacobian *= self.scale / self.measurement_scale[:, None]
        return np.asarray(jacobian[observed].reshape(-1, self._dim_x))

    def take_in(self, observed: BoolArray, values: FloatArray, sigma: FloatArray) -> FloatArray:
        """Update by the observed segments; returns their normalised innovations `(m, 2)`."""
        if not observed.any():
            return np.zeros((0, 2))
        if not self.has_moved:
            self.compute_process_sigmas(self._dt)
            self.points_fn.moved = None
            self.x, self.P = unscented_transform(self.sigmas_f, self.Wm, self.Wc, None, _mean)
        noise = np.diag(np.tile(np.square(sigma / self.measurement_scale), int(observed.sum())))
        outputs = self.model.measure(self.sigmas_f * self.scale) / self.measurement_scale
        rows = iter(outputs[:, observed].reshape(len(outputs), -1))
        measured = (values[observed] / self.measurement_scale).ravel()
        self.update(measured, R=noise, hx=lambda _: next(rows))
        self.x = self.state[0] / self.scale
        self.has_moved = False
        return np.asarray((self.y / np.sqrt(np.diag(self.S))).reshape(-1, 2))

    def is_sound(self) -> bool:
        """Whether the mean is finite and no variance is negative and no correlation above one."""
        if not (np.isfinite(self.x).all() and np.isfinite(self.P).all()):
            return False
        variance = np.diag(self.P)
        allowed = (1.0 + 1e-9) * np.outer(variance, variance) + 1e-24
        return bool(np.all(variance >= 0.0) and np.all(allowed >= self.P**2))


class ReferenceUKF(BatchEstimator):
    """Unscented Kalman filter on the ARZ model by filterpy, one filter an episode.

    Attributes:
        alpha: Spread of the points.
        kappa: Secondary spread.
        beta: Weight of the first point in covariances.
    """

    alpha: float = 0.1
    kappa: float = -4.0
    beta: float = 2.0

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        weights = self.alpha, self.beta, self.kappa
        self._filters = [_Filter(model, settings, *weights) for _ in range(n_episodes)]

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
        projected = self.model.project(states, self.settings.bounds)
        for episode, state in zip(episodes.tolist(), projected, strict=True):
            self._filters[episode].prior = state
            self._filters[episode].restart()

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        with np.errstate(all="ignore"):  # what overflows here is found by the update
            for episode, u in zip(episodes.tolist(), inputs, strict=True):
                try:
                    self._filters[episode].move(u)
                except LinAlgError:  # no root of P; the update finds it and starts over
                    self._filters[episode].x[:] = np.nan

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
            jacobian = one.linearise(everywhere)
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
