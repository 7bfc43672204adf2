"""What others offer, used as its documentation shows: filterpy's filters, qpsolvers' solvers.

filterpy's filters call the compiled model once a point or member, which favours them: in numpy a
point costs fifty times as much. Their noise is given as a matrix. They take the first steps of
each block, from the mean and covariance that the EKF has there, since points that nobody projects
leave the physical states in time. Of the MHE's peers the solver alone is timed, not what
assembles its program.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import qpsolvers
import scipy.sparse as sp
from filterpy.kalman import (
    EnsembleKalmanFilter,
    ExtendedKalmanFilter,
    MerweScaledSigmaPoints,
    UnscentedKalmanFilter,
)

from benchmarks.replay import Replay
from benchmarks.timing import Row
from dptse_env.estimators import make_estimator
from dptse_env.estimators.horizon import assemble, normalised_bounds
from dptse_env.model.compiled import CompiledARZModel
from dptse_env.utils.arrays import BoolArray, FloatArray

SAMPLE = 3  # steps taken in each block


class Plain:
    """The model of one state at a time in normalised units, as a user would write it."""

    def __init__(self, replay: Replay) -> None:
        """Take the model; inputs and observed segments are to be set for each step."""
        own = replay.model
        self.model = CompiledARZModel(own.network, own.parameters, own.time_step)
        rho_m, v_f = own.density_scale, own.speed_scale
        self.scale = np.tile([rho_m, rho_m * v_f], own.n_segments)
        self.measured_scale = np.array([rho_m, v_f])
        self.inputs: FloatArray = replay.inputs[0, 0]
        self.observed: BoolArray = replay.observed[0, 0]

    def f(self, x: FloatArray, dt: float = 1.0) -> FloatArray:
        """Return the state one step later."""
        return self.model.step((x * self.scale)[None], self.inputs[None])[0] / self.scale

    def h(self, x: FloatArray) -> FloatArray:
        """Return what the observed segments measure."""
        measured = self.model.measure((x * self.scale)[None])[0] / self.measured_scale
        return np.asarray(measured[self.observed]).ravel()

    def by_state(self, x: FloatArray) -> FloatArray:
        """F."""
        jacobian = self.model.jacobian((x * self.scale)[None], self.inputs[None])[0]
        return jacobian * self.scale / self.scale[:, None]

    def outputs_by_state(self, x: FloatArray) -> FloatArray:
        """H."""
        blocks = self.model.measurement_jacobian((x * self.scale)[None])[0]
        blocks = blocks * self.scale[:2] / self.measured_scale[:, None]
        segments = np.flatnonzero(self.observed)
        jacobian = np.zeros((segments.size, 2, x.size))
        for i, segment in enumerate(segments):
            jacobian[i, :, 2 * segment : 2 * segment + 2] = blocks[segment]
        return jacobian.reshape(-1, x.size)


class _MovedEKF(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter with a motion that is not linear, which it wants a subclass for."""

    plain: Plain

    def predict_x(self, u: FloatArray | float = 0) -> None:
        self.F = self.plain.by_state(self.x)
        self.x = self.plain.f(self.x)


class FilterPeer(Row):
    """A filter of filterpy on the first steps of each block."""

    def __init__(self, estimator: str, replay: Replay, block: int) -> None:
        """Run an EKF through the replay for the states that blocks start from."""
        super().__init__(estimator, "filterpy")
        self.replay, self.plain = replay, Plain(replay)
        self.starts = ekf_states(replay, block, self.plain.scale)
        size, outputs = replay.model.n_states, replay.n_outputs
        self.R = np.diag(np.tile(np.square(replay.sigma / self.plain.measured_scale), outputs // 2))
        Q = np.diag(np.tile(np.square(replay.settings.process_noise), size // 2))
        f, h, settings = self.plain.f, self.plain.h, replay.settings
        if estimator == "ekf":
            self.own = _MovedEKF(dim_x=size, dim_z=outputs)
            self.own.plain = self.plain
        elif estimator == "ukf":
            ukf = settings.ukf
            points = MerweScaledSigmaPoints(size, alpha=ukf.alpha, beta=ukf.beta, kappa=ukf.kappa)
            self.own = UnscentedKalmanFilter(size, outputs, 1.0, h, f, points)
        else:
            x, P = self.starts[0]
            self.own = EnsembleKalmanFilter(x, P, outputs, 1.0, settings.enkf.n_members, h, f)
        self.own.Q = Q

    def begin(self) -> None:
        """Every block starts by itself."""

    def run(self, steps: range) -> Iterator[tuple[int, float]]:
        """Take the first steps of a block."""
        x, P = self.starts[steps.start]
        if self.estimator == "enkf":
            self.own.initialize(x.copy(), P.copy())
        else:
            self.own.x, self.own.P = x.copy(), P.copy()
        plain, replay = self.plain, self.replay
        for k in steps[:SAMPLE]:
            plain.inputs, plain.observed = replay.inputs[k, 0], replay.observed[k, 0]
            z = (replay.values[k, 0] / plain.measured_scale)[plain.observed].ravel()
            start = time.perf_counter()
            self.own.predict()
            if self.estimator == "ekf":
                self.own.update(z, plain.outputs_by_state, plain.h, R=self.R)
            else:
                self.own.update(z, R=self.R)
            seconds = time.perf_counter() - start
            if not np.isfinite(self.own.x).all():
                raise RuntimeError(f"filterpy's {self.estimator} is not finite at step {k}")
            yield k, seconds


def ekf_states(
    replay: Replay, block: int, scale: FloatArray
) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Normalised means and covariances of an EKF ahead of each block."""
    own: Any = make_estimator("ekf", "compiled", replay.model, 1, replay.settings)
    one, starts = np.arange(1), {}
    own.reset(one, replay.start[:1], [np.random.default_rng(0)])
    for k in range(replay.n_steps):
        if k % block == 0:
            starts[k] = own.states[0] / scale, own.covariances[0]
        own.predict(one, replay.inputs[k, :1])
        own.update(one, replay.observed[k, :1], replay.values[k, :1], replay.sigma)
    return starts


Program = tuple[sp.csc_matrix, FloatArray, FloatArray, FloatArray]


class SolverPeer(Row):
    """A solver of qpsolvers, its settings left alone, on programs of the first steps of blocks.

    Attributes:
        n_bound: Programs whose optimum lies at a bound, among those solved.
        n_solved: Programs solved.
    """

    def __init__(self, solver: str, replay: Replay, programs: dict[int, Program]) -> None:
        """Take the programs, by step, as `programs_of` makes them."""
        super().__init__("mhe", f"qpsolvers, {solver}")
        self.solver, self.replay = solver, replay
        # Sparse where a solver takes both: dense, piqp needs several times as long.
        is_dense = solver not in qpsolvers.sparse_solvers
        self.programs = {
            k: (P.toarray() if is_dense else P, q, lower, upper)
            for k, (P, q, lower, upper) in programs.items()
        }
        self.n_bound = self.n_solved = 0

    def begin(self) -> None:
        """Count anew."""
        self.n_bound = self.n_solved = 0

    def run(self, steps: range) -> Iterator[tuple[int, float]]:
        """Solve what there is."""
        for k in steps:
            if k not in self.programs:
                continue
            P, q, lower, upper = self.programs[k]
            start = time.perf_counter()
            z = qpsolvers.solve_qp(P, q, lb=lower, ub=upper, solver=self.solver)
            seconds = time.perf_counter() - start
            if z is None:
                raise RuntimeError(f"{self.solver} did not solve the program of step {k}")
            self.n_solved += 1
            self.n_bound += bool(np.any((z < lower + 1e-6) | (z > upper - 1e-6)))
            yield k, seconds


def programs_of(replay: Replay, block: int) -> dict[int, Program]:
    """The MHE's programs at the first steps of blocks, in a pass of the compiled one."""
    own: Any = make_estimator("mhe", "compiled", replay.model, 1, replay.settings)
    one, programs = np.arange(1), {}
    own.reset(one, replay.start[:1], [np.random.default_rng(0)])
    lower, upper = normalised_bounds(replay.model, replay.settings.mhe.bounds)
    for k in range(replay.n_steps):
        own.predict(one, replay.inputs[k, :1])
        own.update(one, replay.observed[k, :1], replay.values[k, :1], replay.sigma)
        if k % block < SAMPLE:
            H, q = assemble(own.window(0))
            stages = len(q) // lower.size
            P = sp.csc_matrix(2.0 * H)  # qpsolvers minimises z' P z / 2 + q' z
            programs[k] = P, q, np.tile(lower, stages), np.tile(upper, stages)
    return programs


def peers(estimator: str, replay: Replay, block: int) -> list[Row]:
    """Rows of an estimator's peers; those of solvers that are installed."""
    if estimator != "mhe":
        return [FilterPeer(estimator, replay, block)]
    programs = programs_of(replay, block)
    solvers = [name for name in ("piqp", "quadprog") if name in qpsolvers.available_solvers]
    return [SolverPeer(name, replay, programs) for name in solvers]
