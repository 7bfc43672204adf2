"""Builds the learner of a recipe: its environment and its model of stable-baselines3."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from agents.experiments.seeds import training_seed
from agents.training.episodes import TrainingEpisodes
from agents.training.recipes import MaskablePPORecipe, PlackettLuceRecipe, Recipe
from dptse_env.sb3 import PlackettLucePolicy, RoadChannels, SB3VecEnv
from dptse_env.sb3.saved import ActingPolicy


def make_episodes(
    env: str, keywords: Mapping[str, Any], recipe: Recipe, seed: int
) -> TrainingEpisodes:
    """Make the episodes that a recipe trains on.

    Raises:
        ValueError: A keyword is unknown or out of range.
    """
    made = gym.make_vec(
        env,
        num_envs=recipe.n_envs,
        **{
            **keywords,
            "autoreset_mode": "SameStep",
            "action": recipe.action,
            "truth_in_info": recipe.shows_errors,
        },
    )
    return TrainingEpisodes(
        SB3VecEnv(made),
        training_seed(seed),
        twins=recipe.twins,
        reward_scale=recipe.reward_scale,
        shows_errors=recipe.shows_errors,
    )


def make_model(recipe: Recipe, episodes: TrainingEpisodes, seed: int) -> OnPolicyAlgorithm:
    """Make the model; draws and first weights follow ``seed``."""
    per_step = episodes.env.interface.actions.actions_per_step
    keywords: dict[str, Any] = {
        "n_steps": recipe.n_steps,
        "batch_size": recipe.batch_size,
        "n_epochs": recipe.n_epochs,
        "learning_rate": recipe.schedule(),
        "gamma": recipe.gamma ** (1 / per_step),
        "gae_lambda": recipe.gae_lambda ** (1 / per_step),
        "clip_range": recipe.clip_range,
        "target_kl": recipe.target_kl,
        "ent_coef": recipe.ent_coef,
        "vf_coef": recipe.vf_coef,
        "max_grad_norm": recipe.max_grad_norm,
        "policy_kwargs": recipe.policy_keywords(),
        "seed": seed,
        "device": "cpu",
    }
    model: OnPolicyAlgorithm
    if isinstance(recipe, PlackettLuceRecipe):
        keywords["policy_kwargs"]["road"] = RoadChannels.of(episodes.env.config)
        model = PPO(PlackettLucePolicy, episodes, **keywords)
    elif isinstance(recipe, MaskablePPORecipe):
        model = MaskablePPO("MlpPolicy", episodes, **keywords)
    else:
        model = PPO("MlpPolicy", episodes, **keywords)
    model.set_logger(Logger(None, []))
    return model


def acting(model: OnPolicyAlgorithm, episodes: TrainingEpisodes) -> ActingPolicy:
    """Return what acts as ``model`` does now, by plain observations alone."""
    interface = episodes.env.interface
    policy: BasePolicy = model.policy
    if isinstance(policy, PlackettLucePolicy):
        # Weights that are overwritten at once must not move the generator of the training.
        with torch.random.fork_rng(devices=[]):
            policy = policy.without_extra(interface.observations.space)
    return ActingPolicy(policy, interface)
