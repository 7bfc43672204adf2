"""The ensemble Kalman filter, compiled."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.compiled import enkf_kernels as kernels
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.estimators.compiled.normals import STREAM_WIDTH, make_stream
from dptse_env.estimators.localisation import RowTapers, row_tapers
from dptse_env.estimators.noise import count_variance, initial_variance, process_variance
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.model import make_road_arrays
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

    The noise that depends on the density (`EstimatorSettings.density_growth` and `count_noise`)
    has the variance at the ensemble's mean for all members.
    """

    is_compiled: ClassVar[bool] = True

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        nothing = np.zeros((n_episodes, model.n_segments))
        priors = model.project(model.compose(nothing, nothing), settings.bounds)
        taper, none = settings.enkf.taper, np.empty((0, 0))
        weights = RowTapers(none, none) if taper is None else row_tapers(model, taper)
        self.n_members = settings.enkf.n_members
        self._road = tuple(make_road_arrays(model))
        self._ensembles = kernels.Ensembles(
            members=np.repeat(priors[:, :, None], padded(self.n_members), axis=2),
            n_members=self.n_members,
            priors=priors,
            streams=np.empty((n_episodes, 2, 4, STREAM_WIDTH), dtype=np.uint64),
            innovations=self.innovations,
            diverged=self.diverged,
            process_deviation=np.sqrt(process_variance(model, settings)) * model.state_scale,
            noise_in_w=settings.process_noise_in == "w",
            density_growth=float(settings.density_growth),
            count_variance=count_variance(model, settings),
            initial_deviation=np.sqrt(initial_variance(model, settings)) * model.state_scale,
            density_scale=model.density_scale,
            inflation=settings.enkf.inflation,
            tapers=weights.with_states,
            row_tapers=weights.among_rows,
            is_box=settings.bounds == "box",
        )
        self._packed = tuple(self._ensembles)
        self._seed(np.arange(n_episodes), [np.random.default_rng(0)] * n_episodes)

    @property
    def members(self) -> FloatArray:
        """Members `(n, n_members, n_x)` [veh/km, veh/h], then demand factors if any; a copy."""
        return np.ascontiguousarray(self._inner.swapaxes(1, 2))

    @property
    def states(self) -> FloatArray:
        """Means of the members `(n, n_x)` [veh/km, veh/h], then demand factors if any."""
        return np.asarray(self._inner.mean(axis=2))

    @property
    def covariances(self) -> FloatArray:
        """Sample covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f."""
        rest = self._inner - self.states[:, :, None]
        rest /= self.model.state_scale[:, None]
        product = rest @ rest.swapaxes(1, 2) / (self.n_members - 1)
        return np.asarray(0.5 * (product + product.swapaxes(1, 2)))

    @property
    def _inner(self) -> FloatArray:
        """Members `(n, n_x, n_members)` without padding."""
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
        kernels.update(self._road, self._packed, *measured)

    def _estimate(self) -> Estimate:
        out = np.empty((4, self.n_episodes, self.model.n_segments))
        kernels.summarise(self._road, self._ensembles.members, self.n_members, out)
        return Estimate(*out)
