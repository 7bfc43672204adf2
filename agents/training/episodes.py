"""`TrainingEpisodes`: episodes spread over time, in groups that share traffic and noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from agents.seeds import training_seed
from agents.training.plan import TrainingPlan, World
from dptse_env.sb3 import SB3VecEnv
from dptse_env.utils.arrays import Observation


class TrainingEpisodes(VecEnvWrapper):
    """An `SB3VecEnv` for training.

    **Spread over time.** Episodes of equal length that begin together would always be in the same
    phase. In their first round, episode i of n is therefore restarted after i/n of its length, so
    that from then on an update sees every second of the records. All later episodes run to their
    end, from the first second on: an episode that began in the middle of a record would meet
    vehicles without any previous contribution (`dptse_env.release.vehicles`), as no
    evaluated episode does.

    **Replicas.** Each group of ``replicas`` episodes has the same traffic and the same noise at
    every second, whatever it queries (common random numbers). The outcome of a replica does not
    depend on the actions of the others in its group, so their mean advantage is a baseline that
    leaves the policy gradient unbiased and removes the common effect of traffic and noise
    (`recentre`).
    """

    def __init__(self, venv: SB3VecEnv, first_seed: int, replicas: int = 1) -> None:
        """Wrap ``venv``; group k of episodes draws from ``first_seed`` + k.

        Raises:
            ValueError: The number of episodes is no multiple of ``replicas``.
        """
        super().__init__(venv)
        if venv.num_envs % replicas:
            raise ValueError(
                f"episodes must be a multiple of replicas {replicas}, got {venv.num_envs}"
            )
        self.env = venv.env
        group = np.arange(venv.num_envs) // replicas
        self._seeds_of_episodes = (first_seed + group).tolist()
        # Where decisions take different numbers of actions, that of the longest episode.
        length = self.env.config.horizon_steps * self.env.interface.actions.actions_per_step
        self._breaks = group * replicas * length // venv.num_envs
        self._clock = 0

    def reset(self) -> Observation:
        """Begin all episodes anew from the first seed."""
        self._clock = 0
        observation, _ = self.env.reset(seed=self._seeds_of_episodes)
        return observation

    def step_wait(self) -> VecEnvStepReturn:
        """Return what `SB3VecEnv` does; begin the episodes anew whose first round ends here."""
        observation, rewards, dones, infos = self.venv.step_wait()
        self._clock += 1
        due = (self._breaks == self._clock) & ~dones
        if due.any():
            for episode in np.flatnonzero(due):
                infos[episode]["terminal_observation"] = np.asarray(observation)[episode]
                infos[episode]["TimeLimit.truncated"] = True
            observation, _ = self.env.reset(options={"reset_mask": due})
        return observation, rewards, dones | due, infos


def recentre(advantages: NDArray[np.float32], replicas: int) -> None:
    """Subtract from each of the advantages (steps, n), in place, the mean of its replicas'."""
    if replicas > 1:
        groups = advantages.reshape(len(advantages), -1, replicas)
        rest = groups.sum(axis=2, keepdims=True) - groups
        groups -= rest / (replicas - 1)


def make_episodes(
    plan: TrainingPlan, world: World, keywords: Mapping[str, Any], update: int = 0
) -> TrainingEpisodes:
    """Make the episodes of a world that a plan trains on from an update on.

    ``keywords`` are further ones of the environment. Episodes of every update draw from other
    seeds.
    """
    algorithm = plan.algorithm
    n = world.part(algorithm.n_envs, algorithm.replicas)
    given = {**world.keywords, **keywords, "autoreset_mode": "SameStep"}
    first = training_seed(plan.seed) + update * n // algorithm.replicas
    return TrainingEpisodes(
        SB3VecEnv(gym.make_vec(world.env, num_envs=n, **given)), first, algorithm.replicas
    )
