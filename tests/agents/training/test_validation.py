import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from agents.seeds import TRAINING_VALIDATION
from agents.training.validation import Validation
from dptse_env.evaluation import evaluate
from dptse_env.schedules import make_schedule
from dptse_env.spaces.actions import ACTION_ENCODINGS

SHORT = "dptse_env:dptse/ShortHighway-v0"
SEEDS = (1000, 1003)


class Drawn:
    """Acts by torch's generator."""

    def __init__(self, space):
        self.space = space

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        shape = (len(observation), len(self.space.nvec))
        high = 1 if deterministic else int(self.space.nvec[0])
        return torch.randint(high, shape).numpy(), state


@pytest.mark.parametrize("action", ACTION_ENCODINGS)
def test_errors_are_those_of_single_episodes(action):
    keywords = {"action": action, "privacy": "capped", "horizon": 90}
    validation = Validation(SHORT, keywords, SEEDS)
    policy = make_schedule("round-robin", validation.env)
    errors = validation.errors(policy, deterministic=True)
    env = gym.make(SHORT, traffic_seeds=list(SEEDS), **keywords)
    rows = evaluate(env, "round-robin", SEEDS, TRAINING_VALIDATION.start)
    np.testing.assert_allclose(errors, [-row["reward"] for row in rows], rtol=1e-9)
    np.testing.assert_array_equal(validation.errors(policy, deterministic=True), errors)


def test_draws_are_seeded_and_the_generator_is_left_alone():
    validation = Validation(SHORT, {"action": "slots", "horizon": 70}, SEEDS)
    policy = Drawn(validation.env.single_action_space)
    torch.manual_seed(1)
    state = torch.get_rng_state()
    drawn = validation.errors(policy, deterministic=False)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(2)
    np.testing.assert_array_equal(validation.errors(policy, deterministic=False), drawn)
    assert (validation.errors(policy, deterministic=True) != drawn).all()


@pytest.mark.parametrize(("seeds", "got"), [((1000, 2000), "2000"), ((0,), "0"), ((), "none")])
def test_other_traffic_is_refused(seeds, got):
    with pytest.raises(ValueError, match=rf"seeds in 1000\.\.1999, got \[?{got}"):
        Validation(SHORT, {"action": "slots"}, seeds)


def test_an_episode_within_the_warm_up_says_nothing():
    validation = Validation(SHORT, {"action": "slots", "horizon": 60}, SEEDS)
    policy = Drawn(validation.env.single_action_space)
    with pytest.raises(ValueError, match="warm_up must be shorter than an episode, got 60"):
        validation.errors(policy, deterministic=True)
