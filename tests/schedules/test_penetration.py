"""Schedules where not every vehicle is connected, and fixed sensors have rows of their own."""

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.parts import make_parts
from dptse_env.process import QueryProcess
from dptse_env.schedules import SCHEDULES

NAMES = ("expected-reduction", "greedy-trace", "oracle-error", "oracle-gain")


def make(n_episodes=2, **keywords):
    given = {
        "penetration": 0.3,
        "traffic_seeds": "0:2",
        "horizon": 40,
        "random_start": True,
        "detectors": {"dropout": 0.5},
        **keywords,
    }
    process = QueryProcess(make_parts(resolve("short-highway", given), n_episodes))
    episodes = np.arange(n_episodes)
    generators = [np.random.default_rng(seed) for seed in episodes]
    return process, process.reset(episodes, generators).observation


@pytest.mark.parametrize("name", NAMES)
def test_schedules_choose_within_the_bandwidth_and_leave_the_process_alone(name):
    process, observation = make()
    untouched, _ = make()
    schedule, state = SCHEDULES[name](process), None
    for _ in range(6):
        actions, state = schedule.predict(observation, state)
        assert (actions.sum(axis=1) == process.config.bandwidth).all()
        observation = process.step(np.arange(2), actions).observation
        again = untouched.step(np.arange(2), actions).observation
        np.testing.assert_array_equal(observation, again)


def test_schedules_count_on_noise_that_is_scaled_to_all_vehicles():
    process, _ = make()
    np.testing.assert_allclose(process.expected_sigma[0], process.release.sigma[0] / 0.3)
    whole, _ = make(penetration=1.0, detectors={})
    np.testing.assert_array_equal(whole.expected_sigma, whole.release.sigma)
