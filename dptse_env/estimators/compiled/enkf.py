"""The ensemble Kalman filter, compiled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dptse_env.estimators.base import Estimate, EstimatorSettings
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.compiled import enkf_kernels as kernels
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.model import ARZModel
from dptse_env.model.network import FloatArray, IntArray
from dptse_env.model.road import road_of


class CompiledEnKF(BatchEstimator):
    """Ensemble Kalman filter with perturbed observations (Evensen, 2003; Burgers et al., 1998).

    Every member is moved, disturbed by process noise, projected; takes the measurements in with
    noise of its own; and is projected again. Each episode draws from streams of its own, seeded
    by the generator that `reset` gets; process and measurement noise do not share one, so that
    what is measured does not change how the members move.

    Attributes:
        n_members: Members of an ensemble.
    """

    n_members: int = 100

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self._road = tuple(road_of(model))
        self._is_box = settings.bounds == "box"
        unit = model.density_scale * np.array([1.0, model.speed_scale])
        self._process_deviation = np.array(settings.process_noise) * unit
        self._initial_deviation = float(np.sqrt(settings.initial_variance)) * unit
        start = model.project(np.zeros((n_episodes, model.n_states)), settings.bounds)
        self._priors = start
        width = padded(self.n_members)
        self._swarms = np.repeat(start[:, :, None], width, axis=2)
        # Single precision halves the time to draw and is far finer than any ensemble.
        self._draws = np.empty((model.n_states, self.n_members), dtype=np.float32)
        self._streams = [streams_of(np.random.default_rng(0)) for _ in range(n_episodes)]

    @property
    def members(self) -> FloatArray:
        """Members `(n, M, 2 S)` [veh/km, veh/h], a copy."""
        return np.ascontiguousarray(self._swarms[:, :, : self.n_members].swapaxes(1, 2))

    @property
    def states(self) -> FloatArray:
        """Means of the members `(n, 2 S)` [veh/km, veh/h]."""
        return np.asarray(self._swarms[:, :, : self.n_members].mean(axis=2))

    @property
    def covariances(self) -> FloatArray:
        """Of the members, `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f."""
        scale = self.model.density_scale * np.array([1.0, self.model.speed_scale])
        rest = self._swarms[:, :, : self.n_members] - self.states[:, :, None]
        rest /= np.tile(scale, self.model.n_segments)[:, None]
        product = rest @ rest.swapaxes(1, 2) / (self.n_members - 1)
        return np.asarray(0.5 * (product + product.swapaxes(1, 2)))

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._priors[episodes] = self.model.project(states, self.settings.bounds)
        for episode, generator in zip(episodes.tolist(), generators, strict=True):
            self._streams[episode] = streams_of(generator)
            self._restart(episode)

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        for k, episode in enumerate(episodes.tolist()):
            self._streams[episode][0].standard_normal(out=self._draws, dtype=np.float32)
            kernels.predict(
                self._road, self._swarms[episode], self.n_members, inputs[k],
                self._process_deviation, self._draws, self._is_box,
            )  # fmt: skip

    def _update(self, given: Measurements) -> None:
        for k, episode in enumerate(given.episodes.tolist()):
            observed = given.observed[k]
            draws = self._draws[: 2 * int(np.count_nonzero(observed))]
            self._streams[episode][1].standard_normal(out=draws, dtype=np.float32)
            sound = kernels.update(
                self._road, self._swarms[episode], self.n_members, self.model.density_scale,
                observed, given.values[k], given.sigma, draws, self.innovations[episode],
                self._is_box,
            )  # fmt: skip
            self.diverged[episode] = not sound
            if not sound:
                self.innovations[episode] = 0.0
                self._restart(episode)

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        kernels.summarise(self._road, self._swarms, self.n_members, out)
        return Estimate(*out)

    def _restart(self, episode: int) -> None:
        """Draw the members of one episode around its prior."""
        swarm = self._swarms[episode]
        swarm[:] = self._priors[episode, :, None]
        self._streams[episode][0].standard_normal(out=self._draws, dtype=np.float32)
        kernels.scatter(
            self._road, swarm, self.n_members, self._initial_deviation, self._draws, self._is_box
        )


def streams_of(generator: np.random.Generator) -> tuple[np.random.Generator, np.random.Generator]:
    """Streams of one episode, of process noise and of measurement noise."""
    seeds = generator.integers(0, 2**63, size=(2, 2))
    first, second = (np.random.Generator(np.random.SFC64(seed.tolist())) for seed in seeds)
    return first, second
