"""Moving horizon estimation by a general solver, a reference for the compiled one."""

from dataclasses import dataclass, field

import numpy as np

from dptse_env.estimators.batch import EpisodeMeasurements, Measurements
from dptse_env.estimators.horizon import (
    LEAST_DEVIATION,
    Window,
    assemble,
    moving_variance,
    normalised_bounds,
    settings_of_mhe,
    solve,
)
from dptse_env.estimators.noise import count_variance, initial_variance
from dptse_env.estimators.reference.kalman import (
    EpisodeFilter,
    ReferenceFilter,
    step_variance,
)
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import BoolArray, FloatArray


@dataclass
class _Stage:
    """Stage of the window, normalised, with the transition to the next one."""

    predicted: FloatArray  # (n_x,)
    solution: FloatArray  # (n_x,)
    point: FloatArray  # (n_x,) where "paper" linearises the measurement
    observed: BoolArray  # (M,)
    values: FloatArray  # (M, 2)
    noise: FloatArray  # (M, 2)
    centre: FloatArray | None  # (S,) v_0 [km/h]
    C: FloatArray  # (M, 2, n_x)
    c_2: FloatArray  # (M,)
    # Set when the stage is left, and when it is linearised.
    inputs: FloatArray = field(init=False)  # (n_u,)
    process_variance: FloatArray = field(init=False)  # (n_x,)
    A: FloatArray = field(init=False)
    c_1: FloatArray = field(init=False)


class _EpisodeWindow:
    """Window of an episode and its estimate, mean and covariance of the last state.

    The covariance is that of the last update; predictions do not change it.
    """

    def __init__(self, model: ARZModel, settings: EstimatorSettings) -> None:
        self.model, self.settings, self.mhe = model, settings, settings.mhe
        self.scale = model.state_scale
        self.measurement_scale = model.measurement_scale
        self.bounds = normalised_bounds(model, self.mhe.bounds)
        self.prior = np.zeros(model.n_states)
        self.restart()

    arrival_variance: FloatArray

    @property
    def state(self) -> FloatArray:
        """Mean `(1, n_x)` in physical units."""
        return np.asarray(self.x[None] * self.scale)

    @state.setter
    def state(self, state: FloatArray) -> None:
        self.x = self.model.project(state, self.mhe.bounds)[0] / self.scale

    def restart(self) -> None:
        """Reset to a window of a single stage, the prior."""
        self.state, self.unsolved = self.prior[None], False
        self.arrival_variance = initial_variance(self.model, self.settings)
        self.P = np.diag(self.arrival_variance)
        self.stages = [self._stage(self.x)]

    def advance(self, u: FloatArray) -> None:
        """Append the model's prediction as a stage, and drop the oldest one of a full window."""
        mean = np.mean([stage.solution for stage in self.stages], axis=0)
        before = self.stages[-1]
        before.inputs = u
        before.process_variance = step_variance(self)
        self.state = self.model.step(self.model.project(self.state), u[None])
        self.stages.append(self._stage(mean))
        if self.mhe.linearisation == "paper":
            self._linearise_step(before, mean)
        if len(self.stages) > self.mhe.horizon + 1:
            self.stages.pop(0)
            self.arrival_variance = moving_variance(self.model, self.settings)

    def assimilate(self, measured: EpisodeMeasurements) -> FloatArray:
        """Update by measurements of the last stage; return their normalised innovations."""
        stage, self.unsolved = self.stages[-1], False
        observed = stage.observed = measured.observed.copy()  # callers may reuse their arrays
        stage.values = np.where(observed[:, None], measured.values, 0.0) / self.measurement_scale
        stage.noise = self._noise(measured.sigma)
        stage.centre = measured.centre.copy()
        if self.mhe.linearisation == "paper":
            self._linearise_measurement(stage, stage.point)
        else:
            for earlier in self.stages:
                self._linearise_measurement(earlier, earlier.solution)
                if earlier is not stage:
                    self._linearise_step(earlier, earlier.solution)
        H, q = assemble(self.window())
        n = self.model.n_states
        self.P = np.asarray(np.linalg.solve(H, np.eye(len(H))[:, -n:])[-n:], dtype=np.float64)
        innovations = self._innovations()
        if observed.any():  # else the prediction stands
            lower, upper = (np.tile(bound, len(self.stages)) for bound in self.bounds)
            z = solve(H, q, lower, upper, self.mhe.solver)
            self.unsolved = z is None
            if z is not None:
                for earlier, solution in zip(self.stages, z.reshape(-1, n), strict=True):
                    earlier.solution = solution
                self.state = (z[-n:] * self.scale)[None]
        return innovations

    def window(self) -> Window:
        """Return the linearised problem as arrays."""
        stages = self.stages
        n = self.model.n_states
        targets = np.stack([stage.values for stage in stages])
        targets[..., 1] -= np.stack([stage.c_2 for stage in stages])
        return Window(
            arrival=stages[0].predicted,
            arrival_variance=self.arrival_variance.copy(),
            transitions=np.array([stage.A for stage in stages[:-1]]).reshape(-1, n, n),
            offsets=np.array([stage.c_1 for stage in stages[:-1]]).reshape(-1, n),
            process_variance=np.array([one.process_variance for one in stages[:-1]]).reshape(-1, n),
            observed=np.stack([stage.observed for stage in stages]),
            rows=np.stack([stage.C for stage in stages]),
            targets=targets,
            noise=np.stack([stage.noise for stage in stages]),
        )

    def _innovations(self) -> FloatArray:
        """Return residuals `(m, 2)` at the prediction over their predicted deviations."""
        stage = self.stages[-1]
        C = stage.C[stage.observed].reshape(-1, self.model.n_states)
        R = stage.noise[stage.observed].ravel()
        before = np.linalg.inv(np.linalg.inv(self.P) - C.T @ (C / R[:, None]))
        spread = np.sqrt(np.diag(C @ before @ C.T) + R).reshape(-1, 2)
        expected = self.model.measure(self.state, stage.centre)[0] / self.measurement_scale
        return np.asarray((stage.values - expected)[stage.observed] / spread)

    def _noise(self, sigma: FloatArray) -> FloatArray:
        """Return the variances `(M, 2)` of measurements with deviations `(M, 2)`."""
        rows = self.model.rows
        noise: FloatArray = np.maximum(sigma / self.measurement_scale, LEAST_DEVIATION) ** 2
        density = rows.weights @ self.model.density(self.state)[0]
        noise[:, 0] += count_variance(self.model, self.settings) * density / rows.span
        return noise

    def _stage(self, point: FloatArray) -> _Stage:
        """Return a stage at the present mean, without measurements."""
        n_rows = self.model.rows.n_rows
        return _Stage(
            self.x,
            self.x,
            point,
            observed=np.zeros(n_rows, dtype=np.bool_),
            values=np.zeros((n_rows, 2)),
            noise=np.ones((n_rows, 2)),
            centre=None,
            C=np.zeros((n_rows, 2, self.model.n_states)),
            c_2=np.zeros(n_rows),
        )

    def _linearise_step(self, stage: _Stage, point: FloatArray) -> None:
        """Set A and B u + c_1 at the physical state nearest to a point."""
        state = self.model.project((point * self.scale)[None])
        inputs = stage.inputs[None]
        stage.A = self.model.jacobian(state, inputs)[0] * self.scale / self.scale[:, None]
        after = self.model.step(state, inputs)[0] / self.scale
        stage.c_1 = after - stage.A @ (state[0] / self.scale)

    def _linearise_measurement(self, stage: _Stage, point: FloatArray) -> None:
        """Set C, and c_2 of the second number, at the physical state nearest to a point."""
        state = self.model.project((point * self.scale)[None])
        unit = self.measurement_scale
        matrix = self.model.measurement_matrix(state, stage.centre)[0]
        stage.C = matrix * self.scale / unit[:, None]
        second = self.model.measure(state, stage.centre)[0, :, 1] / unit[1]
        stage.c_2 = second - np.sum(stage.C[:, 1] * (state[0] / self.scale), axis=1)


class ReferenceMHE(ReferenceFilter):
    """Moving horizon estimation (paper, eq. 14 to 17) by qpsolvers, a window per episode.

    Standard deviations are those of the last block of H's inverse: the last state's covariance
    given the window, without bounds. The model is linearised, and predicts, at the nearest state
    in the cone, since in the paper's box w is unbounded.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        self._windows: list[_EpisodeWindow] = []
        super().__init__(model, n_episodes, settings_of_mhe(settings))

    def window(self, episode: int) -> Window:
        """Return the linearised problem of an episode, for `assemble`."""
        return self._windows[episode].window()

    def _filter(self) -> EpisodeFilter:
        self._windows.append(_EpisodeWindow(self.model, self.settings))
        return self._windows[-1]

    def _update(self, measured: Measurements) -> None:
        super()._update(measured)
        for episode in measured.episodes.tolist():
            self.fallback[episode] = self._windows[episode].unsolved
