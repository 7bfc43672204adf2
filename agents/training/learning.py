"""Training by an algorithm of stable-baselines3 or sb3-contrib, as they come."""

from __future__ import annotations

import math
import sys
from typing import Any, cast

import gymnasium as gym
import torch
from sb3_contrib import QRDQN, MaskablePPO, RecurrentPPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from agents.seeds import training_seed
from agents.training.run import Run
from agents.training.settings import (
    DQNSettings,
    LearnerSettings,
    PPOSettings,
    QRDQNSettings,
    RecurrentPPOSettings,
)
from dptse_env.policies import read_policy
from dptse_env.sb3 import ReplicaBaseline, RoadPolicy, SB3VecEnv

CLASSES: dict[str, Any] = {
    "ppo": PPO,
    "maskable-ppo": MaskablePPO,
    "recurrent-ppo": RecurrentPPO,
    "dqn": DQN,
    "qr-dqn": QRDQN,
}
"""Classes of algorithms by their names."""

PASSED = (
    "batch_size", "gamma", "n_steps", "n_epochs", "gae_lambda", "buffer_size", "learning_starts",
    "train_freq", "gradient_steps", "target_update_interval",
)  # fmt: skip
"""Hyperparameters that these take as they are."""


def learn(run: Run) -> None:
    """Train to the end of the plan, from the last checkpoint on if there is one.

    A training that goes on has the weights, the optimizer and the statistics of its checkpoint, and
    new episodes: its numbers are not those of one that was never interrupted.

    Raises:
        OSError: The disk is full or cannot be written; the last checkpoint stays.
    """
    plan, settings, kept = run.plan, run.plan.algorithm, run.checkpoint
    assert isinstance(settings, LearnerSettings)
    if kept is not None and run.done(run.steps) >= 1.0:
        return
    world, per_second = plan.worlds[0], plan.actions_per_step
    most = min(world.config.horizon_steps, world.config.corridor.conditions.duration // 2)
    episode = {"horizon": min(settings.horizon, most), "random_start": True}
    given = {**world.keywords, **run.keywords, **episode}
    episodes = SB3VecEnv(
        gym.make_vec(world.env, num_envs=settings.n_envs, **given, autoreset_mode="SameStep"),
        settings.replicas,
    )
    # Errors are hundredths: a critic needs them scaled.
    env = VecNormalize(
        VecMonitor(episodes),
        norm_obs=settings.policy == "mlp",
        gamma=settings.gamma ** (1 / per_second),
    )
    follow = Follow(run, settings, env)
    name, arguments = _network(run, settings, episodes)
    model = CLASSES[settings.name](
        name,
        env,
        learning_rate=lambda _: follow.rate,
        policy_kwargs=arguments,
        # Episodes of a training that goes on are others.
        seed=training_seed(plan.seed) + len(run.rows) * settings.n_envs,
        device="cpu",
        **_arguments(settings, per_second),
    )
    if isinstance(settings, DQNSettings):
        model.exploration_schedule = lambda _: follow.exploration
    if kept is not None:
        model.set_parameters(kept["parameters"])
        model.num_timesteps = kept["actions"]
        for part, numbers in kept["statistics"].items():
            for each, value in numbers.items():
                setattr(getattr(env, part), each, value.numpy())
    elif plan.initial is not None:
        weights = read_policy(plan.initial).weights
        # The critic is in no file.
        tensors = {key: torch.tensor(value) for key, value in weights.items()}
        model.policy.load_state_dict(tensors, strict=False)
    model.set_logger(Logger(None, [follow]))
    callbacks: list[BaseCallback] = [follow]
    if isinstance(settings, PPOSettings) and settings.replicas > 1:
        callbacks.append(ReplicaBaseline(settings.replicas))
    # The plan ends it, by time or by steps, and validations ask for the log.
    model.learn(sys.maxsize, callbacks, log_interval=None, reset_num_timesteps=False)


def _arguments(settings: LearnerSettings, per_second: int) -> dict[str, Any]:
    """Return keyword arguments of a class, whose steps are actions: so many are of a second."""
    given = {name: getattr(settings, name) for name in PASSED if hasattr(settings, name)}
    for name in {"gamma", "gae_lambda"} & set(given):
        given[name] **= 1 / per_second
    if isinstance(settings, PPOSettings):
        given["n_steps"] *= per_second
    return given


def _network(
    run: Run, settings: LearnerSettings, episodes: SB3VecEnv
) -> tuple[Any, dict[str, Any]]:
    """Return the class of a policy, or its name in stable-baselines3, and its arguments."""
    if settings.policy == "road":
        sizes: dict[str, Any] = {}
        if run.plan.initial is not None:
            sizes = read_policy(run.plan.initial).card["policy"]["arguments"]
        return RoadPolicy, {**RoadPolicy.kwargs(episodes), **sizes}
    layers = {"net_arch": list(settings.hidden)}
    if isinstance(settings, RecurrentPPOSettings):
        return "MlpLstmPolicy", {**layers, "lstm_hidden_size": settings.lstm}
    if isinstance(settings, QRDQNSettings):
        return "MlpPolicy", {**layers, "n_quantiles": settings.quantiles}
    return "MlpPolicy", layers


class Follow(BaseCallback, KVWriter):
    """Ends a training, validates, keeps checkpoints, and adds what is logged to the curve.

    The schedules of stable-baselines3 go by a number of steps that is known ahead, and its
    `EvalCallback` plays episodes from their first second on: neither serves a training of some
    minutes whose errors are those of `dptse evaluate`.

    Attributes:
        done: Fraction of the training that is done.
    """

    def __init__(self, run: Run, settings: Any, env: VecNormalize) -> None:
        """Take a run, the settings of its algorithm, and what it trains in."""
        super().__init__()
        self._run, self._settings, self._env = run, settings, env
        self.done = run.done(run.steps)

    @property
    def rate(self) -> float:
        """The learning rate."""
        settings = self._settings
        return self._between(settings.learning_rate, settings.final_learning_rate)

    @property
    def exploration(self) -> float:
        """The rate of random actions of DQN."""
        settings = self._settings
        left = 1.0 - min(self.done / settings.exploration, 1.0)
        rate: float = settings.final_exploration + (1.0 - settings.final_exploration) * left
        return rate

    def _between(self, first: float, last: float) -> float:
        return first + (last - first) * self.done

    @property
    def _steps(self) -> int:
        return int(self.model.num_timesteps // self._run.plan.actions_per_step)

    def _on_rollout_start(self) -> None:
        self.done, model = self._run.done(self._steps), cast(Any, self.model)
        if isinstance(self._settings, PPOSettings):
            first, last = self._settings.ent_coef, self._settings.final_ent_coef
            model.ent_coef = self._between(first, last)
        if self.done >= min(len(self._run.rows) / self._settings.validations, 1.0):
            model.dump_logs()
        self._run.show(self._steps)

    def _on_step(self) -> bool:
        return self.done < 1.0

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Add a row: what was logged, and the errors of the policy. Keep both, and the policy."""
        del key_excluded, step
        row = {}
        for key, value in key_values.items():
            group, _, name = key.partition("/")
            if group in ("train", "rollout") and math.isfinite(value):
                row[name] = float(value)
        run, parts = self._run, ("obs_rms", "ret_rms") if self._env.norm_obs else ("ret_rms",)
        row |= run.validate([self.model.policy], self._steps, self._env)
        run.add(self._steps, row)
        run.keep(
            parameters=self.model.get_parameters(),
            actions=self.model.num_timesteps,
            statistics={
                part: {
                    name: torch.as_tensor(value)
                    for name, value in vars(getattr(self._env, part)).items()
                }
                for part in parts
            },
        )

    def close(self) -> None:
        """Do nothing; see `KVWriter`."""
