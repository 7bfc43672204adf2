"""Unscented Kalman filter by filterpy, a reference for the compiled one."""

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter, unscented_transform

from dptse_env.estimators.batch import EpisodeMeasurements
from dptse_env.estimators.reference.kalman import (
    EpisodeFilter,
    ReferenceFilter,
    configure,
    measurement_covariance,
    step_variance,
)
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray


class _Points(MerweScaledSigmaPoints):  # type: ignore[misc]
    """Sigma points made by `predict`; the second call in a step returns the predicted ones."""

    moved: FloatArray | None = None

    def sigma_points(self, x: FloatArray, P: FloatArray) -> FloatArray:
        if self.moved is None:
            return np.asarray(super().sigma_points(x, P))
        moved, self.moved = self.moved, None
        return moved


def _mean(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted mean relative to the first point: weights near -110 would lose two digits."""
    return np.asarray(points[0] + weights[1:] @ (points[1:] - points[0]))


class _Filter(UnscentedKalmanFilter):  # type: ignore[misc]
    """Filter of an episode in normalised units: filterpy's equations with the ARZ model.

    filterpy would make new points at the end of `predict`. With projected points these would not
    agree with mean and covariance, and P would become indefinite within a few steps.
    """

    def __init__(self, model: ARZModel, settings: EstimatorSettings) -> None:
        ukf = settings.ukf
        points = _Points(model.n_states, alpha=ukf.alpha, beta=ukf.beta, kappa=ukf.kappa)
        sizes = model.n_states, 2 * model.rows.n_rows, model.time_step
        super().__init__(*sizes, None, None, points, x_mean_fn=_mean, z_mean_fn=_mean)
        self.Q = np.zeros((model.n_states, model.n_states))  # known once the mean is predicted
        configure(self, model, settings)

    @property
    def state(self) -> FloatArray:
        """Mean `(1, n_x)` in physical units, projected."""
        return np.asarray(self.model.project(self.x[None] * self.scale, self.bounds))

    def restart(self) -> None:
        self.points_fn.moved = None
        self.has_moved = False
        self.x = self.prior / self.scale
        self.P = self.prior_covariance.copy()

    def compute_process_sigmas(
        self, dt: float, fx: object = None, inputs: FloatArray | None = None
    ) -> None:
        """Make points, predict all of them at once, if there are inputs, and project them."""
        self.x = self.state[0] / self.scale
        points = self.points_fn.sigma_points(self.x, self.P) * self.scale
        if inputs is not None:
            points = self.model.step(points, np.repeat(inputs[None], len(points), axis=0))
        self.sigmas_f = self.model.project(points, self.bounds) / self.scale
        self.points_fn.moved = self.sigmas_f

    def cross_variance(
        self, x: FloatArray, z: FloatArray, sigmas_f: FloatArray, sigmas_h: FloatArray
    ) -> FloatArray:
        """Replace filterpy's loop over points by a product of matrices."""
        return np.asarray((sigmas_f - x).T @ (self.Wc[:, None] * (sigmas_h - z)))

    def advance(self, inputs: FloatArray) -> None:
        variance = step_variance(self)
        self.predict(inputs=inputs)
        self.P += np.diag(variance)
        self.has_moved = True

    def assimilate(self, measured: EpisodeMeasurements) -> FloatArray:
        """See `EpisodeFilter.assimilate`."""
        observed = measured.observed
        if not observed.any():
            return np.zeros((0, 2))
        noise = measurement_covariance(self, measured)
        if not self.has_moved:
            self.compute_process_sigmas(self._dt)
            self.points_fn.moved = None
            self.x, self.P = unscented_transform(self.sigmas_f, self.Wm, self.Wc, None, _mean)
        outputs = self.model.measure(self.sigmas_f * self.scale, measured.centre)
        rows = iter((outputs / self.measurement_scale)[:, observed].reshape(len(outputs), -1))
        values = (measured.values[observed] / self.measurement_scale).ravel()
        self.update(values, R=noise, hx=lambda _: next(rows))
        self.x = self.state[0] / self.scale
        self.has_moved = False
        return np.asarray((self.y / np.sqrt(np.diag(self.S))).reshape(-1, 2))


class ReferenceUKF(ReferenceFilter):
    """Unscented Kalman filter on the ARZ model by filterpy, a filter per episode."""

    def _filter(self) -> EpisodeFilter:
        return _Filter(self.model, self.settings)
