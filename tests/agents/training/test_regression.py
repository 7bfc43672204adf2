import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import torch

from agents.training.ppo import make_episodes, make_model
from agents.training.recipes import PlackettLuceRecipe
from agents.training.regression import pretrain
from agents.training.truth import squared_errors

SHORT = "dptse_env:dptse/ShortHighway-v0"


def make(**changes):
    values = {
        "n_envs": 8,
        "twins": 1,
        "n_steps": 10,
        "batch_size": 40,
        "width": 8,
        "pretraining_rounds": 1,
        "pretraining_seconds": 100,
        "pretraining_batches": 200,
        "pretraining_batch_size": 64,
        "pretraining_rate": 3e-3,
        **changes,
    }
    recipe = PlackettLuceRecipe(**values)
    episodes = make_episodes(SHORT, {"traffic_seeds": "0:3", "privacy": "guaranteed"}, recipe, 0)
    return recipe, episodes, make_model(recipe, episodes, 0)


def queried_variance(process):
    return 0.01 * np.exp(2.0 * process.queried)


def test_scores_become_the_logarithms_of_expected_squared_errors():
    recipe, episodes, model = make(
        age_bonus=0.0,
        pretraining_seconds=239,
        pretraining_every=1,
        pretraining_batches=1000,
        pretraining_rate=1e-2,
    )
    generator = np.random.default_rng(0)

    def planted(process):
        variance = queried_variance(process)
        return (variance * generator.exponential(size=variance.shape)).astype(np.float32)

    pretrain(model.policy, episodes, recipe, squared=planted)
    seen = episodes.reset()
    for _ in range(60):
        seen = episodes.step(model.policy.predict(seen)[0])[0]
    policy = model.policy
    scores = policy.scorer(policy.channels(torch.tensor(seen))).detach().numpy()
    expected = np.log(queried_variance(episodes.env.process))
    difference = scores / recipe.sharpness - expected
    # But for a constant, which no choice depends on.
    difference -= difference.mean()
    assert expected.std() > 0.9
    assert difference.std() < 0.4


def test_the_bonus_for_age_is_added_once_after_any_number_of_rounds():
    weights = []
    for rounds, bonus in ((3, 0.5), (3, 0.0)):
        recipe, episodes, model = make(
            pretraining_rounds=rounds, age_bonus=bonus, pretraining_seconds=2,
            pretraining_batches=1, pretraining_rate=1e-9,
        )  # fmt: skip
        pretrain(model.policy, episodes, recipe)
        weights.append(dict(zip(model.policy.rule, model.policy.scorer.rule.tolist(), strict=True)))
    assert weights[0]["age"] - weights[1]["age"] == pytest.approx(0.5 * 4.0, rel=1e-4)
    assert weights[0]["speed_log_std"] == pytest.approx(0.5 * 4.0, rel=1e-4)


def test_it_reports_its_progress_and_leaves_no_gradients():
    shares = []
    recipe, episodes, model = make(
        pretraining_rounds=2, pretraining_seconds=3, pretraining_batches=100
    )
    pretrain(model.policy, episodes, recipe, shares.append)
    assert shares == [0.0, 0.25, 0.5, 0.75]
    assert all(p.grad is None for p in model.policy.scorer.parameters())
    assert np.isnan(episodes.take_mean_reward())


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
