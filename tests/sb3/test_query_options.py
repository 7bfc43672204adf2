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


@pytest.mark.parametrize(
    "other",
    [
    {"query_spans": (1, 2, 3)},
    {"bandwidth_unit": "sums"},
],
    ids=str,
)  # fmt: skip
def test_a_policy_is_refused_where_other_options_can_be_queried(tmp_path, other):
    path = saved(tmp_path, "mask", **SPANS)
    with pytest.raises(ValueError, match=r"queries is \"query_spans \(1, 2\) and price_levels"):
        load_policy(path, make_env("mask", **{**SPANS, **other}), allow=("corridor", "bandwidth"))


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
