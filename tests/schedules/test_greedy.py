"""The greedy design against plain numpy: explicit Kalman updates of the whole state."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from dptse_env.schedules import make_schedule

from .playing import begin, make_batch

NOISE, CAP = (0.1, 0.03), 0.1


class Plain:
    """The coming second of one episode, from the covariance that the last second left."""

    def __init__(self, env, episode, covariance):
        process = env.unwrapped.process
        config, model, estimator = process.config, process.model, process.estimator
        corridor, settings, one = config.corridor, config.settings(), np.array([episode])
        n, self.n, self.fixed = (
            2 * model.n_segments,
            corridor.geometry.n_mainline,
            corridor.fixed_sensors,
        )
        scale, mean = model.state_scale[:n], estimator.states[[episode], :n]
        P = estimator.covariances[episode, :n, :n] if covariance is None else covariance
        F, Q = np.eye(n), np.diag(np.tile(np.square(NOISE), model.n_segments))
        if config.estimator == "random_walk":
            back = np.linalg.inv(self.traffic(model, mean, scale, [scale[0], model.speed_scale]))
            Q = back @ Q @ back.T
        else:
            inputs = process.boundary.inputs(one, process.traffic_index[one], process.time[one])
            F = model.jacobian(mean, inputs)[0, :n, :n] * scale / scale[:, None]
            mean = model.project(model.step(mean, inputs), settings.bounds)
        self.P = F @ P @ F.T + Q
        rows = model.measurement_matrix(mean)[
            0, np.unique(model.channels.first, return_index=True)[1]
        ]
        self.H = (rows[:, :, :n] * scale / model.measurement_scale[:, None]).reshape(n, n)
        sigma = np.array(settings.noise_scale) * process.expected_sigma / model.measurement_scale
        self.R = np.tile(sigma**2, model.n_segments)
        T = self.traffic(
            model, mean, scale, [corridor.scales.density_scale, corridor.scales.speed_scale]
        )
        self.T, self.weights = T[: 2 * self.n], np.ones((self.n, 2))
        occupied = 1.0 - np.exp(-corridor.geometry.segment_length * mean[0, : 2 * self.n : 2])
        self.weights[:, 1] = occupied * np.minimum(1.0, CAP**2 / self.variances([])[:, 1])
        self.weights *= [config.reward != "speed", config.reward != "density"]

    @staticmethod
    def traffic(model, mean, scale, units):
        """Return T, derivatives of density and speed in some units by a normalised state."""
        T = block_diag(*model.traffic_jacobian(mean)[0])
        return T * scale / np.tile(units, model.n_segments)[:, None]

    def after(self, queried):
        """Return the covariance after the fixed sensors and the queried segments."""
        rows = np.concatenate([[2 * s, 2 * s + 1] for s in sorted({*self.fixed, *queried})])
        H, R = self.H[rows], np.diag(self.R[rows])
        return self.P - self.P @ H.T @ np.linalg.solve(H @ self.P @ H.T + R, H @ self.P)

    def variances(self, queried):
        return np.diag(self.T @ self.after(queried) @ self.T.T).reshape(-1, 2)

    def trace(self, queried):
        return np.sum(self.weights * self.variances(queried))

    def greedy(self, bandwidth):
        queried = []
        for _ in range(bandwidth):
            left = [s for s in range(self.n) if s not in {*queried, *self.fixed}]
            queried.append(min(left, key=lambda s: self.trace([*queried, s])))
        return sorted(queried)


@pytest.mark.parametrize("keywords", [
    {"estimator": "ekf", "privacy": "capped", "reward": "speed"},
    {"estimator": "ekf", "privacy": "paced", "reward": "density", "penetration": 0.3},
    {"estimator": "ekf", "backend": "reference", "estimator_settings": {"demand": {}}},
    {"estimator": "mhe"}, {"estimator": "enkf"}, {"estimator": "random_walk"},
], ids=str)  # fmt: skip
def test_it_is_the_design_of_explicit_updates(keywords):
    """Its covariance begins with the estimator's, and follows its own queries from there."""
    env = make_batch(bandwidth=3, **keywords)
    schedule, state, left = make_schedule("greedy-trace", env), None, [None] * 3
    for start in (0, 150):  # the second episode begins anew
        observation, left = begin(env, start), [None] * 3
        for _ in range(8):
            plains = [Plain(env, episode, left[episode]) for episode in range(3)]
            action, state = schedule.predict(observation, state)
            for episode, plain in enumerate(plains):
                queried = np.flatnonzero(action[episode]).tolist()
                # Segments can tie: sets may differ, what they cost may not.
                expected = plain.trace(plain.greedy(3))
                assert plain.trace(queried) == pytest.approx(expected, rel=1e-9)
                left[episode] = plain.after(queried)
            observation = env.step(action)[0]


def test_a_second_without_a_call_makes_the_estimators_covariance_the_start():
    env = make_batch(bandwidth=3)
    schedule, other = (make_schedule("greedy-trace", env) for _ in range(2))
    observation, state = begin(env), None
    for _ in range(20):
        action, state = schedule.predict(observation, state)
        observation = env.step(action)[0]
    action, _ = other.predict(observation)  # for the first time
    for episode in range(3):
        plain = Plain(env, episode, None)
        assert np.flatnonzero(action[episode]).tolist() == plain.greedy(3)
