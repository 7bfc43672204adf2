"""Properties of every schedule, where queries are segments, sums of them, and at several prices.

Oracles are compared with their definition, and with a process that is stepped for each segment.
"""

import itertools

import numpy as np
import pytest

from dptse_env.schedules import (
    OBSERVATION_SCHEDULES,
    ORACLES,
    PROCESS_SCHEDULES,
    ProcessSchedule,
    make_schedule,
)
from dptse_env.spaces.actions import ACTION_ENCODINGS
from tests.helpers import COUNTED, PAID, SumRelease, fast_and_slow

from .playing import EVERY, begin, make_batch, make_single, play

BOUND = [*PROCESS_SCHEDULES, *ORACLES]
NAMES = [*sorted(set(OBSERVATION_SCHEDULES) - {"none", "all"}), *BOUND]
OF_SEGMENTS = ("greedy-trace", "oracle-gain")
ROADS = {
    "segments": {},
    "spans": {"query_spans": (1, 2, 3), "bandwidth": 4, "privacy": SumRelease},
    "sums": {
        "query_spans": (1, 2, 3), "bandwidth": 2, "bandwidth_unit": "sums", "privacy": SumRelease,
    },
    "only sums": {"query_spans": (2,), "bandwidth": 5, "privacy": SumRelease},
}  # fmt: skip
CASES = [
    (name, road)
    for name, road in itertools.product(NAMES, ROADS)
    if road == "segments" or name not in OF_SEGMENTS
]
FAST = [
    ("round-robin", "only sums"), ("oldest-first", "sums"), ("speed-front", "spans"),
    ("expected-reduction", "spans"), ("greedy-trace", "segments"), ("oracle-gain", "segments"),
]  # fmt: skip
"""One for each way to choose: by the clock, by observations, by a memory, and by the process."""


@pytest.mark.parametrize(("name", "road"), fast_and_slow(CASES, FAST))
def test_every_encoding_and_a_batch_ask_the_same_and_for_as_much_as_they_may(name, road):
    env = make_single(**ROADS[road])
    options = env.unwrapped.config.queries
    expected, rewards = play(env, name, 6)
    cost = expected @ options.cost
    left = options.bandwidth - cost[..., None]
    assert (left >= 0).all()
    assert ((options.cost > left) | expected).all()
    for action in ACTION_ENCODINGS:
        queries, own = play(make_single(action=action, **ROADS[road]), name, 6)
        np.testing.assert_array_equal(queries, expected)
        np.testing.assert_array_equal(own, rewards)
    if name == "random":
        return
    queries, rewards = play(make_batch(**ROADS[road]), name, 8)
    for episode in range(3):
        env = make_single(**ROADS[road])
        alone, own = play(env, name, 8, begin(env, episode=episode))
        np.testing.assert_array_equal(alone[:, 0], queries[:, episode])
        np.testing.assert_array_equal(own[:, 0], rewards[:, episode])


@pytest.mark.parametrize(
    ("name", "road"), fast_and_slow([case for case in CASES if case[0] != "random"], FAST)
)
def test_a_schedule_begins_anew_with_the_episode_and_may_be_asked_twice(name, road):
    env = make_batch(**ROADS[road])
    schedule = make_schedule(name, env)
    _, rewards = play(env, schedule, 8)
    observation, state = begin(env), None
    for _ in range(3):
        action, state = schedule.predict(observation, state)
        observation = env.step(action)[0]
    observation = begin(env)
    for step in range(8):
        starts = np.full(3, step == 0)
        kept = [part.copy() for part in state]
        once, _ = schedule.predict(observation, state, starts)
        for part, copy in zip(state, kept, strict=True):
            np.testing.assert_array_equal(part, copy)
        action, state = schedule.predict(observation, state, starts)
        np.testing.assert_array_equal(once, action)
        observation, reward, *_ = env.step(action)
        np.testing.assert_array_equal(reward, rewards[step])


@pytest.mark.parametrize("name", ["oldest-first", "expected-reduction", "oracle-error"])
def test_sums_do_not_overlap(name):
    options = make_single(**ROADS["spans"]).unwrapped.config.queries
    queries, _ = play(make_batch(**ROADS["spans"]), name, 8)
    assert (queries.astype(int) @ options.covers <= 1).all()


LAST = ["oldest-first", "speed-front", "greedy-trace", "oracle-error"]
RATED = ["largest-variance", "stale-variance", "largest-deviation", *PROCESS_SCHEDULES]


@pytest.mark.parametrize("name", fast_and_slow(sorted({*LAST, *RATED}), LAST))
def test_a_segment_with_a_fixed_sensor_is_queried_last(name):
    queries, _ = play(make_batch(bandwidth=5), name, 6)
    assert not queries[..., 5].any()  # the fixed one of six
    assert play(make_batch(bandwidth=6), name, 2)[0].all()


# --- schedules of the process ---------------------------------------------------------------------

LEFT_ALONE = [{"penetration": 0.3, "sensor_settings": {"dropout": 0.5}},
              {"privacy": COUNTED, "estimator": "enkf"}]  # fmt: skip


@pytest.mark.parametrize("name", BOUND)
@pytest.mark.parametrize("keywords", LEFT_ALONE, ids=["connected", "counted"])
def test_a_process_is_left_as_it_is(name, keywords):
    """Whoever follows a schedule's queries without calling it meets the same numbers."""
    env, other = make_batch(**keywords), make_batch(**keywords)
    queries, rewards = play(env, name, 40)  # more than a block of noise
    assert (queries.sum(axis=2) == 2).all()
    begin(other)
    for query, reward in zip(queries, rewards, strict=True):
        observation, own, *_ = other.step(query.astype(np.int8))
        np.testing.assert_array_equal(own, reward)
    np.testing.assert_array_equal(observation, env.unwrapped.process.observe(EVERY))


@pytest.mark.parametrize("reward", ["joint", "density"])
def test_the_oracle_of_errors_asks_where_the_estimate_is_worst(reward):
    env = make_batch(reward=reward, bandwidth=3)
    # The road is empty at first: most segments have no speed to be wrong about.
    schedule, observation = make_schedule("oracle-error", env), begin(env, start=0)
    process = env.unwrapped.process
    for _ in range(10):
        action, _ = schedule.predict(observation)
        truth, estimate = process.truth(EVERY)[:, :5], process.estimate
        error = ((estimate.density[:, :5] - truth[..., 0]) / 222.0) ** 2
        if reward == "joint":
            speed = ((estimate.speed[:, :5] - truth[..., 1]) / 102.0) ** 2
            error += speed * (truth[..., 0] > 0)
        for episode in range(3):
            worst = np.sort(np.argsort(-error[episode])[:3])
            np.testing.assert_array_equal(np.flatnonzero(action[episode]), worst)
        observation = env.step(action)[0]


@pytest.mark.parametrize("keywords", [
    {"privacy": "printed", "estimator": "enkf"}, {"privacy": PAID},
    {"estimator": "random_walk", "reward": "speed"}, {"estimator": "ekf", "backend": "reference"},
    {"loops": {"positions": [0.0, 0.3], "interval": 10}},
], ids=str)  # fmt: skip
def test_the_oracle_of_gains_asks_what_forks_without_noise_find_best(keywords):
    env = make_batch(**keywords)
    schedule, observation = make_schedule("oracle-gain", env), begin(env)
    for _ in range(7):  # to the end of an interval of loops, which is gone through again
        observation = env.step(np.eye(6, dtype=np.int8)[EVERY])[0]
    process = env.unwrapped.process
    for _ in range(4):
        action, _ = schedule.predict(observation)
        rewards = np.empty((3, 6))
        for segment in range(6):
            ahead = process.fork()
            ahead.release.give_noise(np.zeros((3, ahead.release.task.n_channels, 2)))
            queried = np.tile(np.arange(6) == segment, (3, 1)).astype(np.int8)
            rewards[:, segment] = ahead.step(EVERY, queried).reward
        best = np.argsort(-rewards, axis=1, kind="stable")[:, :2]
        np.testing.assert_array_equal(np.sort(best), np.nonzero(action)[1].reshape(3, 2))
        observation = env.step(action)[0]


def test_an_oracle_answers_when_an_episode_is_over():
    env = make_batch(horizon=5)
    schedule = make_schedule("oracle-gain", env)
    observation = begin(env, start=env.unwrapped.config.last_start)  # to the record's end
    for _ in range(5):
        observation, *_ = env.step(schedule.predict(observation)[0])
    action, _ = schedule.predict(observation)
    assert (action.sum(axis=1) == 2).all()


@pytest.mark.parametrize("name", ["speed-front", "expected-reduction", "greedy-trace"])
def test_a_reading_of_a_loop_counts_as_no_query(name):
    """Rules choose as on a road without loops until one reports, and leave no segment to loops."""
    beside_all = {"positions": [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], "interval": 10}
    given = {"corridor": {"fixed_sensors": []}, "horizon": 40}
    with_loops, _ = play(make_single(loops=beside_all, **given), name, 40)
    without, _ = play(make_single(**given), name, 40)
    np.testing.assert_array_equal(with_loops[:10], without[:10])
    assert (with_loops.sum(axis=0) > 0).all()


def test_only_oracles_use_the_truth():
    env = make_batch()
    blind = [*sorted(set(OBSERVATION_SCHEDULES) - {"all"}), *PROCESS_SCHEDULES]
    assert not any(make_schedule(name, env).uses_truth for name in blind)
    assert all(make_schedule(name, env).uses_truth for name in ORACLES)


def test_a_schedule_that_does_not_suit_is_refused():
    env = make_batch()
    observation = begin(env)
    for name in BOUND:
        schedule = make_schedule(name, env)
        assert isinstance(schedule, ProcessSchedule)
        with pytest.raises(ValueError, match=rf"'{name}' follows the 3 episodes"):
            schedule.predict(observation[:2])
    for name, road in itertools.product(OF_SEGMENTS, ["spans", "only sums"]):
        with pytest.raises(ValueError, match=rf"schedule '{name}' queries single segments"):
            make_schedule(name, make_single(**ROADS[road]))
    with pytest.raises(ValueError, match=r"'greedy-trace' needs .* covariance"):
        make_schedule("greedy-trace", make_batch(estimator="open_loop"))
    with pytest.raises(ValueError, match=r"schedule must be one of none, .*oracle-.*, got 'best'"):
        make_schedule("best", env)
