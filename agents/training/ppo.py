"""`PPOLearner`: PPO of stable-baselines3, resumable to the same numbers."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from agents.training.episodes import TrainingEpisodes, make_episodes
from agents.training.learner import Record
from agents.training.plan import TrainingPlan
from agents.training.recipes import MaskablePPORecipe, PPORecipe

_LOGGED = {
    "learning_rate": "train/learning_rate",
    "kl": "train/approx_kl",
    "clipped": "train/clip_fraction",
    "entropy": "train/entropy_loss",
    "explained_variance": "train/explained_variance",
    "value_loss": "train/value_loss",
}
"""Columns of the learning curve, and the names under which stable-baselines3 logs them."""


class PPOLearner:
    """Trains a perceptron by PPO or MaskablePPO; see `agents.training.learner.Learner`.

    Attributes:
        model: The algorithm of stable-baselines3.
    """

    def __init__(self, plan: TrainingPlan, recipe: PPORecipe, keywords: Mapping[str, Any]) -> None:
        """Make the episodes and an untrained model.

        ``keywords`` are further ones of the environment.
        """
        self._plan, self._recipe, self._is_begun = plan, recipe, False
        self._episodes = make_episodes(
            plan.env,
            {**plan.keywords, **keywords},
            recipe,
            plan.seed,
            reward_scale=recipe.reward_scale,
        )
        self.model = _make_model(recipe, self._episodes, plan.seed)

    @property
    def policy(self) -> BasePolicy:
        """The policy of the model."""
        policy: BasePolicy = self.model.policy
        return policy

    @property
    def policies(self) -> tuple[BasePolicy, ...]:
        """The policy alone: a perceptron is tied to its environment."""
        return (self.policy,)

    @property
    def update(self) -> int:
        """Number of updates that are done."""
        return self.model.num_timesteps // self._recipe.steps_per_update

    def train(self, record: Record) -> None:
        """See `Learner`."""
        if not self._is_begun:
            record(0.0, {})
        left = self._plan.n_updates - self.update
        if left > 0:
            callback = _Updates(self, record)
            steps = left * self._recipe.steps_per_update
            never = left + 1  # the learning curve takes the place of the log
            self.model.learn(
                steps, callback=callback, log_interval=never, reset_num_timesteps=False
            )

    def state(self) -> dict[str, Any]:
        """See `Learner`."""
        model = self.model
        name, keys, *position = np.random.get_state()  # noqa: NPY002  stable-baselines3 draws there
        assert isinstance(name, str)
        # The first update begins the episodes; ahead of it there is nothing to keep of them.
        episodes = self._episodes.state() if model.num_timesteps else {}
        starts = model._last_episode_starts if model.num_timesteps else None
        return {
            "steps": model.num_timesteps,
            "n_updates": model._n_updates,
            "policy": model.policy.state_dict(),
            "optimizer": model.policy.optimizer.state_dict(),
            "numpy": [torch.from_numpy(np.asarray(keys).astype(np.int64)), *position],
            "starts": torch.from_numpy(np.ones(0, dtype=bool) if starts is None else starts),
            "episodes": {key: torch.from_numpy(value) for key, value in episodes.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """See `Learner`."""
        model, self._is_begun = self.model, True
        model.policy.load_state_dict(state["policy"])
        model.policy.optimizer.load_state_dict(state["optimizer"])
        model.num_timesteps, model._n_updates = state["steps"], state["n_updates"]
        if state["steps"]:
            episodes = {key: value.numpy() for key, value in state["episodes"].items()}
            model._last_obs = self._episodes.restore(episodes)
            model._last_episode_starts = state["starts"].numpy()
        keys, *position = state["numpy"]
        np.random.set_state(("MT19937", keys.numpy().astype(np.uint32), *position))  # noqa: NPY002

    def recentre(self, advantages: Any) -> None:
        """Compare the advantages of a rollout (steps, n), in place, between replicas."""
        self._episodes.recentre(advantages)

    def values(self) -> dict[str, float]:
        """Return the values of the last update for the learning curve."""
        logged = self.model.logger.name_to_value
        values = {name: float(logged[key]) for name, key in _LOGGED.items()}
        return {"error": -self._episodes.take_mean_reward(), **values}


class _Updates(BaseCallback):
    """Records every update, between two of them, when all episodes stand still."""

    def __init__(self, learner: PPOLearner, record: Record) -> None:
        super().__init__()
        self._learner, self._record, self._since = learner, record, time.perf_counter()
        self._is_first = True

    def _on_rollout_start(self) -> None:
        # The first rollout follows no update of this call.
        if not self._is_first:
            self._note()
        self._is_first = False

    def _on_rollout_end(self) -> None:
        self._learner.recentre(self.locals["rollout_buffer"].advantages)

    def _on_training_end(self) -> None:
        self._note()

    def _on_step(self) -> bool:
        return True

    def _note(self) -> None:
        now = time.perf_counter()
        self._record(now - self._since, self._learner.values())
        self._since = time.perf_counter()


def _make_model(recipe: PPORecipe, episodes: TrainingEpisodes, seed: int) -> OnPolicyAlgorithm:
    """Make the model; draws and initial weights follow ``seed``."""
    per_step = episodes.env.interface.actions.actions_per_step
    algorithm: type[OnPolicyAlgorithm] = PPO
    if isinstance(recipe, MaskablePPORecipe):
        algorithm = MaskablePPO
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
        "policy_kwargs": {"net_arch": list(recipe.hidden)},
        "seed": seed,
        "device": "cpu",
    }
    model = algorithm("MlpPolicy", episodes, **keywords)
    model.set_logger(Logger(None, []))
    return model
