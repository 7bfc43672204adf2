"""Rules against their definitions, on observations that are made up."""

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.estimators import Estimate
from dptse_env.parts import make_interface
from dptse_env.release import Queries
from dptse_env.schedules import best_queries, make_schedule, query_values
from tests.helpers import SumRelease

from .playing import begin, make_batch


class Bare:
    """As much of an environment as a schedule of observations needs."""

    def __init__(self, **keywords):
        self.unwrapped = self
        config = resolve("paper-highway", keywords)
        self.queries, self.interface = config.queries, make_interface(config)

    def observation(self, k=1, **blocks):
        """Return observations whose blocks are zero, or begin with values of the mainline."""
        observations = self.interface.observations
        flat = np.zeros((k, observations.space.shape[0]), dtype=np.float32)
        for name, values in blocks.items():
            flat[:, observations.slices[name]][:, : np.shape(values)[-1]] = values
        return flat


def queried(name, n_steps, **keywords):
    """Return the options that a schedule asks for over some steps without any news."""
    env = Bare(**keywords)
    schedule, state, sets = make_schedule(name, env, seed=0), None, []
    for _ in range(n_steps):
        action, state = schedule.predict(env.observation()[0], state)
        sets.append(np.flatnonzero(action).tolist())
    return sets


def test_shifting_sets_start_far_apart_and_move_downstream():
    for bandwidth in (5, 7, 11):
        (start,) = queried("static", 1, bandwidth=bandwidth)
        assert start == [15 * i // bandwidth for i in range(bandwidth)]
    assert queried("static", 9) == [[0, 3, 6, 9, 12]] * 9
    assert queried("round-robin", 3) == [[0, 3, 6, 9, 12], [1, 4, 7, 10, 13], [2, 5, 8, 11, 14]]
    sets = queried("shift-ahead", 61)
    assert sets[:8] == [[0, 3, 6, 9, 12]] * 4 + [[1, 4, 7, 10, 13]] * 4
    assert sets[8] == [2, 5, 8, 11, 14]
    assert sets[60] == sets[12] == sets[0]


def test_a_shifting_set_keeps_to_one_span():
    env = Bare(query_spans=(2, 3), bandwidth=6, privacy=SumRelease)
    size = env.interface.observations.space.shape[0]
    steps = np.arange(14)
    asked = make_schedule("round-robin", env).select(steps, np.zeros((14, size), np.float32))
    assert (env.queries.span[np.nonzero(asked)[1]] == 2).all()
    first = [env.queries.first[row].tolist() for row in asked]
    assert (first[0], first[1], first[5]) == ([0, 4, 9], [1, 5, 10], [0, 5, 9])
    assert (asked.sum(axis=0)[asked.any(axis=0)] == 3).all()  # each of them equally often


def test_random_draws_different_sets_of_full_size():
    sets = queried("random", 200)
    assert all(len(chosen) == 5 for chosen in sets)
    assert len({tuple(chosen) for chosen in sets}) > 150
    assert np.bincount(np.concatenate(sets), minlength=15).min() > 40
    assert queried("random", 5) == sets[:5]


def test_none_and_all():
    assert queried("none", 1) == [[]]
    assert queried("all", 1, bandwidth=15) == [list(range(15))]
    spans = {"query_spans": (1, 2), "privacy": SumRelease}
    (asked,), options = queried("all", 1, bandwidth=15, **spans), Bare(**spans).queries
    assert sorted(options.first[asked]) == list(range(15))
    assert set(options.span[asked]) == {1}
    with pytest.raises(ValueError, match="'all' needs bandwidth 15, the environment has 5"):
        queried("all", 1)
    with pytest.raises(ValueError, match=r"'all' needs query_spans with 1, got query_spa"):
        queried("all", 1, query_spans=(2,), bandwidth=15, privacy=SumRelease)


def test_oldest_first_asks_the_oldest_and_breaks_ties_in_turn():
    env = Bare()
    age = np.linspace(0, 1, 15)[[3, 1, 14, 0, 2, 5, 4, 13, 12, 6, 7, 8, 11, 10, 9]]
    schedule = make_schedule("oldest-first", env)
    action, _ = schedule.predict(env.observation(age=age)[0])
    assert np.flatnonzero(action).tolist() == [2, 7, 8, 12, 13]
    counts, state = np.zeros(15), None
    for _ in range(140):
        action, state = schedule.predict(env.observation()[0], state)
        counts += action
    assert counts[14] == 0  # it has a fixed sensor
    assert counts[:14].min() > 40


def made_up(env, k=20):
    """Return random observations, and their blocks of the mainline by name."""
    rng = np.random.default_rng(0)
    blocks = {
        "age": rng.uniform(0.0, 0.2, (k, 15)), "speed": rng.uniform(0.0, 1.2, (k, 15)),
        "density_log_std": rng.uniform(-4.0, -1.0, (k, 15)),
        "speed_log_std": rng.uniform(-4.0, 0.0, (k, 15)),
    }  # fmt: skip
    return env.observation(k, **blocks), blocks


def assert_highest(env, action, score):
    """Compare queries with the segments of the highest score; the last one has a fixed sensor."""
    best = np.argsort(-score[:, :14], axis=1)[:, : env.queries.bandwidth]
    expected = np.zeros_like(score, dtype=bool)
    np.put_along_axis(expected, best, True, axis=1)
    np.testing.assert_array_equal(action.astype(bool), expected)


@pytest.mark.parametrize(
    ("name", "power", "cap", "reward"),
    [
        ("largest-variance", 0.0, np.inf, "joint"), ("largest-variance", 0.0, np.inf, "speed"),
        ("largest-density-variance", 0.0, 0.0, "joint"), ("stale-variance", 2.0, 0.1, "joint"),
        ("largest-deviation", 1.0, np.inf, "joint"),
    ],
)  # fmt: skip
def test_deviations_are_weighed_by_age(name, power, cap, reward):
    """Scores are (age + 1)^a (s_rho^2 + min(s_v, cap)^2)."""
    env = Bare(bandwidth=3, reward=reward)
    observation, blocks = made_up(env)
    variance = np.minimum(np.exp(blocks["speed_log_std"]), cap) ** 2
    if reward == "joint":
        variance += np.exp(2.0 * blocks["density_log_std"])
    action, _ = make_schedule(name, env).predict(observation)
    assert_highest(env, action, (60.0 * blocks["age"] + 1.0) ** power * variance)


def test_fronts_are_queried_where_answers_surprised():
    """Scores are (age + 1)^1.5 (|v_before - v_after| + 0.02) q (v + 0.3) (2 - x)."""
    env = Bare(bandwidth=2)
    schedule, rng = make_schedule("speed-front", env), np.random.default_rng(1)
    state, surprise = None, np.ones((20, 15))
    for step in range(4):
        observation, blocks = made_up(env)
        flags = rng.random((20, 15)) < 0.3
        squares, slices = np.zeros((20, 15)), env.interface.observations.slices
        for name in ("density_innovation", "speed_innovation"):
            given = rng.normal(0.0, 2.0, (20, 15))
            observation[:, slices[name]], squares = given, squares + 0.5 * given**2
        observation[:, slices["queried"]] = flags
        starts = np.arange(20) < (5 if step == 2 else 0)
        surprise[starts] = 1.0
        surprise = np.where(flags, 0.8 * surprise + 0.2 * squares, surprise)
        action, state = schedule.predict(observation, state, starts)
        v = np.pad(blocks["speed"], ((0, 0), (1, 1)), mode="edge")
        score = (60.0 * blocks["age"] + 1.0) ** 1.5 * (np.abs(v[:, :-2] - v[:, 2:]) + 0.02)
        score *= surprise * (v[:, 1:-1] + 0.3) * (2.0 - np.arange(15) / 14)
        assert_highest(env, action, score)


@pytest.mark.parametrize("privacy", ["printed", "capped"])
@pytest.mark.parametrize("term", ["joint", "speed"])
def test_the_expected_reduction_is_that_of_independent_updates(privacy, term):
    env = make_batch(privacy=privacy, reward=term, bandwidth=1)
    observation = begin(env)
    process, rng = env.unwrapped.process, np.random.default_rng(0)
    corridor, sigma = process.config.corridor, process.release.sigma
    shape = process.n_episodes, process.model.n_segments
    density, speed = rng.uniform(10.0, 90.0, shape), rng.uniform(20.0, 90.0, shape)
    spread = rng.uniform(1.0, 40.0, (2, *shape))
    process.estimate = Estimate(density, speed, spread[0], spread[1])
    process.age = rng.integers(0, 20, process.age.shape)
    action, _ = make_schedule("expected-reduction", env).predict(observation)

    P, Q = spread[:, :, : corridor.geometry.n_mainline] ** 2
    noise = (
        sigma[1] / density[:, : corridor.geometry.n_mainline] if privacy == "capped" else sigma[1]
    )
    value = (Q - 1.0 / (1.0 / Q + 1.0 / noise**2)) / corridor.scales.speed_scale**2
    if term == "joint":
        value += (P - 1.0 / (1.0 / P + 1.0 / sigma[0] ** 2)) / corridor.scales.density_scale**2
    value *= process.age + 1.0
    value[:, 5] = -1.0  # it has a fixed sensor
    np.testing.assert_array_equal(np.argmax(action, axis=1), np.argmax(value, axis=1))


def test_an_option_is_worth_the_mean_of_its_segments_for_its_cost():
    free = np.zeros(0, dtype=np.int64)
    value = np.array([[1.0, 2.0, 3.0, 0.0]])
    sums = Queries.make(4, 2, (1, 2), unit="sums")
    assert query_values(sums, value, free).tolist() == [[1, 2, 3, 0, 1.5, 2.5, 1.5]]
    segments = Queries.make(4, 2, (1, 2))
    assert query_values(segments, value, free).tolist() == [[1, 2, 3, 0, 0.75, 1.25, 0.75]]
    # A fixed sensor makes a segment worth the least of the others.
    value, sensors = np.array([[4.0, 2.0, 9.0, 9.0]]), np.array([2, 3])
    expected = [4, 2, -np.inf, -np.inf, 3, 2, -np.inf]
    assert query_values(sums, value, sensors).tolist() == [expected]


@pytest.mark.parametrize(
    ("options", "value", "expected"),
    [
        (Queries.make(6, 2, (3,), unit="sums"), [1, 1, 1, 1, 1, 0.5], [0, 3]),
        # None is left apart from the best.
        (Queries.make(6, 2, (3,), unit="sums"), [0, 1, 1, 1, 0, 0], [0, 1]),
        (Queries.make(6, 3, (1, 2)), [0, 0, 1, 5, 5, 0], [2, 3, 4]),
    ],
)
def test_the_best_options_are_apart_while_there_are_such(options, value, expected):
    none, step = np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64)
    (best,) = best_queries(options, np.array([value], dtype=float), none, step)
    assert options.first[best].tolist() == expected
