"""`QueryProcess`: forks, noise, what is kept between queries, and estimators that fail."""

import itertools

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.estimators import ESTIMATORS, REFERENCES
from dptse_env.process import QueryProcess
from tests.helpers import COUNTED, PAID, fast_and_slow

from .estimators.test_mhe import make_unsolvable

SEEDS = (11, 12, 13)
ALL = np.arange(3)


def make(n_episodes, preset="short-plain", **keywords):
    keywords = {"traffic_seeds": "0:3", "horizon": 60, "random_start": True, **keywords}
    return QueryProcess(resolve(preset, keywords), n_episodes)


def generators(seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def begun(n_episodes, **keywords):
    process = make(n_episodes, **keywords)
    process.reset(ALL[:n_episodes], generators(SEEDS[:n_episodes]))
    return process


def sampled(process, n_steps):
    """Return actions (n_steps, 3, *space) for a batch of three."""
    space = process.interface.actions.space
    space.seed(5)
    return [np.array([space.sample() for _ in SEEDS]) for _ in range(n_steps)]


FORKS = [
    ("ekf", PAID, "compiled"), ("ukf", COUNTED, "compiled"), ("enkf", "printed", "compiled"),
    ("mhe", PAID, "compiled"), ("ekf", COUNTED, "reference"), ("recurrent", "printed", "compiled"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("estimator", "privacy", "backend"),
    fast_and_slow(
        [
            (name, privacy, backend)
            for backend, names in (("compiled", ESTIMATORS), ("reference", REFERENCES))
            for name, privacy in itertools.product(names, ["printed", COUNTED, PAID])
        ],
        FORKS,
    ),
)
def test_a_fork_goes_on_as_its_origin_would_have(estimator, privacy, backend):
    keywords = {"estimator": estimator, "privacy": privacy, "backend": backend}
    origin = begun(3, action="sequential", truth_in_info=True, **keywords)
    actions = sampled(origin, 30)  # past the noise that is drawn at a time
    for action in actions[:5]:
        origin.step(ALL, action)
    first, second = origin.fork(), origin.fork()
    others = [origin.interface.actions.space.n - 1 - action for action in actions]
    for action in others[5:]:
        first.step(ALL, action)
    ahead = second.fork()
    for action in actions[5:]:
        here, there, further = (p.step(ALL, action) for p in (origin, second, ahead))
        for field in ("observation", "reward", "truncated"):
            np.testing.assert_array_equal(getattr(here, field), getattr(there, field))
            np.testing.assert_array_equal(getattr(here, field), getattr(further, field))
    np.testing.assert_equal(origin.infos(ALL), second.infos(ALL))
    assert not np.array_equal(first.released, origin.released)


def test_forks_share_traffic_and_begin_no_episodes():
    process = begun(3, privacy=COUNTED)
    fork = process.fork()
    assert fork.traffic is process.traffic
    for forked in (fork, fork.fork()):
        with pytest.raises(RuntimeError, match="reset the process that it was made from"):
            forked.reset(ALL, generators(SEEDS))
    process.reset(ALL, generators(SEEDS))


def test_an_episode_may_pause_while_others_go_on():
    mixed, whole = begun(3), begun(3)
    actions = sampled(whole, 30)
    expected = [whole.step(ALL, step) for step in actions]
    for step in actions[:10]:
        mixed.step(ALL[[0, 2]], step[[0, 2]])
    for step in actions[:10]:
        mixed.step(ALL[1:2], step[1:2])
    for k in range(10, 30):
        outcome = mixed.step(ALL, actions[k])
        np.testing.assert_array_equal(outcome.observation, expected[k].observation)
        np.testing.assert_array_equal(outcome.reward, expected[k].reward)


def test_a_second_is_predicted_then_released_and_then_read():
    """Centres and prices come from a prediction before the release of its own second."""
    process, order = begun(1, privacy=PAID), []

    def noted(name, called):
        return lambda *given: (order.append(name), called(*given))[1]

    for part, name in (
        (process.estimator, "predict"), (process.release, "release"),
        (process.estimator, "update"),
    ):  # fmt: skip
        setattr(part, name, noted(name, getattr(part, name)))
    for action in sampled(process, 3):
        process.step(ALL[:1], action[:1])
    assert order == ["predict", "release", "update"] * 3


def test_released_values_are_kept_until_the_next_query():
    process = begun(1)
    first = np.array([[1, 1, 0, 0, 0, 0]], dtype=np.int8)
    process.step(ALL[:1], first)
    kept = process.released[0].copy()
    assert (kept[:2] != 0).all()
    assert (kept[2:5] == 0).all()
    process.step(ALL[:1], np.roll(first, 2))
    np.testing.assert_array_equal(process.released[0, :2], kept[:2])
    assert process.age[0].tolist() == [1, 1, 0, 0, 62, 0]
    process.reset(ALL[:1], generators([4]))
    assert not process.released.any()


def test_a_step_from_t_predicts_with_t_and_measures_at_t_plus_one():
    process = make(1, random_start=False, horizon=240)
    process.reset(ALL[:1], generators([4]), {"traffic_seed": 1})
    seen = {}

    def predict(episodes, inputs):
        seen["inputs"] = inputs.copy()

    def added(episodes, values, *noise):
        seen["values"] = values.copy()
        return values

    process.estimator.predict = predict
    process.release.noise.added = added
    record = process.traffic.record(1)
    for t in range(100):
        process.step(ALL[:1], np.zeros((1, 6), dtype=np.int8))
        expected = process.boundary.inputs(ALL[:1], np.array([1]), np.array([t]))
        np.testing.assert_array_equal(seen["inputs"], expected)
        np.testing.assert_allclose(seen["values"][0, :, 0], record.counts[t + 1, :8] / 0.1)


# --- steps of several seconds ---------------------------------------------------------------------


def seconds_of(process, action):
    """Step, and return the error, queries and time of every second that it took."""
    seen = []

    def watch(process, episodes):
        error = process.error
        seen.append([error.density, error.speed, process.queried, process.time])
        seen[-1] = [each[episodes].copy() for each in seen[-1]]

    process.watchers.append(watch)
    outcome = process.step(ALL, action)
    process.watchers.remove(watch)
    return outcome, seen


@pytest.mark.parametrize("privacy", ["printed", COUNTED])
def test_a_step_of_several_seconds_is_as_many_steps_without_a_query(privacy):
    keywords = {"privacy": privacy, "horizon": 18, "bandwidth": 2}
    long, short = begun(3, query_every=5, **keywords), begun(3, **keywords)
    actions, n_seconds = sampled(long, 4), [5, 5, 5, 3]
    for action, n in zip(actions, n_seconds, strict=True):
        found, seen = seconds_of(long, action)
        nobody, rewards, told = np.zeros_like(action), [], None
        for k in range(n):
            outcome, ((density, speed, queried, time),) = seconds_of(short, nobody if k else action)
            np.testing.assert_equal(seen[k], [density, speed, queried, time])
            rewards.append(outcome.reward)
            if told is None:
                told, asked = short.estimator.innovations.copy(), short.queried.copy()
        np.testing.assert_array_equal(found.reward, sum(rewards) / n)
        np.testing.assert_array_equal(found.truncated, outcome.truncated)
        # The decision, and what its answers told, are still shown.
        np.testing.assert_array_equal(long.queried, asked)
        last = short.estimator.innovations[:, :6]
        answers = np.where(asked[..., None], told[:, :6], last)
        answers[:, 5] = last[:, 5]  # a fixed sensor tells every second
        np.testing.assert_array_equal(long.estimator.innovations[:, :6], answers)
        block = long.interface.observations.block(found.observation, "queried")
        np.testing.assert_array_equal(block > 0.0, asked)
    assert found.truncated.all()


def test_picks_of_a_decision_take_no_time_and_the_decision_takes_all():
    process = begun(3, action="sequential", bandwidth=2, query_every=4)
    assert process.step(ALL, np.array([0, 1, 2])).reward.tolist() == [0.0] * 3
    assert process.elapsed.tolist() == [0] * 3
    assert (process.step(ALL, np.array([3, 4, 5])).reward < 0.0).all()
    assert process.elapsed.tolist() == [4] * 3
    fork = process.fork()
    for each in (process, fork):
        each.step(ALL, np.array([1, 1, 1]))
        each.step(ALL, np.array([3, 3, 3]))
    np.testing.assert_equal(process.infos(ALL), fork.infos(ALL))
    assert fork.watchers == []


def test_a_second_without_a_solution_is_flagged_for_its_whole_step(monkeypatch):
    process, nobody = begun(2, estimator="mhe", query_every=4), np.zeros((2, 6), dtype=np.int8)
    for _ in range(3):
        process.step(ALL[:2], nobody)
    make_unsolvable(process.estimator, monkeypatch)
    process.watchers.append(lambda *_: monkeypatch.undo())  # after the first of its seconds
    process.step(ALL[:1], nobody[:1])
    assert [process.info(e)["fallback"] for e in range(2)] == [1.0, 0.0]
    process.step(ALL[:1], nobody[:1])
    assert process.info(0)["fallback"] == 0.0


def test_a_second_that_diverges_is_flagged_for_its_whole_step():
    process, added = begun(1, query_every=4), []

    def lost(episodes, values, *noise):
        added.append(values)
        return np.full_like(values, np.nan) if len(added) == 1 else values

    process.release.noise.added = lost
    process.step(ALL[:1], np.ones((1, 6), dtype=np.int8))
    assert process.info(0)["diverged"] == 1.0
    process.step(ALL[:1], np.ones((1, 6), dtype=np.int8))
    assert (process.info(0)["diverged"], len(added)) == (0.0, 8)


def test_a_second_without_a_centre_is_flagged_for_its_whole_step():
    process, asked = begun(2, privacy=PAID, query_every=4), []
    predicted = process._predicted

    def lost(episodes):
        asked.append(episodes)
        found = predicted(episodes)
        return found._replace(density=np.nan * found.density) if len(asked) == 1 else found

    process._predicted = lost
    for told in (1.0, 0.0):
        process.step(ALL[:1], np.ones((1, 6), dtype=np.int8))
        assert [process.info(e)["centre_fallback"] for e in range(2)] == [told, 0.0]
    assert len(asked) == 8


def test_budgets_are_paced_for_queries_in_some_seconds():
    often, seldom = (make(1, privacy=PAID, query_every=every) for every in (1, 5))
    assert 1.0 < often.expected_sigma[0] / seldom.expected_sigma[0] < 5.0**0.5
