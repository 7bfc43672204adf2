"""Oracles against their definition, and against a process that is stepped for each segment."""

import numpy as np
import pytest

from dptse_env.schedules import ORACLES, make_schedule

from .playing import begin, make_batch, play

EVERY = np.arange(3)


@pytest.mark.parametrize("reward", ["joint", "density"])
def test_the_oracle_of_errors_asks_where_the_estimate_is_worst(reward):
    env = make_batch(reward=reward, bandwidth=3)
    # The road is empty at first: most segments have no speed to be wrong about.
    schedule, observation = make_schedule("oracle-error", env), begin(env, start=0)
    process = env.unwrapped.process
    for _ in range(10):
        action, _ = schedule.predict(observation)
        truth = process.truth(EVERY)[:, :5]
        estimate = process.estimate
        error = ((estimate.density[:, :5] - truth[..., 0]) / 222.0) ** 2
        if reward == "joint":
            speed = ((estimate.speed[:, :5] - truth[..., 1]) / 102.0) ** 2
            error += speed * (truth[..., 0] > 0)
        for episode in range(3):
            worst = np.sort(np.argsort(-error[episode])[:3])
            np.testing.assert_array_equal(np.flatnonzero(action[episode]), worst)
        observation = env.step(action)[0]


@pytest.mark.parametrize("keywords", [
    {"privacy": "paper", "estimator": "enkf"},
    {"privacy": {"preset": "paced", "boundary_inputs": "private"}},
    {"estimator": "random_walk", "reward": "speed"},
    {"estimator": "ekf", "backend": "reference"},
], ids=str)  # fmt: skip
def test_the_oracle_of_gains_asks_what_forks_without_noise_find_best(keywords):
    env = make_batch(**keywords)
    schedule, observation = make_schedule("oracle-gain", env), begin(env)
    process = env.unwrapped.process
    for _ in range(4):
        action, _ = schedule.predict(observation)
        rewards = np.empty((3, 6))
        for segment in range(6):
            ahead = process.fork()
            ahead.release.give_noise(np.zeros((3, ahead.release.task.n_columns, 2)))
            queried = np.tile(np.arange(6) == segment, (3, 1)).astype(np.int8)
            rewards[:, segment] = ahead.step(EVERY, queried).reward
        best = np.argsort(-rewards, axis=1, kind="stable")[:, :2]
        np.testing.assert_array_equal(np.sort(best), np.nonzero(action)[1].reshape(3, 2))
        observation = env.step(action)[0]


@pytest.mark.parametrize("name", ORACLES)
def test_an_oracle_leaves_the_process_as_it_is(name):
    """Whoever follows an oracle's queries without calling it meets the same numbers."""
    keywords = {"privacy": {"preset": "capped", "cap": 3}, "estimator": "enkf"}
    env = make_batch(**keywords)
    queries, rewards = play(env, name, 40)  # more than a block of noise
    other = make_batch(**keywords)
    begin(other)
    for query, reward in zip(queries, rewards, strict=True):
        observation, own, *_ = other.step(query.astype(np.int8))
        np.testing.assert_array_equal(own, reward)
    np.testing.assert_array_equal(observation, env.unwrapped.process.observe(EVERY))


def test_an_episode_that_is_over_is_left_alone():
    env = make_batch(horizon=5)
    schedule = make_schedule("oracle-gain", env)
    observation = begin(env, start=env.unwrapped.config.last_start)  # to the record's end
    for _ in range(5):
        observation, *_ = env.step(schedule.predict(observation)[0])
    assert env.unwrapped.process.over.all()
    action, _ = schedule.predict(observation)
    assert (action.sum(axis=1) == 2).all()
