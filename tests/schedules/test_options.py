"""Schedules where a query may cover several segments, or has several price levels."""

import itertools

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.parts import make_interface
from dptse_env.release import QueryOptions
from dptse_env.schedules import COVARIANCE_SCHEDULES, OBSERVATION_SCHEDULES, make_schedule
from dptse_env.schedules.ranking import best_options, option_values
from dptse_env.spaces.actions import ACTION_ENCODINGS
from tests.cases import fast_and_slow

from ..release.sums import SumRelease
from .playing import begin, make_batch, make_single, play

NAMES = [*sorted(set(OBSERVATION_SCHEDULES) - {"none", "all"}), "oracle-error"]
ROADS = {
    "spans": {"query_spans": (1, 2, 3), "bandwidth": 4},
    "sums": {"query_spans": (1, 2, 3), "bandwidth": 2, "bandwidth_unit": "sums"},
    "only sums": {"query_spans": (2,), "bandwidth": 5},
    "levels": {"price_levels": (2.0, 0.9, 0.5), "bandwidth": 3},
    "both": {"query_spans": (2, 3), "price_levels": (0.5, 1.0), "bandwidth": 5},
}
STEPS = np.zeros(1, dtype=np.int64)


def make(road, action="mask"):
    return make_single(privacy=SumRelease, action=action, **ROADS[road])


@pytest.mark.parametrize(
    ("name", "road"),
    fast_and_slow(itertools.product(NAMES, ROADS), [
            ("round-robin", "both"), ("oldest-first", "sums"), ("stale-variance", "spans"),
            ("speed-front", "levels"), ("largest-deviation", "only sums"), ("oracle-error", "both"),
        ]),
)  # fmt: skip
def test_every_encoding_asks_the_same_and_for_as_much_as_it_may(name, road):
    env = make(road)
    options = env.unwrapped.config.queries
    expected, rewards = play(env, name, 6)
    cost = expected[:, 0] @ options.cost
    assert (cost <= options.bandwidth).all()
    left = options.bandwidth - cost[:, None]
    assert ((options.cost > left) | expected[:, 0]).all()
    for action in ACTION_ENCODINGS:
        queries, own = play(make(road, action), name, 6)
        np.testing.assert_array_equal(queries, expected)
        np.testing.assert_array_equal(own, rewards)


@pytest.mark.parametrize(
    "name",
    fast_and_slow(sorted(set(NAMES) - {"random"}), ["paper", "stale-variance", "oracle-error"]),
)
def test_a_batch_asks_what_its_episodes_ask_alone(name):
    keywords = {"privacy": SumRelease, **ROADS["spans"]}
    queries, rewards = play(make_batch(**keywords), name, 6)
    for episode in range(3):
        env = make_single(**keywords)
        alone, own = play(env, name, 6, begin(env, seed=5 + episode))
        np.testing.assert_array_equal(alone[:, 0], queries[:, episode])
        np.testing.assert_array_equal(own[:, 0], rewards[:, episode])


@pytest.mark.parametrize("name", ["oldest-first", "stale-variance", "oracle-error"])
def test_picks_do_not_overlap_and_have_the_standard_level(name):
    env = make("spans")
    options = env.unwrapped.config.queries
    queries, _ = play(env, name, 8)
    assert ((queries[:, 0].astype(int) @ options.covers) <= 1).all()
    env = make("levels")
    queries, _ = play(env, name, 4)
    levels = env.unwrapped.config.queries.level
    assert (levels[np.nonzero(queries)[2]] == 0.9).all()


def chosen(options, value, fixed=(), step=0):
    value, fixed = np.array([value], dtype=float), np.array(fixed, dtype=np.int64)
    best = best_options(options, value, fixed, STEPS + step)
    return [(int(options.first[g]), int(options.span[g])) for g in np.flatnonzero(best[0])]


def test_an_option_is_worth_the_mean_of_its_segments_for_its_cost():
    free = np.zeros(0, dtype=np.int64)
    value = np.array([[1.0, 2.0, 3.0, 0.0]])
    sums = QueryOptions.make(4, 2, (1, 2), unit="sums")
    assert option_values(sums, value, free).tolist() == [[1, 2, 3, 0, 1.5, 2.5, 1.5]]
    segments = QueryOptions.make(4, 2, (1, 2))
    assert option_values(segments, value, free).tolist() == [[1, 2, 3, 0, 0.75, 1.25, 0.75]]


def test_a_fixed_sensor_makes_a_segment_worth_the_least():
    options = QueryOptions.make(4, 2, (1, 2), unit="sums")
    value, sensors = np.array([[4.0, 2.0, 9.0, 9.0]]), np.array([2, 3])
    expected = [4, 2, -np.inf, -np.inf, 3, 2, -np.inf]
    assert option_values(options, value, sensors).tolist() == [expected]


def test_the_best_options_are_apart_while_there_are_such():
    sums = QueryOptions.make(6, 2, (3,), unit="sums")
    assert chosen(sums, [1, 1, 1, 1, 1, 0.5]) == [(0, 3), (3, 3)]
    assert chosen(sums, [0, 1, 1, 1, 0, 0]) == [(0, 3), (1, 3)]  # none is left apart from the best
    mixed = QueryOptions.make(6, 3, (1, 2))
    assert chosen(mixed, [0, 0, 1, 5, 5, 0]) == [(2, 1), (3, 1), (4, 1)]


def test_what_is_left_of_the_bandwidth_goes_to_overlapping_options_then_to_other_levels():
    options = QueryOptions.make(4, 4, (2,), (4.0, 1.0), unit="sums")
    best = best_options(options, np.array([[0.0, 1.0, 1.0, 2.0]]), np.zeros(0, np.int64), STEPS)
    taken = np.flatnonzero(best[0])
    assert options.first[taken].tolist() == [2, 0, 1, 2]
    assert options.level[taken].tolist() == [4.0, 1.0, 1.0, 1.0]


class Bare:
    """As much of an environment as a schedule of observations needs."""

    def __init__(self, **keywords):
        self.unwrapped = self
        config = resolve("paper-highway", {"privacy": SumRelease, **keywords})
        self.queries, self.interface = config.queries, make_interface(config)

    def asked(self, name, n_steps):
        size = self.interface.observations.space.shape[0]
        steps = np.arange(n_steps)
        return make_schedule(name, self).select(steps, np.zeros((n_steps, size), np.float32))


def test_a_shifting_set_keeps_to_one_span_and_level():
    env = Bare(query_spans=(2, 3), price_levels=(0.5, 1.0), bandwidth=6)
    asked = env.asked("round-robin", 14)
    assert (env.queries.span[np.nonzero(asked)[1]] == 2).all()
    assert (env.queries.level[np.nonzero(asked)[1]] == 1.0).all()
    first = [env.queries.first[row].tolist() for row in asked]
    assert first[0] == [0, 4, 9]
    assert first[1] == [1, 5, 10]
    assert first[5] == [0, 5, 9]  # from the last of 14 options to the first
    assert (asked.sum(axis=0)[asked.any(axis=0)] == 3).all()  # each of them equally often


def test_all_queries_every_segment_by_itself():
    env = Bare(query_spans=(1, 2), price_levels=(0.5, 1.0), bandwidth=15)
    asked = env.asked("all", 2)
    assert (env.queries.span[np.nonzero(asked)[1]] == 1).all()
    assert (asked @ env.queries.covers).all()
    assert (asked.sum(axis=1) == 15).all()
    with pytest.raises(ValueError, match=r"schedule 'all' needs query_spans with 1, got query_spa"):
        make_schedule("all", Bare(query_spans=(2,), bandwidth=15))


def test_schedules_of_single_segments_say_so():
    names = [*COVARIANCE_SCHEDULES, "oracle-gain"]
    for name, road in itertools.product(names, ["spans", "levels"]):
        with pytest.raises(ValueError, match=rf"schedule '{name}' queries single segments"):
            make_schedule(name, make(road))
