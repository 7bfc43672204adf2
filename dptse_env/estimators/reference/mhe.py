"""Moving horizon estimation by a general solver: what the compiled one is checked against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import LinAlgError

from dptse_env.estimators.base import Estimate, EstimatorSettings, HorizonSettings
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.horizon import (
    LEAST_DEVIATION,
    Window,
    assemble,
    measurement_matrix,
    normalised_bounds,
    process_variance,
    solve,
)
from dptse_env.estimators.open_loop import estimated_traffic
from dptse_env.model import ARZModel
from dptse_env.model.network import BoolArray, FloatArray, IntArray


@dataclass
class _Stage:
    """One time of the window, normalised; the transition leads to the next one."""

    predicted: FloatArray  # (2 S,)
    solution: FloatArray  # (2 S,)
    observed: BoolArray  # (S,)
    values: FloatArray  # (S, 2)
    noise: FloatArray  # (2,)
    # Set when the stage is left, and when it is linearised.
    inputs: FloatArray = field(init=False)  # (n_u,)
    A: FloatArray = field(init=False)
    c_1: FloatArray = field(init=False)
    rows: FloatArray = field(init=False)  # (S, 2)
    c_2: FloatArray = field(init=False)  # (S,)


class _Horizon:
    """One episode: its window and its estimate."""

    def __init__(self, model: ARZModel, settings: EstimatorSettings, own: HorizonSettings) -> None:
        self.model, self.settings, self.own = model, settings, own
        rho_m, v_f = model.density_scale, model.speed_scale
        self.scale = np.tile([rho_m, rho_m * v_f], model.n_segments)
        self.measurement_scale = np.array([rho_m, v_f])
        self.process_variance = process_variance(settings)
        self.bounds = normalised_bounds(model, own.bounds)
        self.prior = np.zeros(model.n_states)
        self.restart()

    arrival_variance: FloatArray

    def restart(self) -> None:
        """Begin a window of one stage at the prior."""
        self.state = self.model.project(self.prior[None], self.own.bounds)
        self.P = self.settings.initial_variance * np.eye(self.model.n_states)
        self.arrival_variance = np.full(2, self.settings.initial_variance)
        self.stages = [self._stage()]
        self._linearise_measurement(self.stages[0], self.state[0] / self.scale)

    def predict(self, inputs: FloatArray) -> None:
        """Append a stage, the model's prediction, and drop the oldest of a full window."""
        mean = np.mean([stage.solution for stage in self.stages], axis=0)
        before = self.stages[-1]
        before.inputs = inputs
        after = self.model.step(self.model.project(self.state), inputs[None])
        self.state = self.model.project(after, self.own.bounds)
        self.stages.append(self._stage())
        if self.own.linearisation == "paper":
            self._linearise_step(before, mean)
            self._linearise_measurement(self.stages[-1], mean)
        if len(self.stages) > self.own.horizon + 1:
            self.stages.pop(0)
            self.arrival_variance[:] = [one**2 for one in self.own.arrival_noise]

    def update(self, observed: BoolArray, values: FloatArray, sigma: FloatArray) -> bool:
        """Estimate the window with the newest stage's measurements; False where not solved."""
        stage = self.stages[-1]
        stage.observed, stage.values = observed, values / self.measurement_scale
        stage.noise = np.square(np.maximum(sigma / self.measurement_scale, LEAST_DEVIATION))
        if self.own.linearisation == "trajectory":
            for one in self.stages:
                self._linearise_measurement(one, one.solution)
                if one is not stage:
                    self._linearise_step(one, one.solution)
        H, q = assemble(self.window())
        n = self.model.n_states
        self.P = np.asarray(np.linalg.solve(H, np.eye(len(H))[:, -n:])[-n:], dtype=np.float64)
        if not observed.any():
            return True  # the prediction stands
        lower, upper = (np.tile(bound, len(self.stages)) for bound in self.bounds)
        z = solve(H, q, lower, upper, self.own.solver)
        if z is None:
            return False
        for one, solution in zip(self.stages, z.reshape(-1, n), strict=True):
            one.solution = solution
        self.state = self.model.project((z[-n:] * self.scale)[None], self.own.bounds)
        return True

    def window(self) -> Window:
        """The linearised problem as arrays."""
        stages = self.stages
        n = self.model.n_states
        targets = np.stack([one.values for one in stages])
        targets[..., 1] -= np.stack([one.c_2 for one in stages])
        return Window(
            arrival=stages[0].predicted,
            arrival_variance=self.arrival_variance,
            transitions=np.array([one.A for one in stages[:-1]]).reshape(-1, n, n),
            offsets=np.array([one.c_1 for one in stages[:-1]]).reshape(-1, n),
            process_variance=self.process_variance,
            observed=np.stack([one.observed for one in stages]),
            rows=np.stack([one.rows for one in stages]),
            targets=targets,
            noise=np.stack([one.noise for one in stages]),
        )

    def innovations(self, predicted: FloatArray) -> FloatArray:
        """Residuals `(m, 2)` at the prediction, over the deviations that the window expects."""
        stage = self.stages[-1]
        C = measurement_matrix(stage.observed, stage.rows)
        R = np.tile(stage.noise, len(C) // 2)
        before = np.linalg.inv(np.linalg.inv(self.P) - C.T @ (C / R[:, None]))
        spread = np.sqrt(np.diag(C @ before @ C.T) + R).reshape(-1, 2)
        expected = self.model.measure(predicted)[0] / self.measurement_scale
        return np.asarray((stage.values - expected)[stage.observed] / spread)

    def _stage(self) -> _Stage:
        n_segments, state = self.model.n_segments, self.state[0] / self.scale
        nothing = np.zeros(n_segments, dtype=np.bool_)
        return _Stage(state, state, nothing, np.zeros((n_segments, 2)), np.ones(2))

    def _linearise_step(self, stage: _Stage, point: FloatArray) -> None:
        """A and B u + c_1 at the physical state nearest to a point."""
        state = self.model.project((point * self.scale)[None])
        inputs = stage.inputs[None]
        stage.A = self.model.jacobian(state, inputs)[0] * self.scale / self.scale[:, None]
        after = self.model.step(state, inputs)[0] / self.scale
        stage.c_1 = after - stage.A @ (state[0] / self.scale)

    def _linearise_measurement(self, stage: _Stage, point: FloatArray) -> None:
        """The speed's rows of C and its c_2 at the physical state nearest to a point."""
        state = self.model.project((point * self.scale)[None])
        rho_m, v_f = self.measurement_scale
        by_state = self.model.measurement_jacobian(state)[0, :, 1]
        stage.rows = by_state * np.array([rho_m, rho_m * v_f]) / v_f
        speed = self.model.measure(state)[0, :, 1] / v_f
        stage.c_2 = speed - np.sum(stage.rows * (state[0] / self.scale).reshape(-1, 2), axis=1)


class ReferenceMHE(BatchEstimator):
    """Moving horizon estimation (paper, eq. 14 to 17) by qpsolvers, one window an episode.

    The standard deviations are those of the last block of H's inverse: the last state's
    covariance given the window, bounds left aside. The model is linearised, and predicts, from
    the nearest state in the cone: in the paper's box w has no bound and the model none either.

    Attributes:
        fallback: `(n,)` whether the last update's program was not solved, as told by its
            residual, and the prediction taken instead.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self._horizons = [_Horizon(model, settings, settings.mhe) for _ in range(n_episodes)]
        self.fallback = np.zeros(n_episodes, dtype=np.bool_)

    @property
    def states(self) -> FloatArray:
        """Means `(n, 2 S)` [veh/km, veh/h]."""
        return np.concatenate([one.state for one in self._horizons])

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, 2 S, 2 S)`, rho normalised by rho_m and psi by rho_m v_f."""
        return np.stack([one.P for one in self._horizons])

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self.fallback[episodes] = False
        for episode, state in zip(episodes.tolist(), states, strict=True):
            self._horizons[episode].prior = state
            self._horizons[episode].restart()

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        with np.errstate(all="ignore"):  # what overflows here is found by the update
            for episode, u in zip(episodes.tolist(), inputs, strict=True):
                self._horizons[episode].predict(u)

    def _update(self, given: Measurements) -> None:
        for episode, mask, values in zip(
            given.episodes.tolist(), given.observed, given.values, strict=True
        ):
            self._update_one(episode, mask, values, given.sigma)

    def estimate(self) -> Estimate:
        """Current estimate of all episodes; deviations are those of the last update."""
        density, speed = estimated_traffic(self.model, self.states)
        rho_m, v_f = self.model.density_scale, self.model.speed_scale
        blocks = np.stack([self.covariances[:, i::2, j::2] for i in (0, 1) for j in (0, 1)])
        spread = blocks.diagonal(axis1=2, axis2=3).reshape(2, 2, self.n_episodes, -1)
        rows = self.model.measurement_jacobian(self.states)[:, :, 1] * [rho_m, rho_m * v_f]
        variance = np.einsum("nsi,ijns,nsj->ns", rows, spread, rows)
        density_std = rho_m * np.sqrt(np.maximum(spread[0, 0], 0.0))
        return Estimate(density, speed, density_std, np.sqrt(np.maximum(variance, 0.0)))

    def _update_one(
        self, episode: int, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        one = self._horizons[episode]
        self.innovations[episode] = 0.0
        self.fallback[episode] = False
        values = np.where(observed[:, None], values, 0.0)
        sound = bool(np.isfinite(values).all() and np.isfinite(one.state).all())
        if sound:
            predicted = one.state
            try:
                self.fallback[episode] = not one.update(observed, values, sigma)
                self.innovations[episode, observed] = one.innovations(predicted)
                sound = bool(np.isfinite(one.P).all() and np.isfinite(one.state).all())
            except LinAlgError:  # a window without an inverse
                sound = False
        self.diverged[episode] = not sound
        if not sound:
            one.restart()
            self.innovations[episode] = 0.0
            self.fallback[episode] = False
