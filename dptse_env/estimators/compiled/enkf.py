"""The ensemble Kalman filter, compiled."""

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

    Every member is predicted, perturbed by process noise and projected; updated by perturbed
    measurements; and projected again. Each episode has separate streams, seeded by the generator
    given to `reset`, for process and for measurement noise, so that the measurements do not change
    the process noise.

    Options, off by default (`EnsembleSettings`): `inflation` moves members away from their mean
    before every update that has measurements, and projects them; `taper` weighs the sampled
    covariances by distance, those of outputs with states and those among outputs. An S with
    covariances that the gain neglects would give the measurements too little weight.
    """

    is_compiled: ClassVar[bool] = True

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        unit = model.density_scale * np.array([1.0, model.speed_scale])
        priors = model.project(np.zeros((n_episodes, model.n_states)), settings.bounds)
        taper, none = settings.enkf.taper, np.empty((0, 0))
        self.n_members = settings.enkf.n_members
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
            inflation=settings.enkf.inflation,
            tapers=none if taper is None else tapers(model.network, taper),
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
        """Sample covariances `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f."""
        scale = self.model.density_scale * np.array([1.0, self.model.speed_scale])
        rest = self._inner - self.states[:, :, None]
        rest /= np.tile(scale, self.model.n_segments)[:, None]
        product = rest @ rest.swapaxes(1, 2) / (self.n_members - 1)
        return np.asarray(0.5 * (product + product.swapaxes(1, 2)))

    @property
    def _inner(self) -> FloatArray:
        """Members `(n, 2 S, M)` without padding."""
        return self._ensembles.members[:, :, : self.n_members]

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._ensembles.priors[episodes] = self.model.project(states, self.settings.bounds)
        self._seed(episodes, generators)
        kernels.restart(self._road, self._packed, episodes)

    def _seed(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Seed the streams of process noise and of measurement noise."""
        for episode, generator in zip(episodes.tolist(), generators, strict=True):
            for kind in range(2):
                self._ensembles.streams[episode, kind] = make_stream(generator)

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        kernels.predict(self._road, self._packed, episodes, inputs)

    def _update(self, measured: Measurements) -> None:
        kernels.update(
            self._road,
            self._packed,
            measured.episodes,
            measured.observed,
            measured.values,
            measured.sigma,
        )

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        kernels.summarise(self._road, self._ensembles.members, self.n_members, out)
        return Estimate(*out)
