"""Policies where a query may cover several segments, or has several price levels."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

from sb3_contrib import MaskablePPO

from dptse_env.config import resolve
from dptse_env.sb3 import RoadChannels, SB3VecEnv, load_policy, save_policy
from tests.release.sums import PricedRelease, SumRelease

from .saved_files import ABOUT, SHORT, make_policy

SPANS = {"privacy": SumRelease, "query_spans": (1, 2), "bandwidth": 3}


def saved(path, action, **keywords):
    policy, config = make_policy(action, **keywords)
    save_policy(path / "one.zip", policy, config, **ABOUT)
    return path / "one.zip"


def make_env(action, **keywords):
    return gym.make(SHORT, action=action, traffic_seeds="0:2", **keywords)


@pytest.mark.parametrize("action", ["mask", "scores", "sequential"])
def test_a_perceptron_acts_on_options(tmp_path, action):
    env = make_env(action, **SPANS)
    policy = load_policy(saved(tmp_path, action, **SPANS), env)
    options = env.unwrapped.config.queries
    observation, _ = env.reset(seed=0)
    for _ in range(12):
        observation, *_, info = env.step(policy.predict(observation)[0])
        assert info["queried"] @ options.cost <= 3
        assert action != "sequential" or info["n_dropped"] == 0


@pytest.mark.parametrize("bandwidth", [2, 3])
def test_a_masked_policy_picks_nothing_that_does_not_fit(tmp_path, bandwidth):
    keywords = {**SPANS, "query_spans": (2, 3), "bandwidth": bandwidth}
    env = make_env("sequential", **keywords)
    policy = load_policy(saved(tmp_path, "sequential", **keywords), env)
    batch = np.stack([env.reset(seed=0)[0]] * 64)
    assert policy.predict(batch)[0].max() == (4 if bandwidth == 2 else 8)


@pytest.mark.parametrize(
    "other",
    [
        {"query_spans": (1, 2, 3)}, {"price_levels": (1.0, 2.0)}, {"bandwidth_unit": "sums"},
        {"query_spans": (1,)},
    ],
    ids=str,
)  # fmt: skip
def test_a_policy_is_refused_where_other_options_can_be_queried(tmp_path, other):
    path = saved(tmp_path, "mask", **SPANS)
    with pytest.raises(ValueError, match=r"queries is \"query_spans \(1, 2\) and price_levels"):
        load_policy(path, make_env("mask", **{**SPANS, **other}), allow=("corridor", "bandwidth"))


def test_the_card_of_a_policy_of_segments_says_nothing_of_queries(tmp_path):
    segments = {"privacy": SumRelease}
    plain = load_policy(saved(tmp_path, "mask", **segments), make_env("mask", **segments))
    assert "queries" not in plain.card["fits"]
    of_sums = load_policy(saved(tmp_path, "mask", **SPANS), make_env("mask", **SPANS))
    expected = "query_spans (1, 2) and price_levels (1.0,), bandwidth_unit 'segments'"
    assert of_sums.card["fits"]["queries"] == expected


@pytest.mark.parametrize(
    "keywords", [SPANS, {**SPANS, "query_spans": (1,), "price_levels": (1, 2)}]
)
def test_a_network_shared_by_segments_needs_segments(keywords):
    message = r"shared by all segments needs query_spans \(1,\) and one price level, got query_sp"
    with pytest.raises(ValueError, match=message):
        RoadChannels.from_config(resolve("short-highway", keywords))


def test_prices_and_the_tracer_are_channels_where_they_are_observed():
    named = [RoadChannels.from_config(resolve("short-highway", {"privacy": privacy})).channels
             for privacy in (SumRelease, PricedRelease)]  # fmt: skip
    without, priced = ({channel.name for channel in channels} for channels in named)
    assert priced - without == {"mainline last_price", "mainline tracer"}


def test_maskable_ppo_trains_where_decisions_take_different_numbers_of_actions():
    env = gym.make_vec(
        SHORT, num_envs=3, autoreset_mode="SameStep", action="sequential", traffic_seeds="0:2",
        horizon=12, random_start=True, **SPANS,
    )  # fmt: skip
    model = MaskablePPO("MlpPolicy", SB3VecEnv(env), n_steps=20, batch_size=30, seed=0)
    model.learn(60)
    assert model.num_timesteps == 60
    picks = model.rollout_buffer.actions[..., 0]
    assert set(np.unique(picks).astype(int)) <= set(range(11))
    assert not env.process.n_dropped.any()
