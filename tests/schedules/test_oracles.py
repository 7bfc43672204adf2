"""Oracles against their definition, and against a process that is stepped for each set."""

import itertools

import numpy as np
import pytest

from dptse_env.schedules import make_schedule
from dptse_env.schedules.oracles import _Realised

from .playing import begin, make_batch, make_single, play

BOUNDED = {"preset": "capped", "epsilon": 5.0, "cap": 3}


@pytest.mark.parametrize("reward", ["joint", "density"])
def test_oracle_error_asks_where_the_estimate_is_worst(reward):
    env = make_batch(reward=reward, bandwidth=3)
    # The road is empty at first: most segments have no speed to be wrong about.
    schedule, observation = make_schedule("oracle-error", env), begin(env, start=0)
    process = env.unwrapped.process
    for _ in range(10):
        action, _ = schedule.predict(observation)
        truth = process.truth(np.arange(3))[:, :5]
        estimate = process.estimate
        error = np.zeros((3, 5))
        if reward != "speed":
            error += ((estimate.density[:, :5] - truth[..., 0]) / 222.0) ** 2
        if reward != "density":
            speed = ((estimate.speed[:, :5] - truth[..., 1]) / 102.0) ** 2
            error += speed * (truth[..., 0] > 0)
        for episode in range(3):
            worst = np.sort(np.argsort(-error[episode])[:3])
            np.testing.assert_array_equal(np.flatnonzero(action[episode]), worst)
        observation = env.step(action)[0]


def realised(policy, sets_before, keywords):
    """Return the reward of querying a set after some others, from an episode begun anew."""
    env = make_single(**keywords)
    begin(env)
    for queried in [*sets_before, policy]:
        mask = np.zeros(6, dtype=np.int8)
        mask[list(queried)] = 1
        _, reward, *_ = env.step(mask)
    return reward


@pytest.mark.parametrize("keywords", [
    {"estimator": "enkf"},
    {"estimator": "random_walk", "privacy": {**BOUNDED, "boundary_inputs": "private"}},
    {"estimator": "ekf", "backend": "reference"},
], ids=str)  # fmt: skip
def test_the_brute_force_is_that_of_episodes_begun_anew(keywords):
    keywords = {"bandwidth": 2, **keywords}
    queries, rewards = play(make_single(**keywords), "oracle-brute-force", 5)
    before = []
    for query, reward in zip(queries[:, 0], rewards[:, 0], strict=True):
        tried = {
            queried: realised(queried, before, keywords)
            for queried in itertools.combinations(range(6), 2)
        }
        queried = tuple(np.flatnonzero(query).tolist())
        assert tried[queried] == max(tried.values()) == reward
        before.append(queried)


def test_the_greedy_oracle_adds_the_best_segment_each_time():
    keywords = {"bandwidth": 3, "privacy": BOUNDED}
    queries, rewards = play(make_single(**keywords), "oracle-greedy", 4)
    before = []
    for query, reward in zip(queries[:, 0], rewards[:, 0], strict=True):
        queried = []
        for _ in range(3):
            left = [s for s in range(6) if s not in queried]
            queried.append(max(left, key=lambda s: realised([*queried, s], before, keywords)))
        assert np.flatnonzero(query).tolist() == sorted(queried)
        assert reward == realised(queried, before, keywords)
        before.append(queried)


@pytest.mark.parametrize("privacy", ["paper", {"preset": "paced"}], ids=str)
def test_the_oracle_of_gains_tries_every_segment_without_noise(privacy):
    keywords = {"bandwidth": 2, "privacy": privacy}
    queries, _ = play(make_single(**keywords), "oracle-gain", 4)
    before = []
    for query in queries[:, 0]:
        # Every segment is observed in the trials, so their rewards are told apart by the updates.
        env = make_single(**keywords)
        begin(env)
        for queried in before:
            mask = np.zeros(6, dtype=np.int8)
            mask[queried] = 1
            env.step(mask)
        process = env.unwrapped.process
        coming = make_schedule("oracle-gain", env)._look(np.array([0]))
        length = process.config.corridor.segment_length
        counts = coming.measured.values[0, :6, 0]
        if privacy == "paper":
            np.testing.assert_allclose(counts, coming.truth[0, :6, 0], atol=0.02)
        else:
            # What counts is a whole number of vehicles, up to the grid of the release.
            np.testing.assert_allclose(counts * length, np.rint(counts * length), atol=0.01)
        gains = [
            make_schedule("oracle-gain", env)._reward(coming, (np.arange(6) == s)[None])[0]
            for s in range(6)
        ]
        assert set(np.flatnonzero(query)) == set(np.argsort(gains)[-2:])
        before.append(np.flatnonzero(query))


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        ("oracle-error", {"privacy": BOUNDED}),
        ("oracle-gain", {"privacy": BOUNDED}),
        ("oracle-greedy", {"estimator": "enkf"}),
        ("oracle-brute-force", {"privacy": BOUNDED}),
    ],
)
def test_an_oracle_leaves_the_process_as_it_is(name, keywords):
    """Whoever follows an oracle's queries without calling it meets the same numbers."""
    env = make_batch(**keywords)
    queries, rewards = play(env, name, 40)  # more than a block of noise
    other = make_batch(**keywords)
    begin(other)
    for query, reward in zip(queries, rewards, strict=True):
        observation, own, *_ = other.step(query.astype(np.int8))
        np.testing.assert_array_equal(own, reward)
    last = env.unwrapped.process.observe(np.arange(3))
    np.testing.assert_array_equal(observation, last)


def test_an_episode_that_is_over_is_left_alone():
    env = make_batch(horizon=5)
    schedule = make_schedule("oracle-greedy", env)
    observation = begin(env, start=env.unwrapped.config.last_start)  # to the record's end
    for _ in range(5):
        observation, *_ = env.step(schedule.predict(observation)[0])
    assert env.unwrapped.process.over.all()
    action, _ = schedule.predict(observation)
    assert (action.sum(axis=1) == 2).all()
    assert issubclass(type(schedule), _Realised)


def test_too_many_sets_are_refused():
    import gymnasium as gym

    env = gym.make("dptse_env:dptse/PrivateHighway-v0")
    with pytest.raises(ValueError, match=r"at most 1000 sets .* 5 of 15 .* 3003; .*oracle-greedy"):
        make_schedule("oracle-brute-force", env)
