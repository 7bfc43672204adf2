from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import torch

from agents.training import regression
from agents.training.regression import RULE, Practice, regress, squared_errors
from agents.training.settings import parse_algorithm
from dptse_env.sb3 import RoadPolicy, SB3VecEnv
from tests.helpers import SHORT


def make(**changes):
    few = {"rounds": 1, "seconds": 119, "interval": 1, "batches": 200, "batch_size": 64}
    env = gym.make_vec(
        SHORT, num_envs=8, autoreset_mode="SameStep", traffic_seeds="0:3", action="slots",
        privacy="capped",
    )  # fmt: skip
    episodes = SB3VecEnv(env)
    episodes.seed(1)
    torch.manual_seed(0)
    policy = RoadPolicy.from_config(env.config, width=8)
    tuned = parse_algorithm("plackett-luce", 6).regression
    return replace(tuned, **{**few, **changes}), Practice(policy, episodes, 64)


def queried_variance(process):
    return 0.01 * np.exp(2.0 * process.queried)


def test_scores_become_the_logarithms_of_expected_squared_errors(monkeypatch):
    settings, practice = make(age_bonus=0.0, rate=2e-2)
    generator = np.random.default_rng(0)
    seen = []

    def planted(process):
        variance = queried_variance(process)
        seen.append(np.log(variance))
        return (variance * generator.exponential(size=variance.shape)).astype(np.float32)

    monkeypatch.setattr(regression, "squared_errors", planted)
    regress([practice], settings)
    scores = practice.policy.scores(practice.seen[60]).detach().numpy()
    difference = scores / settings.sharpness - seen[60]
    # But for a constant, which no choice depends on.
    difference -= difference.mean()
    assert seen[60].std() > 0.9
    assert difference.std() < 0.4
    assert all(p.grad is None for p in practice.policy.scorer.parameters())


def test_the_bonus_for_age_is_added_once_after_any_number_of_rounds():
    weights = []
    for bonus in (0.5, 0.0):
        settings, practice = make(rounds=3, age_bonus=bonus, seconds=2, batches=1, rate=1e-9)
        regress([practice], settings)
        assert [len(each) for each in (practice.seen, practice.errors)] == [6, 6]
        policy = practice.policy
        rule = policy.scorer.rule.weight[0].tolist()
        weights.append({name: rule[policy.road.index(name)] for name in RULE})
    assert weights[0]["age"] - weights[1]["age"] == pytest.approx(0.5 * 4.0, rel=1e-4)
    # The rule is gone; half of a log deviation is a quarter of a log variance.
    assert weights[0]["speed_log_std"] == pytest.approx(0.5 * 4.0, rel=1e-4)


def test_squared_errors_are_those_of_density_and_speed_in_units_of_their_scales():
    env = gym.make(SHORT, traffic_seeds="0:2", truth_in_info=True)
    observation, _ = env.reset(seed=0)
    for _ in range(20):  # the last segments are empty yet
        observation, *_, info = env.step(np.eye(2, 6, dtype=np.int8).sum(axis=0))
    density, speed = (info[f"true_{name}"][:6] for name in ("density", "speed"))
    squared = squared_errors(env.unwrapped.process)
    block = env.unwrapped.interface.observations.block
    estimated = [block(observation, name)[:6] for name in ("density", "speed")]
    corridor, occupied = env.unwrapped.config.corridor, density > 0
    expected = (estimated[0] - density / corridor.scales.density_scale) ** 2
    assert 0 < occupied.sum() < 6
    expected += occupied * (estimated[1] - speed / corridor.scales.speed_scale) ** 2
    np.testing.assert_allclose(squared[0], expected, rtol=1e-4, atol=1e-8)
    assert squared.shape == (1, 6)
