"""The ensemble Kalman filter, compiled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.compiled import enkf_kernels as kernels
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.estimators.compiled.normals import STREAM_WIDTH, make_stream
from dptse_env.estimators.localisation import tapers
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.road_arrays import make_road_arrays
from dptse_env.utils.arrays import FloatArray, IntArray


class CompiledEnKF(BatchEstimator):
    """Ensemble Kalman filter with perturbed observations (Evensen, 2003; Burgers et al., 1998).

    Every member is moved, disturbed by process noise, projected; takes the measurements in with
    noise of its own; and is projected again. Each episode draws from streams of its own, seeded
    by the generator that `reset` gets; process and measurement noise do not share one, so that
    what is measured does not change how the members are disturbed.

    Options, off by default (`EnsembleSettings`): `inflation` moves members away from their mean
    ahead of every update that has measurements, and projects them; `taper` weighs the sampled
    covariances by distance, of outputs with states and of outputs among themselves. Both, as an
    S that holds covariances which the gain leaves out would make the measurements count for less
    than they are worth; it costs nothing to speak of.
    """

    is_compiled: ClassVar[bool] = True

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        own = settings.enkf
        unit = model.density_scale * np.array([1.0, model.speed_scale])
        priors = model.project(np.zeros((n_episodes, model.n_states)), settings.bounds)
        none = np.empty((0, 0))
        self.n_members = own.n_members
        self._road = tuple(make_road_arrays(model))
        self._ensembles = kernels.Ensembles(
            members=np.repeat(priors[:, :, None], padded(self.n_members), axis=2),
            n_members=self.n_members,
            priors=priors,
            streams=np.empty((n_episodes, 2, 4, STREAM_WIDTH), dtype=np.uint64),
            innovations=self.innovations,
            diverged=self.diverged,
            process_deviation=np.array(settings.process_noise) * unit,
            initial_deviation=float(np.sqrt(settings.initial_variance)) * unit,
            density_scale=model.density_scale,
            inflation=own.inflation,
            tapers=none if own.taper is None else tapers(model.network, own.taper),
            is_box=settings.bounds == "box",
        )
        self._packed = tuple(self._ensembles)
        self._seed(np.arange(n_episodes), [np.random.default_rng(0)] * n_episodes)

    @property
    def members(self) -> FloatArray:
        """Members `(n, M, 2 S)` [veh/km, veh/h], a copy."""
        return np.ascontiguousarray(self._inner.swapaxes(1, 2))

    @property
    def states(self) -> FloatArray:
        """Means of the members `(n, 2 S)` [veh/km, veh/h]."""
        return np.asarray(self._inner.mean(axis=2))

    @property
    def covariances(self) -> FloatArray:
        """Of the members, `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f."""
        scale = self.model.density_scale * np.array([1.0, self.model.speed_scale])
        rest = self._inner - self.states[:, :, None]
        rest /= np.tile(scale, self.model.n_segments)[:, None]
        product = rest @ rest.swapaxes(1, 2) / (self.n_members - 1)
        return np.asarray(0.5 * (product + product.swapaxes(1, 2)))

    @property
    def _inner(self) -> FloatArray:
        """Members `(n, 2 S, M)` without the columns beyond them."""
        return self._ensembles.members[:, :, : self.n_members]

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._ensembles.priors[episodes] = self.model.project(states, self.settings.bounds)
        self._seed(episodes, generators)
        kernels.restart(self._road, self._packed, episodes)

    def _seed(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Start the streams of episodes, of process noise and of measurement noise."""
        for episode, generator in zip(episodes.tolist(), generators, strict=True):
            for kind in range(2):
                self._ensembles.streams[episode, kind] = make_stream(generator)

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        kernels.predict(self._road, self._packed, episodes, inputs)

    def _update(self, given: Measurements) -> None:
        kernels.update(
            self._road, self._packed, given.episodes, given.observed, given.values, given.sigma
        )

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        kernels.summarise(self._road, self._ensembles.members, self.n_members, out)
        return Estimate(*out)
