"""Base class of reference filters: a filter per episode, with its checks and its summary."""

import warnings
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from scipy.linalg import LinAlgError, LinAlgWarning

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator, EpisodeMeasurements, Measurements
from dptse_env.estimators.noise import (
    count_variance,
    density_growth,
    initial_variance,
    process_variance,
)
from dptse_env.estimators.open_loop import estimated_traffic
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray


class EpisodeFilter(Protocol):
    """Filter of an episode, normalised: rho by rho_m, psi by rho_m v_f, releases by their units."""

    x: FloatArray
    P: FloatArray
    prior: FloatArray
    scale: FloatArray
    measurement_scale: FloatArray

    @property
    def state(self) -> FloatArray:
        """Mean `(1, n_x)` in physical units."""

    def restart(self) -> None:
        """Reset to the prior."""

    def advance(self, u: FloatArray) -> None:
        """Predict one step under inputs `(n_u,)`."""

    def assimilate(self, measured: EpisodeMeasurements) -> FloatArray:
        """Update by the observed rows; return their normalised innovations `(m, 2)`."""


def is_sound(episode_filter: EpisodeFilter) -> bool:
    """Return whether mean and variances are valid and no correlation is above one."""
    if not (np.isfinite(episode_filter.x).all() and np.isfinite(episode_filter.P).all()):
        return False
    variance = np.diag(episode_filter.P)
    allowed = (1.0 + 1e-9) * np.outer(variance, variance) + 1e-24
    return bool(np.all(variance >= 0.0) and np.all(allowed >= episode_filter.P**2))


def linearise(
    model: ARZModel, episode_filter: EpisodeFilter, measured: EpisodeMeasurements
) -> FloatArray:
    """Return the normalised Jacobian `(2 m, n_x)` of the observed rows' measurements."""
    state = episode_filter.x[None] * episode_filter.scale
    matrix = model.measurement_matrix(state, measured.centre)[0]
    matrix *= episode_filter.scale / episode_filter.measurement_scale[:, None]
    return np.asarray(matrix[measured.observed].reshape(-1, model.n_states))


def traffic_variance(model: ARZModel, episode_filter: EpisodeFilter) -> FloatArray:
    """Return the variances `(S, 2)` of density [veh/km] and speed [km/h]."""
    jacobian = (
        model.traffic_jacobian(episode_filter.x[None] * episode_filter.scale)[0]
        * episode_filter.scale[:2]
    )
    n = 2 * model.n_segments
    joint = episode_filter.P[:n, :n].reshape(model.n_segments, 2, model.n_segments, 2)
    blocks = joint[np.arange(model.n_segments), :, np.arange(model.n_segments)]
    variance = np.einsum("sij,sjk,sik->si", jacobian, blocks, jacobian)
    return np.asarray(np.maximum(variance, 0.0))


def configure(episode_filter: Any, model: ARZModel, settings: EstimatorSettings) -> None:
    """Set the scales, noise and prior of a filter of filterpy, and reset it to a prior of zero."""
    episode_filter.model, episode_filter.settings = model, settings
    episode_filter.bounds = settings.bounds
    episode_filter.scale = model.state_scale
    episode_filter.measurement_scale = model.measurement_scale
    episode_filter.prior = np.zeros(model.n_states)
    episode_filter.prior_covariance = np.diag(initial_variance(model, settings))
    episode_filter.restart()


def step_variance(episode_filter: Any) -> FloatArray:
    """Return the variances `(n_x,)` of the noise of a step that leaves a filter's present mean."""
    model, settings = episode_filter.model, episode_filter.settings
    density = model.density(episode_filter.state)[0]
    return process_variance(model, settings) + density_growth(model, settings, density)


def measurement_covariance(episode_filter: Any, measured: EpisodeMeasurements) -> FloatArray:
    """Return R `(2 m, 2 m)` of the observed rows, normalised, of a filter that was configured."""
    model, settings = episode_filter.model, episode_filter.settings
    variance = np.square(measured.sigma / model.measurement_scale)
    density = model.rows.weights @ model.density(episode_filter.state)[0]
    variance[:, 0] += count_variance(model, settings) * density / model.rows.span
    return np.diag(variance[measured.observed].ravel())


class ReferenceFilter(BatchEstimator):
    """A batch of filters, one per episode."""

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self._filters = [self._filter() for _ in range(n_episodes)]

    @abstractmethod
    def _filter(self) -> EpisodeFilter:
        """Make the filter of an episode."""

    @property
    def states(self) -> FloatArray:
        """Means `(n, n_x)` [veh/km, veh/h], then demand factors if there are any."""
        return np.concatenate([episode_filter.state for episode_filter in self._filters])

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f."""
        return np.stack([episode_filter.P for episode_filter in self._filters])

    def _estimate(self) -> Estimate:
        density, speed = estimated_traffic(self.model, self.states)
        deviation = np.sqrt(
            [traffic_variance(self.model, episode_filter) for episode_filter in self._filters]
        )
        return Estimate(density, speed, deviation[..., 0].copy(), deviation[..., 1].copy())

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        projected = self.model.project(states, self.settings.bounds)
        for episode, state in zip(episodes.tolist(), projected, strict=True):
            self._filters[episode].prior = state
            self._filters[episode].restart()

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        with np.errstate(all="ignore"):  # the update detects overflows
            for episode, u in zip(episodes.tolist(), inputs, strict=True):
                try:
                    self._filters[episode].advance(u)
                except LinAlgError:  # no root of P; the update resets the filter
                    self._filters[episode].x[:] = np.nan

    def _update(self, measured: Measurements) -> None:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("error", LinAlgWarning)
            for episode, measured_there in measured.by_episode():
                self._update_one(episode, measured_there)

    def _update_one(self, episode: int, measured: EpisodeMeasurements) -> None:
        episode_filter = self._filters[episode]
        self.innovations[episode] = 0.0
        observed = measured.observed
        sound = is_sound(episode_filter) and bool(np.isfinite(measured.values[observed]).all())
        if sound:
            try:
                self.innovations[episode, observed] = episode_filter.assimilate(measured)
                sound = is_sound(episode_filter)
            except (LinAlgError, LinAlgWarning):  # no inverse, or an inaccurate one
                sound = False
        self.diverged[episode] = not sound
        if not sound:
            episode_filter.restart()
            self.innovations[episode] = 0.0
