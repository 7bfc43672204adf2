"""Greedy designs against plain numpy: explicit Kalman updates of the whole state."""

import itertools

import numpy as np
import pytest

from dptse_env.schedules import COVARIANCE_SCHEDULES, make_schedule
from dptse_env.schedules.covariance import (
    NO_INFLATION,
    CovarianceInflation,
    GreedyTrace,
)
from tests.cases import fast_and_slow

from .playing import begin, make_batch

INFLATIONS = {
    "trusting": NO_INFLATION,
    "occupied": CovarianceInflation(occupied=True),
    "capped": CovarianceInflation(speed_cap=0.05),
    "noisy": CovarianceInflation(process_noise=(0.05, 0.02), occupied=True, speed_cap=0.1),
}


class Plain:
    """The coming second of one episode, with the estimator's covariance or another, in numpy."""

    def __init__(self, env, episode, inflation, covariance=None):
        self.process = process = env.unwrapped.process
        config, model, estimator = process.config, process.model, process.estimator
        self.model, self.n = model, config.corridor.n_mainline
        rho_m, v_f = model.density_scale, model.speed_scale
        self.scale = np.tile([rho_m, rho_m * v_f], model.n_segments)
        mean = estimator.states[[episode]]
        P = estimator.covariances[episode] if covariance is None else covariance
        one = np.array([episode])
        inputs = process.boundary.inputs(one, process.traffic_index[one], process.time[one])
        settings = config.settings()
        if config.estimator == "random_walk":
            self.F = np.eye(len(P))
            back = np.linalg.inv(self.whole(model.traffic_jacobian(mean)[0], [rho_m, v_f]))
            q = inflation.process_noise or settings.walk_noise
            self.Q = back @ np.diag(np.tile(np.square(q), model.n_segments)) @ back.T
            self.mean = mean
        else:
            self.F = model.jacobian(mean, inputs)[0] * self.scale / self.scale[:, None]
            q = inflation.process_noise or settings.process_noise
            self.Q = np.diag(np.tile(np.square(q), model.n_segments))
            self.mean = model.project(model.step(mean, inputs), settings.bounds)
        H = model.measurement_matrix(self.mean)[0] / model.measurement_scale[:, None]
        self.H = H.reshape(-1, self.scale.size) * self.scale
        sigma = np.array(settings.noise_scale) * process.release.sigma / model.measurement_scale
        self.R = np.tile(sigma**2, model.n_segments)
        units = [config.corridor.density_scale, config.corridor.speed_scale]
        self.T = self.whole(model.traffic_jacobian(self.mean)[0], units)[: 2 * self.n]
        self.P = self.F @ P @ self.F.T + self.Q
        self.fixed = list(config.corridor.fixed_sensors)
        self.weights = self.weigh(inflation, config.reward)

    def whole(self, blocks, units):
        matrix = np.zeros((2 * self.model.n_segments, 2 * self.model.n_segments))
        for s, block in enumerate(blocks):
            matrix[2 * s : 2 * s + 2, 2 * s : 2 * s + 2] = block
        return matrix * self.scale / np.tile(units, self.model.n_segments)[:, None]

    def weigh(self, inflation, term):
        weights = np.ones((self.n, 2)) * [term != "speed", term != "density"]
        if inflation.occupied:
            length = self.process.config.corridor.segment_length
            weights[:, 1] *= 1.0 - np.exp(-length * self.mean[0, : 2 * self.n : 2])
        if inflation.speed_cap is not None:
            variance = np.diag(self.T @ self.after([]) @ self.T.T)[1::2]
            weights[:, 1] *= np.minimum(1.0, inflation.speed_cap**2 / variance)
        return weights

    def after(self, queried, P=None):
        """Return the covariance after the fixed sensors and the queried segments."""
        P = self.P if P is None else P
        rows = np.concatenate([[2 * s, 2 * s + 1] for s in sorted({*self.fixed, *queried})])
        H, R = self.H[rows], np.diag(self.R[rows])
        return P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)

    def shares(self, P):
        variances = np.diag(self.T @ P @ self.T.T).reshape(-1, 2)
        return np.sum(self.weights * variances, axis=1)

    def trace(self, queried):
        return self.shares(self.after(queried)).sum()

    def greedy(self, bandwidth):
        queried = []
        for _ in range(bandwidth):
            left = [s for s in range(self.n) if s not in {*queried, *self.fixed}]
            queried.append(min(left, key=lambda s: self.trace([*queried, s])))
        return sorted(queried)


def states(env, n_steps=12):
    """Yield the observations of an episode under a random schedule, second by second."""
    schedule, state = make_schedule("random", env, seed=0), None
    observation = begin(env)
    for _ in range(n_steps):
        yield observation
        action, state = schedule.predict(observation, state)
        observation = env.step(action)[0]


def chosen(schedule, observation):
    return [np.flatnonzero(row).tolist() for row in schedule.predict(observation)[0]]


@pytest.mark.parametrize(
    ("inflation", "reward"),
    fast_and_slow(
        itertools.product(INFLATIONS, ["joint", "density", "speed"]),
        [("trusting", "joint"), ("occupied", "speed"), ("capped", "density"), ("noisy", "joint")],
    ),
)
def test_greedy_trace_is_that_of_explicit_updates(inflation, reward):
    env = make_batch(bandwidth=3, reward=reward)
    own = INFLATIONS[inflation]
    for observation in states(env):
        schedule = GreedyTrace(
            env.unwrapped.process, inflation=own
        )  # begins with the estimator's P
        for episode, queried in enumerate(chosen(schedule, observation)):
            plain = Plain(env, episode, own)
            assert queried == plain.greedy(3)


@pytest.mark.parametrize("keywords", [
    {"privacy": {"preset": "capped"}, "estimator": "ekf"},
    {"estimator": "ukf"}, {"estimator": "enkf"}, {"estimator": "mhe"},
    {"estimator": "random_walk", "privacy": {"preset": "capped"}},
    {"estimator": "ekf", "backend": "reference"},
], ids=str)  # fmt: skip
def test_greedy_works_on_every_covariance(keywords):
    env = make_batch(bandwidth=3, **keywords)
    for observation in states(env, 5):
        schedule = GreedyTrace(env.unwrapped.process, inflation=NO_INFLATION)
        for episode, queried in enumerate(chosen(schedule, observation)):
            plain = Plain(env, episode, NO_INFLATION)
            # The segments of a walk can tie: sets may differ, what they cost may not.
            assert plain.trace(queried) == pytest.approx(plain.trace(plain.greedy(3)), rel=1e-9)


def test_what_is_left_is_the_explicit_posterior():
    """A covariance of its own follows its own queries through several seconds."""
    env = make_batch(bandwidth=2)
    inflation = CovarianceInflation(process_noise=(0.05, 0.02), occupied=True, speed_cap=0.1)
    schedule, observation = GreedyTrace(env.unwrapped.process, inflation=inflation), begin(env)
    state, own = None, [None] * 3
    for _ in range(6):
        plains = [Plain(env, episode, inflation, own[episode]) for episode in range(3)]
        action, state = schedule.predict(observation, state)
        for episode, plain in enumerate(plains):
            queried = np.flatnonzero(action[episode]).tolist()
            assert queried == plain.greedy(2)
            own[episode] = plain.after(queried)
            found = schedule._after[episode]
            np.testing.assert_allclose(found, own[episode], atol=1e-9 * np.abs(own[episode]).max())
        observation = env.step(action)[0]


def test_an_estimator_without_a_covariance_is_refused():
    env = make_batch(estimator="open_loop")
    for name in COVARIANCE_SCHEDULES:
        with pytest.raises(ValueError, match=rf"'{name}' needs .* covariance"):
            make_schedule(name, env)


def test_bad_inflations_are_named():
    with pytest.raises(ValueError, match=r"inflation\.speed_cap must be"):
        CovarianceInflation(speed_cap=0.0)
    with pytest.raises(ValueError, match=r"inflation\.process_noise\[1\] must be"):
        CovarianceInflation(process_noise=(0.1, -0.1))
