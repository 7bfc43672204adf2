"""Properties of every schedule."""

import numpy as np
import pytest

from dptse_env.schedules import (
    COVARIANCE_SCHEDULES,
    DEVIATION_SCHEDULES,
    OBSERVATION_SCHEDULES,
    ORACLES,
    PLANS,
    ProcessSchedule,
    make_schedule,
)
from dptse_env.spaces.actions import ACTION_ENCODINGS

from .playing import begin, make_batch, make_single, play

BOUND = [*DEVIATION_SCHEDULES, *COVARIANCE_SCHEDULES, *ORACLES]
NAMES = [*sorted(set(OBSERVATION_SCHEDULES) - {"none", "all"}), *BOUND]


@pytest.mark.parametrize("name", NAMES)
def test_every_encoding_asks_the_same_full_set(name):
    expected, rewards = play(make_batch(), name, 8)
    assert (expected.sum(axis=2) == 2).all()
    for action in ACTION_ENCODINGS:
        queries, own = play(make_batch(action=action), name, 8)
        np.testing.assert_array_equal(queries, expected)
        np.testing.assert_array_equal(own, rewards)


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"random"}))
def test_a_batch_asks_what_its_episodes_ask_alone(name):
    queries, rewards = play(make_batch(), name, 8)
    for episode in range(3):
        env = make_single()
        alone, own = play(env, name, 8, begin(env, seed=5 + episode))
        np.testing.assert_array_equal(alone[:, 0], queries[:, episode])
        np.testing.assert_array_equal(own[:, 0], rewards[:, episode])


@pytest.mark.parametrize("name", NAMES)
def test_a_run_repeats(name):
    first, second = play(make_batch(), name, 8)[0], play(make_batch(), name, 8)[0]
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"random"}))
def test_a_schedule_begins_anew_with_the_episode(name):
    env = make_batch()
    schedule = make_schedule(name, env)
    first, _ = play(env, schedule, 8)
    observation, state = begin(env), None
    for _ in range(3):
        action, state = schedule.predict(observation, state)
        observation = env.step(action)[0]
    observation = begin(env)
    actions = []
    for step in range(8):
        action, state = schedule.predict(observation, state, np.full(3, step == 0))
        actions.append(action)
        observation = env.step(action)[0]
    np.testing.assert_array_equal(np.array(actions), first)


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"random"}))
def test_choosing_twice_changes_nothing(name):
    env, other = make_batch(), make_batch()
    expected, rewards = play(other, name, 8)
    schedule, observation, state = make_schedule(name, env), begin(env), None
    for step in range(8):
        once, _ = schedule.predict(observation, state)
        twice, state = schedule.predict(observation, state)
        np.testing.assert_array_equal(once, twice)
        np.testing.assert_array_equal(twice, expected[step])
        observation, reward, *_ = env.step(twice)
        np.testing.assert_array_equal(reward, rewards[step])


@pytest.mark.parametrize("name", BOUND)
def test_a_bound_schedule_refuses_another_batch(name):
    env = make_batch()
    schedule, observation = make_schedule(name, env), begin(env)
    assert isinstance(schedule, ProcessSchedule)
    with pytest.raises(ValueError, match=rf"'{name}' follows the 3 episodes .* a batch of 2"):
        schedule.predict(observation[:2])


@pytest.mark.parametrize(
    "name",
    [
        "oldest-first",
        "largest-variance",
        "stale-variance",
        "largest-deviation",
        "oracle-error",
        *DEVIATION_SCHEDULES,
        *COVARIANCE_SCHEDULES,
    ],
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
    assert not set(ORACLES) & {*OBSERVATION_SCHEDULES, *COVARIANCE_SCHEDULES, *PLANS}


def test_an_unknown_name_is_refused_with_a_list_of_all():
    with pytest.raises(
        ValueError, match=r"schedule must be one of none, .*oracle-error.*, got 'best'"
    ):
        make_schedule("best", make_batch())
