"""Properties of every schedule."""

import numpy as np
import pytest

from dptse_env.schedules import (
    COVARIANCE_SCHEDULES,
    DEVIATION_SCHEDULES,
    OBSERVATION_SCHEDULES,
    ORACLES,
    ProcessSchedule,
    make_schedule,
)
from dptse_env.spaces.actions import ACTION_ENCODINGS
from tests.cases import fast_and_slow

from .playing import begin, make_batch, make_single, play

BOUND = [*DEVIATION_SCHEDULES, *COVARIANCE_SCHEDULES, *ORACLES]
NAMES = [*sorted(set(OBSERVATION_SCHEDULES) - {"none", "all"}), *BOUND]
KINDS = (
    "round-robin", "oldest-first", "speed-front", "expected-reduction", "greedy-trace",
    "oracle-gain",
)  # fmt: skip
"""One for each way to choose: by the clock, by observations, by a memory, and by the process."""


@pytest.mark.parametrize("name", fast_and_slow(NAMES, KINDS))
def test_every_encoding_asks_the_same_full_set(name):
    expected, rewards = play(make_batch(), name, 8)
    assert (expected.sum(axis=2) == 2).all()
    for action in ACTION_ENCODINGS:
        queries, own = play(make_batch(action=action), name, 8)
        np.testing.assert_array_equal(queries, expected)
        np.testing.assert_array_equal(own, rewards)


@pytest.mark.parametrize("name", fast_and_slow(sorted(set(NAMES) - {"random"}), KINDS))
def test_a_batch_asks_what_its_episodes_ask_alone(name):
    queries, rewards = play(make_batch(), name, 8)
    for episode in range(3):
        env = make_single()
        alone, own = play(env, name, 8, begin(env, seed=5 + episode))
        np.testing.assert_array_equal(alone[:, 0], queries[:, episode])
        np.testing.assert_array_equal(own[:, 0], rewards[:, episode])


@pytest.mark.parametrize("name", fast_and_slow(sorted(set(NAMES) - {"random"}), KINDS))
def test_a_schedule_begins_anew_with_the_episode_and_may_be_asked_twice(name):
    env = make_batch()
    schedule = make_schedule(name, env)
    first, rewards = play(env, schedule, 8)
    observation, state = begin(env), None
    for _ in range(3):
        action, state = schedule.predict(observation, state)
        observation = env.step(action)[0]
    observation = begin(env)
    for step in range(8):
        starts = np.full(3, step == 0)
        once, _ = schedule.predict(observation, state, starts)
        twice, state = schedule.predict(observation, state, starts)
        np.testing.assert_array_equal(once, twice)
        np.testing.assert_array_equal(twice, first[step])
        observation, reward, *_ = env.step(twice)
        np.testing.assert_array_equal(reward, rewards[step])


def test_a_bound_schedule_refuses_another_batch():
    env = make_batch()
    observation = begin(env)
    for name in BOUND:
        schedule = make_schedule(name, env)
        assert isinstance(schedule, ProcessSchedule)
        with pytest.raises(ValueError, match=rf"'{name}' follows the 3 episodes"):
            schedule.predict(observation[:2])


SKIPS_SENSORS = (
    "oldest-first", "largest-variance", "stale-variance", "largest-deviation", "oracle-error",
    *DEVIATION_SCHEDULES, *COVARIANCE_SCHEDULES,
)  # fmt: skip


@pytest.mark.parametrize(
    "name",
    fast_and_slow(
        SKIPS_SENSORS, ("oldest-first", "stale-variance", "greedy-trace", "oracle-error")
    ),
)
def test_a_segment_with_a_fixed_sensor_is_queried_last(name):
    queries, _ = play(make_batch(bandwidth=5), name, 6)
    assert not queries[..., 5].any()  # the fixed one of six
    assert play(make_batch(bandwidth=6), name, 2)[0].all()


def test_only_oracles_use_the_truth():
    env = make_batch()
    names = [*sorted(set(OBSERVATION_SCHEDULES) - {"all"}), *BOUND[: -len(ORACLES)]]
    assert not any(make_schedule(name, env).uses_truth for name in names)
    assert all(make_schedule(name, env).uses_truth for name in ORACLES)
    assert not set(ORACLES) & {*OBSERVATION_SCHEDULES, *COVARIANCE_SCHEDULES}
