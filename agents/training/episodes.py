"""`TrainingEpisodes`: episodes spread over time, whose state can be kept in a few kilobytes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from agents.seeds import training_seed
from agents.training.recipes import Recipe
from dptse_env.sb3 import SB3VecEnv
from dptse_env.utils.arrays import Action, BoolArray, Observation

State = dict[str, np.ndarray[Any, Any]]


class TrainingEpisodes(VecEnvWrapper):
    """An `SB3VecEnv` for training.

    **Spread over time.** Episodes of equal length that begin together would always be in the same
    phase. In their first round, episode i of n is therefore restarted after i/n of its length, so
    that from then on an update sees every second of the records. All later episodes run to their
    end, from the first second on: an episode that began in the middle of a record would meet
    vehicles without any previous contribution (`dptse_env.release.vehicles`), as no
    evaluated episode does.

    **Resumable.** Traffic is replayed and every draw is seeded, so an episode is given by its seed
    and its actions so far. `state` returns those; `restore` repeats them, which takes as long as
    the longest episode has lasted and gives the same bits.

    **Replicas.** Each group of ``replicas`` episodes has the same traffic and the same noise at
    every second, whatever it queries (common random numbers). The outcome of a replica does not
    depend on the actions of the others in its group, so their mean advantage is a baseline that
    leaves the policy gradient unbiased and removes the common effect of traffic and noise
    (`recentre`).

    **Scaled.** Rewards are multiplied by a constant.
    """

    def __init__(
        self, venv: SB3VecEnv, first_seed: int, *, replicas: int = 1, reward_scale: float = 1.0
    ) -> None:
        """Wrap ``venv``; group k of episodes draws from ``first_seed`` + k.

        Raises:
            ValueError: The number of episodes is no multiple of ``replicas``.
        """
        super().__init__(venv)
        if venv.num_envs % replicas:
            raise ValueError(
                f"episodes must be a multiple of replicas {replicas}, got {venv.num_envs}"
            )
        self.env, self.replicas, self.reward_scale = venv.env, replicas, reward_scale
        group = np.arange(venv.num_envs) // replicas
        self._episode_seeds = (first_seed + group).tolist()
        # Where decisions take different numbers of actions, that of the longest episode.
        self._length = self.env.config.horizon_steps * self.env.interface.actions.actions_per_step
        n = self.num_envs
        self._breaks = group * replicas * self._length // n
        shape = self.action_space.shape or ()
        self._kept = np.zeros((self._length, n, *shape), dtype=self.action_space.dtype)
        self._count = np.zeros(n, dtype=np.int64)
        self._position = np.zeros(n, dtype=np.int64)
        self._clock = 0
        self._total, self._n_seconds = 0.0, 0

    def reset(self) -> Observation:
        """Begin all episodes anew from the first seed."""
        observation, _ = self.env.reset(seed=self._episode_seeds)
        self._clock = 0
        self._count[:], self._position[:] = 1, 0
        return observation

    def step_async(self, actions: Action) -> None:
        """Keep the actions and pass them on."""
        self._kept[self._position, np.arange(self.num_envs)] = actions
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Return what `SB3VecEnv` does, rewards scaled."""
        observation, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(observation, np.ndarray)
        self._clock += 1
        self._position += 1
        self._total += float(rewards.sum())
        # An unfinished sequential decision has no reward; an error is never exactly zero.
        self._n_seconds += int(np.count_nonzero(rewards))
        due = (self._breaks == self._clock) & ~dones
        if due.any():
            for episode in np.flatnonzero(due):
                infos[episode]["terminal_observation"] = observation[episode]
                infos[episode]["TimeLimit.truncated"] = True
            observation, _ = self.env.reset(options={"reset_mask": due})
            dones = dones | due
        self._count[dones] += 1
        self._position[dones] = 0
        return observation, rewards * np.float32(self.reward_scale), dones, infos

    def take_mean_reward(self) -> float:
        """Return the mean unscaled reward of a second since the last call; NaN if none passed."""
        mean = self._total / self._n_seconds if self._n_seconds else float("nan")
        self._total, self._n_seconds = 0.0, 0
        return mean

    def recentre(self, advantages: NDArray[np.float32]) -> None:
        """Subtract from each of the advantages (steps, n), in place, the mean of its replicas'."""
        if self.replicas > 1:
            groups = advantages.reshape(len(advantages), -1, self.replicas)
            rest = groups.sum(axis=2, keepdims=True) - groups
            groups -= rest / (self.replicas - 1)

    def state(self) -> State:
        """Return what `restore` needs: the number of each episode and its actions so far."""
        longest = int(self._position.max())
        return {
            "count": self._count.copy(),
            "position": self._position.copy(),
            "clock": np.array(self._clock),
            "actions": self._kept[:longest].copy(),
        }

    def restore(self, state: State) -> Observation:
        """Repeat the actions of ``state``; return the observations at its end, (n, size)."""
        count, position, actions = state["count"], state["position"], state["actions"]
        longest, again = len(actions), count > 1
        observation, _ = self.env.reset(seed=self._episode_seeds)
        # Earlier episodes only advance the generators: each takes the same few draws.
        for earlier in range(2, int(count.max())):
            observation = self._begin(count > earlier, observation)
        for k in range(longest):
            # Episodes with fewer actions idle at first, so that all end together.
            start = longest - position
            observation = self._begin(again & (start == k), observation)
            rows = np.maximum(k - start, 0)
            observation = self.env.advance(actions[rows, np.arange(self.num_envs)]).observation
        observation = self._begin(again & (position == 0), observation)
        self._count, self._position = count.copy(), position.copy()
        self._clock = int(state["clock"])
        self._kept[:longest] = actions
        return observation

    def _begin(self, mask: BoolArray, observation: Observation) -> Observation:
        """Begin the episodes of ``mask``, if any; return all observations."""
        if not mask.any():
            return observation
        return self.env.reset(options={"reset_mask": mask})[0]


def make_episodes(
    env: str,
    keywords: Mapping[str, Any],
    recipe: Recipe,
    seed: int,
    *,
    n_envs: int | None = None,
    reward_scale: float = 1.0,
) -> TrainingEpisodes:
    """Make the episodes that a recipe trains on with a training seed.

    ``n_envs`` is their number, that of the recipe if not given.

    Raises:
        ValueError: A keyword is unknown or out of range.
    """
    chosen = {"autoreset_mode": "SameStep", "action": recipe.action}
    made = gym.make_vec(env, num_envs=n_envs or recipe.n_envs, **{**keywords, **chosen})
    return TrainingEpisodes(
        SB3VecEnv(made), training_seed(seed), replicas=recipe.replicas, reward_scale=reward_scale
    )
