"""Ensemble Kalman filter in numpy, a reference for the compiled one.

filterpy's `EnsembleKalmanFilter` is not suitable: it draws from numpy's global generator, has a
fixed number of outputs and predicts members one by one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator, EpisodeMeasurements, Measurements
from dptse_env.estimators.localisation import RowTapers, row_tapers
from dptse_env.estimators.noise import (
    count_variance,
    density_growth,
    initial_variance,
    process_variance,
)
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray


class _Streams(NamedTuple):
    """Generators of an episode, separate so that measurements do not change the process noise."""

    process: np.random.Generator
    measurement: np.random.Generator


class ReferenceEnKF(BatchEstimator):
    """Ensemble Kalman filter with perturbed observations (Evensen, 2003; Burgers et al., 1998).

    Equal to `EnKF` in distribution; its random numbers differ.

    Attributes:
        members: `(n, n_members, n_x)` [veh/km, veh/h], then demand factors if there are any.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        enkf = settings.enkf
        self.n_members, self._inflation = enkf.n_members, enkf.inflation
        n_rows, nothing = model.rows.n_rows, np.zeros((n_episodes, model.n_segments))
        self._tapers = RowTapers(np.ones((n_rows, model.n_states)), np.ones((n_rows, n_rows)))
        if enkf.taper is not None:
            self._tapers = row_tapers(model, enkf.taper)
        self._state_unit, self._output_unit = model.state_scale, model.measurement_scale
        self._process_variance = process_variance(model, settings)
        self._initial_deviation = np.sqrt(initial_variance(model, settings)) * self._state_unit
        self._priors = model.project(model.compose(nothing, nothing), settings.bounds)
        self.members = np.repeat(self._priors[:, None], self.n_members, axis=1)
        self._streams = [_make_streams(np.random.default_rng(0)) for _ in range(n_episodes)]

    @property
    def states(self) -> FloatArray:
        """Means of the members `(n, n_x)` [veh/km, veh/h], then demand factors if any."""
        return np.asarray(self.members.mean(axis=1))

    @property
    def covariances(self) -> FloatArray:
        """Sample covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f."""
        rest = (self.members - self.states[:, None]) / self._state_unit
        return np.asarray(rest.swapaxes(1, 2) @ rest / (self.n_members - 1))

    def _estimate(self) -> Estimate:
        """Return the mean, and the deviations of the members."""
        # Both sets of bounds are convex: the projection removes rounding errors of the mean.
        mean = self.model.traffic(self._projected(self.states))
        spread = self.model.traffic(self.members).std(axis=1, ddof=1)
        speed = np.clip(mean[..., 1], 0.0, self.model.largest_speed)
        return Estimate(mean[..., 0].copy(), speed, spread[..., 0].copy(), spread[..., 1].copy())

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._priors[episodes] = self.model.project(states, self.settings.bounds)
        for episode, generator in zip(episodes.tolist(), generators, strict=True):
            self._streams[episode] = _make_streams(generator)
            self._restart(episode)

    def _restart(self, episode: int) -> None:
        """Draw the members of one episode around its prior."""
        prior = np.repeat(self._priors[episode, None], self.n_members, axis=0)
        self.members[episode] = self._perturbed(episode, prior, self._initial_deviation)

    def _perturbed(self, episode: int, members: FloatArray, deviation: FloatArray) -> FloatArray:
        noise = self._streams[episode].process.standard_normal(members.shape)
        return self._projected(members + deviation * noise)

    def _projected(self, members: FloatArray) -> FloatArray:
        return self.model.project(members, self.settings.bounds)

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """Predict all members of all episodes at once, then add process noise."""
        with np.errstate(all="ignore"):  # the update detects overflows
            density = self.model.density(self.members[episodes].mean(axis=1))
            grown = density_growth(self.model, self.settings, density)
            deviations = np.sqrt(self._process_variance + grown) * self._state_unit
            states = self.members[episodes].reshape(-1, self.model.n_states)
            moved = self.model.step(states, np.repeat(inputs, self.n_members, axis=0))
            moved = moved.reshape(-1, self.n_members, self.model.n_states)
            for episode, *parts in zip(episodes.tolist(), moved, deviations, strict=True):
                self.members[episode] = self._perturbed(episode, *parts)

    def _update(self, measured: Measurements) -> None:
        with np.errstate(all="ignore"):
            for episode, measured_there in measured.by_episode():
                self._update_one(episode, measured_there)

    def _update_one(self, episode: int, measured: EpisodeMeasurements) -> None:
        self.innovations[episode] = 0.0
        sound = True
        if measured.observed.any():
            try:
                self.innovations[episode, measured.observed] = self._assimilate(episode, measured)
            except LinAlgError:  # something is not finite, or S not definite
                sound = False
        self.diverged[episode] = not (sound and np.isfinite(self.members[episode]).all())
        if self.diverged[episode]:
            self.innovations[episode] = 0.0
            self._restart(episode)

    def _assimilate(self, episode: int, measured: EpisodeMeasurements) -> FloatArray:
        """Update members by the m observed rows; return their normalised innovations `(m, 2)`."""
        members, observed = self.members[episode], measured.observed
        if self._inflation != 1.0:
            mean = members.mean(axis=0)
            members = self._projected(mean + self._inflation * (members - mean))
        outputs = self.model.measure(members, measured.centre)[:, observed] / self._output_unit
        outputs = outputs.reshape(self.n_members, -1)
        mean, noise = outputs.mean(axis=0), np.sqrt(self._noise_variance(members, measured))
        states, rest = members - members.mean(axis=0), outputs - mean
        row = np.repeat(np.flatnonzero(observed), 2)
        cross = states.T @ rest / (self.n_members - 1) * self._tapers.with_states[row].T
        joint = rest.T @ rest / (self.n_members - 1) * self._tapers.among_rows[np.ix_(row, row)]
        joint += np.diag(noise**2)
        values = measured.values[observed]
        if not (np.isfinite(joint).all() and np.isfinite(values).all()):
            raise LinAlgError("the update is not finite")  # a projection would hide it
        values = (values / self._output_unit).ravel()
        draws = self._streams[episode].measurement.standard_normal(outputs.shape)
        factor = cho_factor(joint, check_finite=False)
        gain = cho_solve(factor, cross.T, check_finite=False).T
        residuals = values + noise * draws - outputs
        self.members[episode] = self._projected(members + residuals @ gain.T)
        return np.asarray(((values - mean) / np.sqrt(np.diag(joint))).reshape(-1, 2))

    def _noise_variance(self, members: FloatArray, measured: EpisodeMeasurements) -> FloatArray:
        """Return the variances `(2 m,)` of the observed rows' noise, normalised."""
        rows = self.model.rows
        density = rows.weights @ self.model.density(members).mean(axis=0)
        variance = np.square(measured.sigma / self._output_unit)
        variance[:, 0] += count_variance(self.model, self.settings) * density / rows.span
        return np.asarray(variance[measured.observed].ravel())


def _make_streams(generator: np.random.Generator) -> _Streams:
    seeds = generator.integers(0, 2**63, size=(2, 2))
    return _Streams(*(np.random.default_rng(seed.tolist()) for seed in seeds))
