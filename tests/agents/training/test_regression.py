import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import torch

from agents.training.episodes import make_episodes
from agents.training.recipes import PlackettLuceRecipe, RegressionRounds
from agents.training.regression import Practice, regress, squared_errors
from dptse_env.sb3 import PlackettLucePolicy

SHORT = "dptse_env:dptse/ShortHighway-v0"
SETTINGS = {"rounds": 1, "seconds": 100, "batches": 200, "batch_size": 64, "rate": 3e-3}


def make(**changes):
    settings = RegressionRounds(**{**SETTINGS, **changes})
    recipe = PlackettLuceRecipe(n_envs=8, replicas=1, regression=settings)
    episodes = make_episodes(SHORT, {"traffic_seeds": "0:3", "privacy": "capped"}, recipe, 0)
    torch.manual_seed(0)
    policy = PlackettLucePolicy.from_config(episodes.env.config, width=8)
    return settings, episodes, policy


def queried_variance(process):
    return 0.01 * np.exp(2.0 * process.queried)


def test_scores_become_the_logarithms_of_expected_squared_errors():
    settings, episodes, policy = make(
        age_bonus=0.0, seconds=119, interval=1, batches=200, rate=2e-2
    )
    generator = np.random.default_rng(0)

    def planted(process):
        variance = queried_variance(process)
        return (variance * generator.exponential(size=variance.shape)).astype(np.float32)

    regress([Practice(policy, episodes, settings.batch_size)], settings, targets=planted)
    seen = episodes.reset()
    for _ in range(60):
        seen = episodes.step(policy.predict(seen)[0])[0]
    scores = policy.scores(torch.tensor(seen)).detach().numpy()
    expected = np.log(queried_variance(episodes.env.process))
    difference = scores / settings.sharpness - expected
    # But for a constant, which no choice depends on.
    difference -= difference.mean()
    assert expected.std() > 0.9
    assert difference.std() < 0.4


def test_the_bonus_for_age_is_added_once_after_any_number_of_rounds():
    weights = []
    for rounds, bonus in ((3, 0.5), (3, 0.0)):
        settings, episodes, policy = make(
            rounds=rounds, age_bonus=bonus, seconds=2, batches=1, rate=1e-9
        )
        regress([Practice(policy, episodes, settings.batch_size)], settings)
        weights.append(dict(zip(policy.rule, policy.scorer.rule.tolist(), strict=True)))
    assert weights[0]["age"] - weights[1]["age"] == pytest.approx(0.5 * 4.0, rel=1e-4)
    assert weights[0]["speed_log_std"] == pytest.approx(0.5 * 4.0, rel=1e-4)


def test_it_reports_its_progress_and_leaves_no_gradients():
    fractions = []
    settings, episodes, policy = make(rounds=2, seconds=3, batches=100)
    regress([Practice(policy, episodes, settings.batch_size)], settings, fractions.append)
    assert fractions == [0.0, 0.25, 0.5, 0.75]
    assert all(p.grad is None for p in policy.scorer.parameters())


def test_squared_errors_are_those_of_density_and_speed_in_units_of_their_scales():
    env = gym.make(SHORT, traffic_seeds="0:2", truth_in_info=True)
    observation, _ = env.reset(seed=0)
    for _ in range(50):
        observation, *_, info = env.step(np.eye(2, 6, dtype=np.int8).sum(axis=0))
    density, speed = (info["truth"][name][:6] for name in ("density", "speed"))
    squared = squared_errors(env.unwrapped.process)
    block = env.unwrapped.interface.observations.block
    estimated = [block(observation, name)[:6] for name in ("density", "speed")]
    corridor, occupied = env.unwrapped.config.corridor, density > 0
    expected = (estimated[0] - density / corridor.density_scale) ** 2
    assert occupied.any()
    expected += occupied * (estimated[1] - speed / corridor.speed_scale) ** 2
    np.testing.assert_allclose(squared[0], expected, rtol=1e-4, atol=1e-8)
    assert squared.shape == (1, 6)
