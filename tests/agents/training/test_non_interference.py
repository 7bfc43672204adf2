"""A trained policy sees nothing of the true traffic; see `tests.test_non_interference`."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import torch

from agents.training.plan import TrainingPlan
from agents.training.recipes import RECIPES, SwapRounds
from agents.training.training import POLICY, Training
from dptse_env.sb3 import load_policy
from tests.agents.training.plans import make_recipe
from tests.test_non_interference import START, blind, make_private, public, same

SWAPS = SwapRounds(rounds=1, episodes=2, seconds=5, trials=1, batches=2, batch_size=8)


@pytest.fixture(scope="module", params=RECIPES)
def trained(request, tmp_path_factory):
    """A policy of every learner, trained a little with the truth at hand."""
    learner = request.param
    recipe = make_recipe(learner)
    if learner == "plackett-luce":
        recipe = dataclasses.replace(recipe, swaps=SWAPS)
    plan = TrainingPlan(
        env="dptse_env:dptse/PrivateHighway-v0",
        recipe=recipe,
        seed=0,
        steps=0 if learner == "plackett-luce" else 80,
        traffic_seeds=(0, 1),
        validation_seeds=(1000,),
        keywords={"horizon": 70},
    )
    folder = tmp_path_factory.mktemp(learner)
    Training(plan, folder).run()
    return plan.recipe.action, folder / POLICY


def transcript(env, traffic_seed, policy, deterministic):
    options = {"traffic_seed": traffic_seed, "start": START}
    observation, info = env.reset(seed=7, options=options)
    torch.manual_seed(7)
    seen, truncated = [{"observation": observation, **public(env, info)}], False
    while not truncated:
        action, _ = policy.predict(observation, deterministic=deterministic)
        observation, _, _, truncated, info = env.step(action)
        seen.append({"observation": observation, "action": action, **public(env, info)})
    return seen


@pytest.mark.parametrize("deterministic", [True, False])
def test_traffic_does_not_show_through_a_trained_policy(trained, deterministic):
    action, path = trained
    env = blind(make_private(action=action))
    policy = load_policy(path, env)
    first, second = (transcript(env, seed, policy, deterministic) for seed in (0, 1))
    assert same(first, second)
    assert not np.array_equal(first[1]["observation"], first[-1]["observation"])


def test_a_policy_that_sees_the_truth_would_show(trained):
    action, path = trained
    env = blind(make_private(action=action))
    policy = load_policy(path, env)
    interface = env.unwrapped.interface

    def knowing(observation, deterministic):
        density = env.unwrapped.process.truth(np.array([0]))[:, :15, 0]
        crowded = density.argsort(axis=1).argsort(axis=1) >= 15 - interface.bandwidth
        return interface.actions.encode(crowded, env.unwrapped.process.pending.picked)[0], None

    policy.predict = knowing
    assert not same(transcript(env, 0, policy, False), transcript(env, 1, policy, False))
