"""filterpy's filters, used as its documentation shows.

They call the compiled model once a point or member, which favours them: in numpy a point costs
fifty times as much. Their noise is given as a matrix.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from filterpy.kalman import (
    EnsembleKalmanFilter,
    ExtendedKalmanFilter,
    MerweScaledSigmaPoints,
    UnscentedKalmanFilter,
)

from benchmarks.replay import Replay
from dptse_env.estimators import Measurement, make_estimator
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import BoolArray, FloatArray

FILTERS = ("ekf", "ukf", "enkf")
SAMPLE = 3  # steps taken in each block


class NormalisedModel:
    """The model of one state at a time in normalised units, as a user would write it.

    Attributes:
        inputs: Input of the step.
        observed: Segments that are observed in it.
    """

    def __init__(self, replay: Replay) -> None:
        """Take the model of a replay and the inputs of its first step."""
        model = replay.model
        self._model = ARZModel(model.network, model.parameters, model.time_step)
        density, speed = model.density_scale, model.speed_scale
        self.scale = np.tile([density, density * speed], model.n_segments)
        self.measured_scale = np.array([density, speed])
        self.inputs: FloatArray = replay.inputs[0, 0]
        self.observed: BoolArray = replay.observed[0, 0]

    def f(self, x: FloatArray, dt: float = 1.0) -> FloatArray:
        """Return the state one step later."""
        return self._model.step((x * self.scale)[None], self.inputs[None])[0] / self.scale

    def h(self, x: FloatArray) -> FloatArray:
        """Return the measurements of the observed segments."""
        measured = self._model.measure((x * self.scale)[None])[0] / self.measured_scale
        return np.asarray(measured[self.observed]).ravel()

    def state_jacobian(self, x: FloatArray) -> FloatArray:
        """Return the Jacobian F of `f`."""
        jacobian = self._model.jacobian((x * self.scale)[None], self.inputs[None])[0]
        return jacobian * self.scale / self.scale[:, None]

    def output_jacobian(self, x: FloatArray) -> FloatArray:
        """Return the Jacobian H of `h`."""
        matrix = self._model.measurement_matrix((x * self.scale)[None])[0, self.observed]
        jacobian: FloatArray = matrix * self.scale / self.measured_scale[:, None]
        return jacobian.reshape(-1, x.size)


class _NonlinearEKF(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter with a nonlinear motion, for which it requires a subclass."""

    model: NormalisedModel

    def predict_x(self, u: FloatArray | float = 0) -> None:
        self.F = self.model.state_jacobian(self.x)
        self.x = self.model.f(self.x)


class FilterPeer:
    """A filter of filterpy on the first steps of each block.

    It starts every block from the mean and covariance that the EKF has there, since points that
    nobody projects leave the physical states in time.
    """

    def __init__(self, estimator: str, replay: Replay, block: int) -> None:
        """Run an EKF through the replay for the states at the starts of blocks."""
        self._estimator, self._replay, self._steps = estimator, replay, range(0)
        self._model = model = NormalisedModel(replay)
        self._starts = ekf_states(replay, block, model.scale)
        size, outputs, settings = replay.model.n_states, replay.n_outputs, replay.settings
        self._noise = np.diag(np.tile((replay.sigma / model.measured_scale) ** 2, outputs // 2))
        self._filter: Any
        if estimator == "ekf":
            self._filter = _NonlinearEKF(dim_x=size, dim_z=outputs)
            self._filter.model = model
        elif estimator == "ukf":
            ukf = settings.ukf
            points = MerweScaledSigmaPoints(size, alpha=ukf.alpha, beta=ukf.beta, kappa=ukf.kappa)
            self._filter = UnscentedKalmanFilter(size, outputs, 1.0, model.h, model.f, points)
        else:
            x, P = self._starts[0]
            n = settings.enkf.n_members
            self._filter = EnsembleKalmanFilter(x, P, outputs, 1.0, n, model.h, model.f)
        self._filter.Q = np.diag(np.tile(np.square(settings.process_noise), size // 2))

    def begin(self, block: range) -> None:
        """See `Row.begin`."""
        x, P = (array.copy() for array in self._starts[block.start])
        self._steps = block[:SAMPLE]
        if self._estimator == "enkf":
            self._filter.initialize(x, P)
        else:
            self._filter.x, self._filter.P = x, P

    def take(self) -> int:
        """See `Row.take`."""
        model, replay = self._model, self._replay
        jacobians = (model.output_jacobian, model.h) if self._estimator == "ekf" else ()
        for k in self._steps:
            model.inputs, model.observed = replay.inputs[k, 0], replay.observed[k, 0]
            z = (replay.values[k, 0] / model.measured_scale)[model.observed].ravel()
            self._filter.predict()
            self._filter.update(z, *jacobians, R=self._noise)
            if not np.isfinite(self._filter.x).all():
                raise RuntimeError(f"filterpy's {self._estimator} is not finite at step {k}")
        return len(self._steps)


def ekf_states(
    replay: Replay, block: int, scale: FloatArray
) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Return normalised means and covariances of an EKF at the start of each block."""
    ekf: Any = make_estimator("ekf", "compiled", replay.model, 1, replay.settings)
    episode, starts = np.arange(1), {}
    ekf.reset(episode, replay.start[:1], [np.random.default_rng(0)])
    for k in range(len(replay.inputs)):
        if k % block == 0:
            starts[k] = ekf.states[0] / scale, ekf.covariances[0].copy()
        ekf.predict(episode, replay.inputs[k, :1])
        seen, values = replay.observed[k, :1], replay.values[k, :1]
        ekf.update(episode, Measurement.of(replay.model, seen, values, replay.sigma))
    return starts
