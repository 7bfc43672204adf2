"""What the reference filters share: one filter an episode, its soundness and its summary."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError, LinAlgWarning

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.open_loop import estimated_traffic
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class EpisodeFilter(Protocol):
    """One episode's filter, normalised: rho by rho_m, psi by rho_m v_f, releases by their units."""

    x: FloatArray
    P: FloatArray
    prior: FloatArray
    scale: FloatArray
    measurement_scale: FloatArray

    @property
    def state(self) -> FloatArray:
        """Mean `(1, 2 S)` in physical units."""

    def restart(self) -> None:
        """Go back to the prior."""

    def move(self, u: FloatArray) -> None:
        """Predict one step under inputs `(n_u,)`."""

    def take_in(self, observed: BoolArray, values: FloatArray, sigma: FloatArray) -> FloatArray:
        """Update by the observed segments; returns their normalised innovations `(m, 2)`."""


def is_sound(one: EpisodeFilter) -> bool:
    """Whether the mean is finite and no variance is negative and no correlation above one."""
    if not (np.isfinite(one.x).all() and np.isfinite(one.P).all()):
        return False
    variance = np.diag(one.P)
    allowed = (1.0 + 1e-9) * np.outer(variance, variance) + 1e-24
    return bool(np.all(variance >= 0.0) and np.all(allowed >= one.P**2))


def linearise(model: ARZModel, one: EpisodeFilter, observed: BoolArray) -> FloatArray:
    """Jacobian `(m, 2 S)` at the mean of what the observed segments measure, normalised."""
    blocks = model.measurement_jacobian(one.x[None] * one.scale)[0]
    jacobian = np.zeros((model.n_segments, 2, model.n_states))
    for s in range(model.n_segments):
        jacobian[s, :, 2 * s : 2 * s + 2] = blocks[s]
    jacobian *= one.scale / one.measurement_scale[:, None]
    return np.asarray(jacobian[observed].reshape(-1, model.n_states))


def traffic_variance(model: ARZModel, one: EpisodeFilter) -> FloatArray:
    """Variances `(S, 2)` of density [veh/km] and speed [km/h] that a covariance implies."""
    jacobian = model.traffic_jacobian(one.x[None] * one.scale)[0] * one.scale[:2]
    own = one.P.reshape(model.n_segments, 2, model.n_segments, 2)
    blocks = own[np.arange(model.n_segments), :, np.arange(model.n_segments)]
    variance = np.einsum("sij,sjk,sik->si", jacobian, blocks, jacobian)
    return np.asarray(np.maximum(variance, 0.0))


class ReferenceFilter(BatchEstimator):
    """A batch of filters, one an episode."""

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self._filters = [self._filter() for _ in range(n_episodes)]

    @abstractmethod
    def _filter(self) -> EpisodeFilter:
        """Make the filter of one episode."""

    @property
    def states(self) -> FloatArray:
        """Means `(n, 2 S)` [veh/km, veh/h]."""
        return np.concatenate([one.state for one in self._filters])

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f."""
        return np.stack([one.P for one in self._filters])

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
        density, speed = estimated_traffic(self.model, self.states)
        deviation = np.sqrt([traffic_variance(self.model, one) for one in self._filters])
        return Estimate(density, speed, deviation[..., 0].copy(), deviation[..., 1].copy())

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

    def _update_one(
        self, episode: int, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        one = self._filters[episode]
        self.innovations[episode] = 0.0
        sound = is_sound(one) and bool(np.isfinite(values[observed]).all())
        if sound:
            try:
                self.innovations[episode, observed] = one.take_in(observed, values, sigma)
                sound = is_sound(one)
            except (LinAlgError, LinAlgWarning):  # no inverse to be had, or none to be trusted
                sound = False
        self.diverged[episode] = not sound
        if not sound:
            one.restart()
            self.innovations[episode] = 0.0
