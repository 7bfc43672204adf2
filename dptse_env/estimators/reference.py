"""Textbook filters, with which the compiled ones are compared.

The EKF and the UKF are filterpy's, the moving horizon estimator is solved by qpsolvers, and the
EnKF is written in numpy: filterpy's draws from numpy's global generator, has a fixed number of
outputs and predicts members one by one. Each episode has a filter of its own. All of it is in
normalised units: rho by rho_m, psi by rho_m v_f, released numbers by their units (`Problem`).
"""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, LinAlgWarning
from scipy.sparse.linalg import splu

from dptse_env.estimators.base import Estimate, Estimator, Measurement, estimated_traffic
from dptse_env.estimators.ekf import initial_variance, process_variance
from dptse_env.estimators.enkf import make_tapers
from dptse_env.estimators.mhe import (
    LEAST_DEVIATION,
    moving_variance,
    normalised_bounds,
    settings_of_mhe,
)
from dptse_env.estimators.normals import draw, make_stream
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.estimators.window import AT_BOUND
from dptse_env.model import ARZModel
from dptse_env.model.parameters import LARGEST_W, Bounds
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.registry import needed_for

with needed_for("backend='reference'"):
    import qpsolvers
    from filterpy.kalman import (
        ExtendedKalmanFilter,
        MerweScaledSigmaPoints,
        UnscentedKalmanFilter,
        unscented_transform,
    )

# Largest natural residual of an optimum, in normalised states.
RESIDUAL = 1e-8
# Solutions with a larger residual are not inaccurate optima, but wrong. The largest one of piqp is
# 4e-5, and 2e-2 where measurements are treated as exact.
ROUGH = 0.05
# Number of polishing steps; a second step mostly corrects what the first one missed.
POLISHES = 10


class Problem:
    """The equations of a filter: x' = f(x, u) + N(0, Q), z = h(x) + N(0, R), normalised.

    States x have the shape `(k, n_x)`, the means of distributions `(n_x,)`. The m observed channels
    of a measurement have 2 m numbers.
    """

    def __init__(self, model: ARZModel, settings: EstimatorSettings) -> None:
        """Take a model and the settings of the noise."""
        self.model, self.settings = model, settings
        self.unit, self.release_unit = model.state_scale, model.measurement_scale
        self.n_states = model.n_states
        self.prior_variance = initial_variance(model, settings)
        self._process_variance = process_variance(model, settings)

    def project(self, x: FloatArray, bounds: Bounds | None = None) -> FloatArray:
        """Return the states within bounds, by default the filter's."""
        bounds = self.settings.bounds if bounds is None else bounds
        return np.asarray(self.model.project(x * self.unit, bounds) / self.unit)

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the states one step later."""
        inputs = np.repeat(u[None], len(x), axis=0)
        return np.asarray(self.model.step(x * self.unit, inputs) / self.unit)

    def F(self, x: FloatArray, u: FloatArray) -> FloatArray:  # noqa: N802
        """Return the derivative of f at a mean, `(n_x, n_x)`."""
        jacobian = self.model.jacobian((x * self.unit)[None], u[None])[0]
        return np.asarray(jacobian * self.unit / self.unit[:, None])

    def Q(self, x: FloatArray) -> FloatArray:  # noqa: N802
        """Return the covariance `(n_x, n_x)` of the noise of a step that leaves a mean."""
        rho = self._density(x) / self.model.density_scale
        psi = self.project(x[None])[0, 1 : 2 * len(rho) : 2]
        w = np.minimum(psi / np.where(rho > 0.0, rho, np.inf), LARGEST_W)
        of_vehicles, of_psi = np.square(self.settings.vehicle_noise)
        covariance = np.diag(self._process_variance)
        for s in range(len(rho)):
            i, j = 2 * s, 2 * s + 1
            direction = np.array([1.0, w[s]])
            covariance[i : j + 1, i : j + 1] += (
                of_vehicles * rho[s] * np.outer(direction, direction)
            )
            covariance[j, j] += of_psi * rho[s]
        return covariance

    def z(self, seen: Measurement) -> FloatArray:
        """Return the observed numbers `(2 m,)`."""
        return np.asarray((seen.values[seen.observed] / self.release_unit).ravel())

    def h(self, x: FloatArray, seen: Measurement) -> FloatArray:
        """Return the numbers that states would give, `(k, 2 m)`."""
        released = self.model.measure(x * self.unit, seen.centre)[:, seen.observed]
        return np.asarray((released / self.release_unit).reshape(len(x), -1))

    def H(self, x: FloatArray, seen: Measurement) -> FloatArray:  # noqa: N802
        """Return the derivative of h at a mean, `(2 m, n_x)`."""
        matrix = self.model.measurement_matrix((x * self.unit)[None], seen.centre)[0]
        matrix = matrix[seen.observed] * self.unit / self.release_unit[:, None]
        return np.asarray(matrix.reshape(-1, self.n_states))

    def R(self, seen: Measurement, least: float = 0.0) -> FloatArray:  # noqa: N802
        """Return the variances `(2 m,)` of the noise of a measurement, deviations >= `least`."""
        variance = np.maximum(seen.sigma / self.release_unit, least) ** 2
        return np.asarray(variance[seen.observed].ravel())

    def _density(self, x: FloatArray) -> FloatArray:
        """Return the densities `(S,)` of a mean within bounds [veh/km]."""
        return np.asarray(self.model.density(self.project(x[None]) * self.unit)[0])


class EpisodeFilter(ABC):
    """The filter of an episode.

    Attributes:
        problem: The equations.
        prior: Mean of the prior, `(n_x,)`.
        x: Mean, `(n_x,)`.
        P: Covariance, `(n_x, n_x)`.
        has_failed: Whether the last measurement left the prediction, for want of a solution.
    """

    problem: Problem
    prior: FloatArray
    x: FloatArray
    P: FloatArray
    has_failed: bool = False

    def reset(self, prior: FloatArray, generator: np.random.Generator) -> None:
        """Begin at a prior; `generator` is for filters that draw."""
        del generator
        self.prior = prior
        self.restart()

    def restart(self) -> None:
        """Return to the prior."""
        self.x, self.P = self.prior.copy(), np.diag(self.problem.prior_variance)

    @abstractmethod
    def advance(self, u: FloatArray) -> None:
        """Predict one step ahead under inputs `(n_u,)`."""

    @abstractmethod
    def assimilate(self, seen: Measurement) -> FloatArray:
        """Update by a measurement of any channels; return their normalised innovations `(2 m,)`."""

    def is_sound(self) -> bool:
        """Return whether mean and variances are valid and no correlation is above one."""
        if not (np.isfinite(self.x).all() and np.isfinite(self.P).all()):
            return False
        variance = np.diag(self.P)
        allowed = (1.0 + 1e-9) * np.outer(variance, variance) + 1e-24
        return bool(np.all(variance >= 0.0) and np.all(allowed >= self.P**2))


class ReferenceFilter(Estimator):
    """A batch of filters.

    Attributes:
        filters: The filter of each episode.
    """

    reads_flicker = True
    _filter_type: ClassVar[type[Any]]

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        problem = Problem(model, settings)
        self.filters = [self._filter_type(problem) for _ in range(n_episodes)]
        nothing = np.zeros((n_episodes, model.n_segments))
        states = model.compose(nothing, nothing)
        self._reset(np.arange(n_episodes), states, [np.random.default_rng(0)] * n_episodes)

    @property
    def states(self) -> FloatArray:
        """Means `(n, n_x)` [veh/km, veh/h], then demand factors if there are any."""
        means = np.stack([each.x for each in self.filters])
        return self.model.project(means * self.model.state_scale, self.settings.bounds)

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, n_x, n_x)`, rho normalised by rho_m and psi by rho_m v_f."""
        return np.stack([each.P for each in self.filters])

    def _estimate(self) -> Estimate:
        states, S = self.states, self.model.n_segments
        jacobian = self.model.traffic_jacobian(states) * self.model.state_scale[:2]
        joint = self.covariances[:, : 2 * S, : 2 * S].reshape(-1, S, 2, S, 2)
        variance = np.einsum("nsij,nsjsk,nsik->nsi", jacobian, joint, jacobian)
        deviation = np.sqrt(np.maximum(variance, 0.0))
        density, speed = estimated_traffic(self.model, states)
        return Estimate(density, speed, deviation[..., 0].copy(), deviation[..., 1].copy())

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        means = self.model.project(states, self.settings.bounds) / self.model.state_scale
        for episode, mean, generator in zip(episodes.tolist(), means, generators, strict=True):
            self.filters[episode].reset(mean, generator)

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        with np.errstate(all="ignore"):  # the update detects overflows
            for episode, u in zip(episodes.tolist(), inputs, strict=True):
                try:
                    self.filters[episode].advance(u)
                except LinAlgError:  # no root of P; the update resets the filter
                    self.filters[episode].x[:] = np.nan

    def _update(self, episodes: IntArray, measured: Measurement) -> None:
        measured = self._flickering(episodes, measured)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("error", LinAlgWarning)
            for k, episode in enumerate(episodes.tolist()):
                self._update_one(episode, measured.at(k))

    def _means_of(self, episodes: IntArray) -> FloatArray:
        return self.states[episodes]

    def _update_one(self, episode: int, seen: Measurement) -> None:
        each, innovations = self.filters[episode], np.zeros_like(self.innovations[episode])
        sound = each.is_sound() and bool(np.isfinite(seen.values[seen.observed]).all())
        if sound:
            try:
                innovations[seen.observed] = each.assimilate(seen).reshape(-1, 2)
                sound = each.is_sound()
            except (LinAlgError, LinAlgWarning):  # no inverse, or an inaccurate one
                sound = False
        self.fallback[episode] = sound and each.has_failed
        self.diverged[episode] = not sound
        self.innovations[episode] = innovations if sound else 0.0
        if not sound:
            each.restart()


class _ExtendedFilter(EpisodeFilter, ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter with the derivatives of the problem."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.n_states, 2 * problem.model.channels.size)
        self.problem = problem

    def predict_x(self, u: FloatArray) -> None:
        """Predict by f instead of a matrix."""
        self.F, self.Q = self.problem.F(self.x, u), self.problem.Q(self.x)
        self.x = self.problem.project(self.problem.f(self.x[None], u))[0]

    def advance(self, u: FloatArray) -> None:
        self.predict(u)

    def assimilate(self, seen: Measurement) -> FloatArray:
        if not seen.observed.any():
            return np.zeros(0)
        problem, noise = self.problem, np.diag(self.problem.R(seen))
        self.update(
            problem.z(seen),
            lambda x: problem.H(x, seen),
            lambda x: problem.h(x[None], seen)[0],
            R=noise,
        )
        self.x = problem.project(self.x[None])[0]
        return np.asarray(self.y / np.sqrt(np.diag(self.S)))


class ReferenceEKF(ReferenceFilter):
    """Extended Kalman filter by filterpy."""

    _filter_type = _ExtendedFilter


def _mean(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted mean relative to the first point: weights near -110 would lose two digits."""
    return np.asarray(points[0] + weights[1:] @ (points[1:] - points[0]))


class _UnscentedFilter(EpisodeFilter, UnscentedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter with points that are drawn once a step.

    filterpy would draw again at the end of `predict`. With projected points these would not agree
    with mean and covariance, and P would become indefinite within a few steps.
    """

    def __init__(self, problem: Problem) -> None:
        ukf, n = problem.settings.ukf, problem.n_states
        points = MerweScaledSigmaPoints(n, alpha=ukf.alpha, beta=ukf.beta, kappa=ukf.kappa)
        sizes = n, 2 * problem.model.channels.size, problem.model.time_step
        super().__init__(*sizes, None, None, points, x_mean_fn=_mean, z_mean_fn=_mean)
        self.problem = problem

    def restart(self) -> None:
        super().restart()
        self.has_points = False

    def advance(self, u: FloatArray) -> None:
        covariance = self.problem.Q(self.x)
        self._draw(u)
        self.P += covariance

    def _draw(self, u: FloatArray | None) -> None:
        """Draw points, move them by f where there are inputs, and take their moments."""
        points = self.points_fn.sigma_points(self.problem.project(self.x[None])[0], self.P)
        if u is not None:
            points = self.problem.f(points, u)
        self.sigmas_f = self.problem.project(points)
        self.x, self.P = unscented_transform(self.sigmas_f, self.Wm, self.Wc, None, _mean)
        self.has_points = True

    def cross_variance(
        self, x: FloatArray, z: FloatArray, sigmas_f: FloatArray, sigmas_h: FloatArray
    ) -> FloatArray:
        """Replace filterpy's loop over points by a product of matrices."""
        return np.asarray((sigmas_f - x).T @ (self.Wc[:, None] * (sigmas_h - z)))

    def assimilate(self, seen: Measurement) -> FloatArray:
        if not seen.observed.any():
            return np.zeros(0)
        noise = np.diag(self.problem.R(seen))
        if not self.has_points:
            self._draw(None)
        outputs = iter(self.problem.h(self.sigmas_f, seen))
        self.update(self.problem.z(seen), R=noise, hx=lambda _: next(outputs))
        self.x, self.has_points = self.problem.project(self.x[None])[0], False
        return np.asarray(self.y / np.sqrt(np.diag(self.S)))


class ReferenceUKF(ReferenceFilter):
    """Unscented Kalman filter by filterpy."""

    _filter_type = _UnscentedFilter


class _Ensemble(EpisodeFilter):
    """An ensemble `(n_members, n_x)`, whose sample has the mean x and the covariance P."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.enkf = problem, problem.settings.enkf
        n_rows, taper = problem.model.channels.size, self.enkf.taper
        self.tapers = np.ones((n_rows, problem.n_states)), np.ones((n_rows, n_rows))
        if taper is not None:
            self.tapers = make_tapers(problem.model, taper)

    @property
    def x(self) -> FloatArray:  # type: ignore[override]
        return np.asarray(self.members.mean(axis=0))

    @property
    def P(self) -> FloatArray:  # type: ignore[override]  # noqa: N802
        return np.asarray(np.cov(self.members.T))

    def reset(self, prior: FloatArray, generator: np.random.Generator) -> None:
        """Begin with the random numbers of `EnKF`."""
        self.process, self.measurement = make_stream(generator), make_stream(generator)
        super().reset(prior, generator)

    def restart(self) -> None:
        members = np.repeat(self.prior[None], self.enkf.n_members, axis=0)
        self.members = self._perturbed(members, np.diag(self.problem.prior_variance))

    def _perturbed(self, members: FloatArray, covariance: FloatArray) -> FloatArray:
        drawn = draw(self.process, members.size).reshape(members.shape[::-1]).T
        return self.problem.project(members + drawn @ np.linalg.cholesky(covariance).T)

    def advance(self, u: FloatArray) -> None:
        covariance = self.problem.Q(self.x)
        self.members = self._perturbed(self.problem.f(self.members, u), covariance)

    def assimilate(self, seen: Measurement) -> FloatArray:
        if not seen.observed.any():
            return np.zeros(0)
        problem, row = self.problem, np.repeat(np.flatnonzero(seen.observed), 2)
        mean = self.x
        members = problem.project(mean + self.enkf.inflation * (self.members - mean))
        outputs, z = problem.h(members, seen), problem.z(seen)
        R = problem.R(seen)
        X, D = members - members.mean(axis=0), outputs - outputs.mean(axis=0)
        with_states, among_channels = self.tapers
        cross = with_states[row].T * (X.T @ D) / (len(members) - 1)
        S = among_channels[np.ix_(row, row)] * (D.T @ D) / (len(members) - 1) + np.diag(R)
        np.linalg.cholesky(S)  # refuses one that is not definite
        drawn = draw(self.measurement, outputs.size).reshape(outputs.shape[::-1]).T
        residuals = z + np.sqrt(R) * drawn - outputs
        self.members = members + np.linalg.solve(S, residuals.T).T @ cross.T
        if np.isfinite(self.members).all():  # else a projection would hide it
            self.members = problem.project(self.members)
        return np.asarray((z - outputs.mean(axis=0)) / np.sqrt(np.diag(S)))


class ReferenceEnKF(ReferenceFilter):
    """Ensemble Kalman filter with perturbed observations, with the random numbers of `EnKF`."""

    _filter_type = _Ensemble

    @property
    def members(self) -> FloatArray:
        """Members `(n, n_members, n_x)` [veh/km, veh/h], then demand factors; a copy."""
        return np.asarray(
            np.stack([each.members for each in self.filters]) * self.model.state_scale
        )

    @property
    def states(self) -> FloatArray:
        """Means of the members `(n, n_x)` [veh/km, veh/h], then demand factors if any."""
        return np.asarray(self.members.mean(axis=1))

    def _estimate(self) -> Estimate:
        mean = self.model.traffic(self.states)
        members = self.members
        spread = self.model.traffic(members.reshape(-1, members.shape[-1]))
        spread = spread.reshape(*members.shape[:2], -1, 2).std(axis=1, ddof=1)
        speed = np.clip(mean[..., 1], 0.0, self.model.largest_speed)
        return Estimate(mean[..., 0].copy(), speed, spread[..., 0].copy(), spread[..., 1].copy())


@dataclass
class _Stage:
    """A stage of a window, linearised: x' = A x + c, z = C x + e."""

    predicted: FloatArray  # (n_x,)
    solution: FloatArray  # (n_x,)
    point: FloatArray  # (n_x,) where "published" linearises the measurement
    seen: Measurement | None = None
    R: FloatArray = field(default_factory=lambda: np.zeros(0))  # (2 m,)
    C: FloatArray = field(init=False)  # (2 m, n_x)
    e: FloatArray = field(init=False)  # (2 m,)
    # Set when the stage is left.
    u: FloatArray = field(init=False)  # (n_u,)
    Q: FloatArray = field(init=False)  # (n_x, n_x)
    A: FloatArray = field(init=False)  # (n_x, n_x)
    c: FloatArray = field(init=False)  # (n_x,)


class _Window(EpisodeFilter):
    """A window of stages; P is the covariance of the last one at the last update."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.mhe = problem, problem.settings.mhe
        self.bounds = normalised_bounds(problem.model, self.mhe.bounds)

    def restart(self) -> None:
        """Return to a window of a single stage, the prior."""
        super().restart()
        self.arrival_variance = self.problem.prior_variance
        self.stages = [_Stage(self.x, self.x, self.x)]
        self.has_failed = False

    def advance(self, u: FloatArray) -> None:
        """Append the model's prediction as a stage, and drop the oldest one of a full window."""
        problem, before = self.problem, self.stages[-1]
        mean = np.mean([stage.solution for stage in self.stages], axis=0)
        before.u, before.Q = u, problem.Q(self.x)
        after = problem.f(problem.project(self.x[None], "cone"), u)
        self.x = problem.project(after)[0]
        self.stages.append(_Stage(self.x, self.x, mean))
        if self.mhe.linearisation == "published":
            self._linearise_step(before, mean)
        if len(self.stages) > self.mhe.horizon + 1:
            self.stages.pop(0)
            self.arrival_variance = moving_variance(problem.model, problem.settings)

    def assimilate(self, seen: Measurement) -> FloatArray:
        """Update by measurements of the last stage, and solve for the window."""
        stage, n = self.stages[-1], self.problem.n_states
        # Callers may reuse their arrays.
        observed, values, sigma, centre = seen
        stage.seen = Measurement(observed.copy(), values.copy(), sigma.copy(), centre.copy())
        self.has_failed = False
        stage.R = self.problem.R(seen, LEAST_DEVIATION)
        if self.mhe.linearisation == "published":
            self._linearise_measurement(stage, stage.point)
        else:
            for each in self.stages:
                self._linearise_measurement(each, each.solution)
                if each is not stage:
                    self._linearise_step(each, each.solution)
        H, q = self.program()
        self.P = np.asarray(np.linalg.solve(H, np.eye(len(H))[:, -n:])[-n:], dtype=np.float64)
        innovations = self._innovations()
        if seen.observed.any():  # else the prediction stands
            lower, upper = (np.tile(bound, len(self.stages)) for bound in self.bounds)
            solution = solve(H, q, lower, upper)
            self.has_failed = solution is None
            if solution is not None:
                for each, x in zip(self.stages, solution.reshape(-1, n), strict=True):
                    each.solution = x
                self.x = self.problem.project(solution[None, -n:])[0]
        return innovations

    def program(self) -> tuple[FloatArray, FloatArray]:
        """Return H and q of `minimise z' H z + q' z`, z the stages' states (eq. 17).

        It is the paper's eq. 14: the sum, weighted by inverse variances, of squared distances
        between the first state and its prediction, the measurements and C x + e, and the states
        and A x + c, but for a constant.
        """
        n, L = self.problem.n_states, len(self.stages)
        H, q = np.zeros((L * n, L * n)), np.zeros(L * n)
        H[:n, :n] = np.diag(1.0 / self.arrival_variance)
        q[:n] = -2.0 * self.stages[0].predicted / self.arrival_variance
        for i, stage in enumerate(self.stages):
            here, after = slice(i * n, (i + 1) * n), slice((i + 1) * n, (i + 2) * n)
            if stage.seen is not None:
                weighted = stage.C.T / stage.R
                H[here, here] += weighted @ stage.C
                q[here] -= 2.0 * weighted @ (self.problem.z(stage.seen) - stage.e)
            if i < L - 1:
                inverse = np.linalg.inv(stage.Q)
                weighted = stage.A.T @ inverse
                H[here, here] += weighted @ stage.A
                H[after, after] += inverse
                H[here, after] -= weighted
                H[after, here] -= weighted.T
                q[here] += 2.0 * weighted @ stage.c
                q[after] -= 2.0 * inverse @ stage.c
        return H, q

    def _innovations(self) -> FloatArray:
        """Return residuals `(2 m,)` at the prediction over their predicted deviations."""
        stage = self.stages[-1]
        seen: Any = stage.seen
        before = np.linalg.inv(np.linalg.inv(self.P) - stage.C.T @ (stage.C / stage.R[:, None]))
        deviation = np.sqrt(np.diag(stage.C @ before @ stage.C.T) + stage.R)
        expected = self.problem.h(self.x[None], seen)[0]
        return np.asarray((self.problem.z(seen) - expected) / deviation)

    def _linearise_step(self, stage: _Stage, point: FloatArray) -> None:
        """Set A and c at the physical state nearest to a point."""
        x = self.problem.project(point[None], "cone")
        stage.A = self.problem.F(x[0], stage.u)
        stage.c = self.problem.f(x, stage.u)[0] - stage.A @ x[0]

    def _linearise_measurement(self, stage: _Stage, point: FloatArray) -> None:
        """Set C and e at the physical state nearest to a point."""
        if stage.seen is not None:
            x = self.problem.project(point[None], "cone")
            stage.C = self.problem.H(x[0], stage.seen)
            stage.e = self.problem.h(x, stage.seen)[0] - stage.C @ x[0]


class ReferenceMHE(ReferenceFilter):
    """Moving horizon estimation (paper, eq. 14 to 17) by qpsolvers.

    Standard deviations are those of the last block of H's inverse: the last state's covariance
    given the window, without bounds. The model is linearised, and predicts, at the nearest state
    in the cone, since in the paper's box w is unbounded.
    """

    _filter_type = _Window

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings_of_mhe(settings))

    def program(self, episode: int) -> tuple[FloatArray, FloatArray]:
        """Return H `(L n_x, L n_x)` and q `(L n_x,)` of an episode, as `MHE.program`."""
        program: tuple[FloatArray, FloatArray] = self.filters[episode].program()
        return program


def natural_residual(
    H: FloatArray, q: FloatArray, lower: FloatArray, upper: FloatArray, z: FloatArray
) -> float:
    """Largest |z - clip(z - g / diag(2 H), lower, upper)|, g = 2 H z + q; 0 at the optimum only.

    The gradient is scaled by the diagonal, so that the residual is in units of z for any weights.
    It is NaN where z is.
    """
    step = (2.0 * H @ z + q) / (2.0 * np.diag(H))
    return float(np.max(np.abs(z - np.clip(z - step, lower, upper))))


def solve(H: FloatArray, q: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray | None:
    """Minimise z' H z + q' z within bounds by piqp; None where it finds no optimum.

    An interior point method stops short of the bounds, so its solution is polished several times:
    components that are nearly at a bound and pressed against it are set to it, and the others are
    solved for. The best solution is returned. The `natural_residual`, not the solver's status,
    decides whether a solution is worth polishing and whether the result is an optimum.
    """
    P = sp.csc_matrix(2.0 * H)  # qpsolvers minimises z' P z / 2 + q' z
    problem = qpsolvers.Problem(P, q, lb=lower, ub=upper)
    try:
        z = qpsolvers.solve_problem(problem, solver="piqp", eps_abs=1e-9, eps_rel=1e-9).x
    except qpsolvers.SolverError:
        return None
    if z is None:
        return None
    best = z = np.clip(z, lower, upper)
    if not natural_residual(H, q, lower, upper, z) <= ROUGH:  # a NaN is no optimum either
        return None
    for _ in range(POLISHES):
        try:
            z = _polish(P, q, lower, upper, z)
        except RuntimeError:  # splu: the matrix is singular
            break
        pair = best, np.clip(z, lower, upper)
        best = min(pair, key=lambda z: natural_residual(H, q, lower, upper, z))
    best = np.where(best < lower + AT_BOUND, lower, np.where(best > upper - AT_BOUND, upper, best))
    return best if natural_residual(H, q, lower, upper, best) <= RESIDUAL else None


def _polish(
    P: sp.csc_matrix, q: FloatArray, lower: FloatArray, upper: FloatArray, z: FloatArray
) -> FloatArray:
    """Set variables that are pressed against a bound to it, and solve for the others."""
    step = (P @ z + q) / P.diagonal()
    at_lower, at_upper = z - lower <= step, upper - z <= -step
    free = ~(at_lower | at_upper)
    exact: FloatArray = np.where(at_lower, lower, np.where(at_upper, upper, 0.0))
    factors = splu(P[free][:, free].tocsc())
    for _ in range(2):  # the second pass corrects rounding errors
        exact[free] += factors.solve(-(q + P @ exact)[free])
    return exact
