"""PPO and MaskablePPO as stable-baselines3 and sb3-contrib run them, with our curve and folder."""

from __future__ import annotations

import math
from typing import Any

from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import VecMonitor

from agents.training.episodes import make_episodes, recentre
from agents.training.plan import PPOSettings
from agents.training.run import POLICY, Run

CLASSES: dict[str, Any] = {"ppo": PPO, "maskable-ppo": MaskablePPO}
"""Classes of algorithms by their names."""


COLUMNS = (
    "validation", "validation_drawn", "learning_rate", "approx_kl", "clip_fraction",
    "entropy_loss", "explained_variance", "value_loss",
)  # fmt: skip
"""Columns of the curve that come from the log of stable-baselines3, beside the error."""


def train_by_ppo(run: Run) -> None:
    """Train to the end of the plan, from the last checkpoint on if there is one.

    A training that goes on has the weights and the optimizer of its checkpoint, and new episodes:
    its numbers are not those of one that was never interrupted.

    Raises:
        OSError: The disk is full or cannot be written; the last checkpoint stays.
    """
    plan, kept = run.plan, run.checkpoint or {"update": 0}
    ppo = plan.algorithm
    assert isinstance(ppo, PPOSettings)
    done: int = kept["update"]
    episodes = make_episodes(plan, plan.worlds[0], run.keywords, done)
    per_second, first, last = plan.actions_per_step, ppo.learning_rate, ppo.final_learning_rate
    model = CLASSES[ppo.name](
        "MlpPolicy",
        VecMonitor(episodes),
        n_steps=ppo.n_steps * per_second,
        batch_size=ppo.batch_size,
        n_epochs=ppo.n_epochs,
        learning_rate=lambda left: last + (first - last) * left,
        gamma=ppo.gamma ** (1 / per_second),
        gae_lambda=ppo.gae_lambda ** (1 / per_second),
        ent_coef=ppo.ent_coef,
        policy_kwargs={"net_arch": list(ppo.hidden)},
        seed=plan.seed + 1000 * done,
        device="cpu",
    )
    if "parameters" in kept:
        model.set_parameters(kept["parameters"])
        model.num_timesteps = done * model.n_steps * model.n_envs
    if done < ppo.n_updates:
        follow = _Follow(run, ppo, done)
        model.set_logger(Logger(None, [follow]))
        steps = (ppo.n_updates - done) * model.n_steps * model.n_envs
        model.learn(steps, callback=follow, reset_num_timesteps=False)
    run.save(POLICY, model.policy, run.rows[-1])


class _Follow(BaseCallback, KVWriter):
    """Compares replicas, validates, keeps checkpoints, and adds what is logged to the curve."""

    def __init__(self, run: Run, ppo: PPOSettings, done: int) -> None:
        super().__init__()
        self._run, self._ppo, self._update = run, ppo, done - 1

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Add a row: what the last update left, the errors of its policy, the next episodes."""
        del key_excluded, step
        logged = {key.partition("/")[2] or key: float(value) for key, value in key_values.items()}
        row = {key: logged[key] for key in COLUMNS if math.isfinite(logged.get(key, math.nan))}
        if "ep_rew_mean" in logged:
            mean = logged["ep_rew_mean"] / logged["ep_len_mean"]
            row["error"] = -mean * self._run.plan.actions_per_step
        self._run.add(self._update, self._steps, row)

    def close(self) -> None:
        """Do nothing; see `KVWriter`."""

    @property
    def _steps(self) -> int:
        return self._update * self._ppo.n_envs * self._ppo.n_steps

    def _on_rollout_start(self) -> None:
        # Another update is done, but ahead of the first rollout.
        self._update += 1
        if self._update % self._ppo.validate_every == 0:
            self._validate()
            self._keep()

    def _on_rollout_end(self) -> None:
        recentre(self.locals["rollout_buffer"].advantages, self._ppo.replicas)

    def _on_training_end(self) -> None:
        self._update += 1
        self._validate()
        self.logger.dump()
        self._keep()

    def _on_step(self) -> bool:
        return True

    def _validate(self) -> None:
        for name, error in self._run.validate([self.model.policy], self._steps).items():
            self.logger.record(name, error)

    def _keep(self) -> None:
        self._run.keep(update=self._update, parameters=self.model.get_parameters())
