"""Whole environments in which a query may cover several segments."""

import itertools

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.process import QueryProcess
from dptse_env.spaces.actions import ACTION_ENCODINGS
from tests.helpers import (
    EPISODES,
    PricedRelease,
    SumRelease,
    fast_and_slow,
    lock_step,
    make_env,
)

ONE = np.zeros(1, dtype=np.int64)
CONFIGURATIONS = {
    "spans": {"query_spans": (1, 2, 4), "bandwidth": 5},
    "sums": {"query_spans": (2, 3), "bandwidth_unit": "sums"},
    "segments": {},
    "all of it": {
        "query_spans": (2, 3), "bandwidth": 4,
        "privacy": {"preset": PricedRelease, "boundary_inputs": "private"},
    },
    "one query": {"query_spans": (6,), "bandwidth_unit": "sums"},
}  # fmt: skip
PAIRS = [
    ("spans", "sequential"), ("sums", "mask"), ("segments", "slots"), ("all of it", "scores"),
    ("all of it", "sequential"), ("one query", "slots"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "action"), fast_and_slow(itertools.product(CONFIGURATIONS, ACTION_ENCODINGS), PAIRS)
)
def test_batches_are_episodes_whose_queries_stay_within_the_bandwidth(name, action):
    keywords = {"privacy": PricedRelease, "action": action, **CONFIGURATIONS[name]}
    lock_step(keywords, 8)
    env = make_env(**EPISODES, **keywords)
    queries = env.unwrapped.config.queries
    env.reset(seed=1)
    env.action_space.seed(2)
    truncated = False
    while not truncated:
        observation, _, _, truncated, info = env.step(env.action_space.sample())
        assert info["queried"].shape == (queries.n_queries,)
        assert info["queried"] @ queries.cost <= queries.bandwidth
        assert env.observation_space.contains(observation)


def make_process(**keywords):
    defaults = {"privacy": PricedRelease, "traffic_seeds": "0:1", "horizon": 30, "bandwidth": 6}
    process = QueryProcess(resolve("short-plain", {**defaults, **keywords}))
    process.reset(ONE, [np.random.default_rng(4)], {"traffic_seed": 0})
    return process


def query(process, *queries):
    """Queries for a second, by mask; return the observation."""
    flags = np.isin(np.arange(process.interface.queries.n_queries), queries)
    return process.step(ONE, flags[None].astype(np.int8)).observation


def test_age_is_of_segments_and_counts_every_query_that_covers_them():
    process = make_process(query_spans=(2, 3))
    for _ in range(3):
        query(process)
    ages = []
    for queries in ((1,), (7,), ()):
        query(process, *queries)
        ages.append(process.age[0].tolist())
    assert ages == [[64, 0, 0, 64, 64, 0], [65, 1, 0, 0, 0, 0], [66, 2, 1, 1, 1, 0]]


def test_a_sensor_without_an_option_has_a_row_of_its_own():
    process = make_process(query_spans=(2,), bandwidth=2)
    observation = query(process, 0)
    block = process.interface.observations.block
    assert process.interface.observations.task.sensors.tolist() == [7, 6]  # segment 5, and a ramp
    innovations = process.estimator.innovations[0]
    assert np.flatnonzero(innovations.all(axis=1)).tolist() == [0, 6, 7]
    fixed = block(observation, "fixed_density_innovation")[0]
    np.testing.assert_allclose(fixed, innovations[[7, 6], 0], rtol=1e-6)
    assert np.flatnonzero(block(observation, "density_innovation")[0]).tolist() == [0]


def test_blocks_have_the_size_of_queries_and_show_prices_and_the_spent_share():
    process = make_process(query_spans=(2, 3))
    encoding, n_queries = process.interface.observations, 9
    assert process.interface.actions.space == gym.spaces.MultiBinary(n_queries)
    sizes = {name: place.stop - place.start for name, place in encoding.slices.items()}
    of_queries = ("released_density", "released_flow", "density_innovation", "queried")
    assert {sizes[name] for name in (*of_queries, "speed_innovation", "last_price")} == {n_queries}
    assert {sizes[name] for name in ("age", "spent_share")} == {6}
    first = process.observe(ONE)
    assert not encoding.block(first, "last_price").any()
    assert not encoding.block(first, "spent_share").any()
    query(process, 1)
    observation = query(process, 6)
    prices = encoding.block(observation, "last_price")[0]
    assert np.flatnonzero(prices).tolist() == [1, 6]
    np.testing.assert_allclose(prices[[1, 6]], 0.5 * np.log10(0.01), rtol=1e-6)
    np.testing.assert_allclose(
        encoding.block(observation, "spent_share")[0], [0, 0.5, 0.5, 0.25, 0, 0.5]
    )


def test_blocks_of_prices_are_there_where_queries_have_prices_or_they_are_asked_for():
    slices = make_process(privacy=SumRelease).interface.observations.slices
    assert not {"last_price", "spent_share"} & set(slices)
    process = make_process(privacy="capped", observation=["age", "last_price", "spent_share"])
    assert not process.observe(ONE)[0, 6:].any()
