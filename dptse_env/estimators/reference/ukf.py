"""Unscented Kalman filter by filterpy, a reference for the compiled one."""

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter, unscented_transform

from dptse_env.estimators.batch import EpisodeMeasurements
from dptse_env.estimators.localisation import (
    Places,
    band_in_force,
    in_road_order,
    places_of,
    state_places,
)
from dptse_env.estimators.reference.band import DenseBand, Scalars
from dptse_env.estimators.reference.kalman import (
    EpisodeFilter,
    ReferenceFilter,
    configure,
    measurement_covariance,
    process_covariance,
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
        self.P += process_covariance(self, variance)
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


class _BandFilter(_Filter):
    """Filter whose covariances reach a band along the road.

    Points are all evaluated along the whole road, and their covariances cut to the band, in which
    the measured segments' speeds or flows join the state.
    """

    def __init__(self, model: ARZModel, settings: EstimatorSettings, band: int) -> None:
        self._places, self._reach = state_places(model), band
        self._plain = ARZModel(
            model.network,
            model.parameters,
            model.time_step,
            model.reference_speed,
            demand_states=model.n_demand_states > 0,
        )
        self._noise = np.zeros((model.n_states, model.n_states))
        ukf = settings.ukf
        spread = ukf.alpha**2 * (model.n_states + ukf.kappa)
        self._spread, self._weight = np.sqrt(spread), 0.5 / spread
        self._surplus = ukf.beta - ukf.alpha**2
        super().__init__(model, settings)

    def _move(self, inputs: FloatArray | None) -> None:
        """Make points, predict them if there are inputs, and project them."""
        order = in_road_order(self._places)
        root = np.zeros_like(self.P)
        root[order] = np.linalg.cholesky(self.P[np.ix_(order, order)])
        mean = self.state[0] / self.scale
        steps = self._spread * root.T
        points = np.concatenate([mean[None], mean + steps, mean - steps]) * self.scale
        if inputs is not None:
            points = self.model.step(points, np.repeat(inputs[None], len(points), axis=0))
        self.sigmas_f = self.model.project(points, self.bounds) / self.scale

    def _moments(self, points: FloatArray, places: Places) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of points `(2 n_x + 1, n)` at n places."""
        band, distance = DenseBand(places, self._reach), points - points[0]
        shift = self._weight * distance.sum(axis=0)
        covariance = self._weight * distance.T @ distance + self._surplus * np.outer(shift, shift)
        return points[0] + shift, band.confine(covariance)

    def advance(self, inputs: FloatArray) -> None:
        variance = step_variance(self)
        self._move(inputs)
        self.x, self.P = self._moments(self.sigmas_f, self._places)
        self._noise = process_covariance(self, variance)
        self.P += self._noise
        self.has_moved = True

    def assimilate(self, measured: EpisodeMeasurements) -> FloatArray:
        """See `EpisodeFilter.assimilate`; numbers are taken in one after the other."""
        observed, rows, n = measured.observed, self.model.rows, self.model.n_states
        if not observed.any():
            return np.zeros((0, 2))
        noise = np.diag(measurement_covariance(self, measured))
        if not self.has_moved:
            self._move(None)
            self._noise = np.zeros_like(self.P)
        weights = rows.weights[observed]
        seen = np.flatnonzero(weights.any(axis=0))
        outputs = self._plain.measure(self.sigmas_f * self.scale, measured.centre)[:, seen, 1]
        points = np.concatenate([self.sigmas_f, outputs / self.measurement_scale[1]], axis=1)
        segments = np.concatenate([self._places.segment, seen])
        places = places_of(self.model, segments)
        mean, covariance = self._moments(points, places)
        slopes = np.zeros((2 * len(weights), len(segments)))
        slopes[0::2, 0 : 2 * self.model.n_segments : 2] = weights
        slopes[1::2, n:] = weights[:, seen]
        values = (measured.values[observed] / self.measurement_scale).ravel()
        scalars = Scalars(slopes, values - slopes @ mean, noise)
        shift, covariance, innovations = DenseBand(places, self._reach).take_in(covariance, scalars)
        self.P = covariance[:n, :n] + self._noise
        self.x = (mean + shift)[:n]
        self.x = self.state[0] / self.scale
        self.has_moved = False
        return innovations.reshape(-1, 2)


class ReferenceUKF(ReferenceFilter):
    """Unscented Kalman filter on the ARZ model by filterpy, a filter per episode."""

    def _filter(self) -> EpisodeFilter:
        band = band_in_force(self.model, self.settings.band)
        if band is None:
            return _Filter(self.model, self.settings)
        return _BandFilter(self.model, self.settings, band)
