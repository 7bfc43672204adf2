import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import torch

from agents.training.learners import make_episodes, make_model
from agents.training.pretraining import pretrain
from agents.training.recipes import PlackettLuceRecipe
from agents.training.truth import SCALES, TrueErrors
from dptse_env.config import resolve
from dptse_env.parts import make_interface

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
    episodes = make_episodes(SHORT, {"traffic_seeds": "0:3", "privacy": "capped"}, recipe, 0)
    return recipe, episodes, make_model(recipe, episodes, 0)


def planted(episodes, monkeypatch, variance):
    """Let the squared errors scatter around a mean that the observation tells."""
    generator = np.random.default_rng(0)

    def split(observation):
        plain = observation[:, : episodes.env.single_observation_space.shape[0]]
        squared = variance(plain) * generator.exponential(size=(len(plain), 6))
        return plain.copy(), squared.astype(np.float32)

    monkeypatch.setattr(episodes, "split", split)


def test_scores_become_the_logarithms_of_expected_squared_errors(monkeypatch):
    recipe, episodes, model = make(
        age_bonus=0.0,
        pretraining_seconds=239,
        pretraining_every=1,
        pretraining_batches=1000,
        pretraining_rate=1e-2,
    )
    block = episodes.env.interface.observations.block

    def variance(plain):
        return 0.01 * np.exp(2.0 * block(plain, "queried"))

    planted(episodes, monkeypatch, variance)
    pretrain(model.policy, episodes, recipe)
    seen = episodes.reset()
    for _ in range(60):
        seen = episodes.step(model.policy.predict(seen)[0])[0]
    policy = model.policy
    scores = policy.scorer(policy.channels(torch.tensor(seen))).detach().numpy()
    difference = scores / recipe.sharpness - np.log(variance(seen[:, :-12]))
    # But for a constant, which no choice depends on.
    difference -= difference.mean()
    assert np.log(variance(seen[:, :-12])).std() > 0.9
    assert difference.std() < 0.4


def test_the_bonus_for_age_is_added_once_after_any_number_of_rounds(monkeypatch):
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


def test_errors_are_split_from_what_was_shown():
    config = resolve("short-highway", {})
    interface = make_interface(config)
    errors = TrueErrors(config, interface)
    env = gym.make(SHORT, traffic_seeds="0:2", truth_in_info=True)
    observation, _ = env.reset(seed=0)
    for _ in range(50):
        observation, *_, info = env.step(np.eye(2, 6, dtype=np.int8).sum(axis=0))
    density, speed = (info["truth"][name][None] for name in ("density", "speed"))
    plain, squared = errors.split(errors.append(observation[None], density, speed))
    np.testing.assert_array_equal(plain[0], observation)
    estimated = [
        interface.observations.block(observation, name)[:6] for name in ("density", "speed")
    ]
    expected = (estimated[0] - density[0, :6] / config.corridor.density_scale) ** 2
    occupied = density[0, :6] > 0
    assert occupied.any()
    expected += occupied * (estimated[1] - speed[0, :6] / config.corridor.speed_scale) ** 2
    np.testing.assert_allclose(squared[0], expected, rtol=1e-4, atol=1e-8)
    assert errors.space().shape == (len(observation) + 12,)
    assert len(SCALES) == 2


def test_it_needs_the_errors():
    _, episodes, _ = make(shows_errors=False, pretraining_rounds=0)
    with pytest.raises(ValueError, match="must be made with shows_errors"):
        episodes.split(episodes.reset())
