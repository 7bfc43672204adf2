"""`TrainingEpisodes`: episodes spread over time, whose state can be kept in a few kilobytes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from agents.training.truth import TrueErrors
from dptse_env.arrays import Action, BoolArray, Observation
from dptse_env.sb3 import SB3VecEnv

State = dict[str, np.ndarray[Any, Any]]


class TrainingEpisodes(VecEnvWrapper):
    """An `SB3VecEnv` for training.

    **Spread.** Episodes of equal length that begin together would all see the same hour. In their
    first round, episode i of n is begun again after i/n of its length, so that from then on an
    update sees every second of the records. All later episodes run their whole length, from the
    first second on: one begun in the middle of a record would meet vehicles none of which has
    counted yet (`dptse_env.contributions`), which no evaluated episode does.

    **Kept.** Traffic is replayed and every draw is seeded, so an episode is given by its seed and
    the actions since it began. `state` is those; `restore` repeats them, which takes as long as
    the longest episode has lasted and gives the same bits.

    **Twins.** Each group of ``twins`` episodes has the same traffic and the same noise at every
    second, whatever it asks. What happens to a twin does not depend on the actions of the others,
    so the mean advantage of the others is a baseline that leaves the policy gradient unbiased
    and takes away what traffic and noise do to all of them (`recentre`).

    **Truth for the critic.** With ``shows_errors``, observations are followed by the true errors of
    every mainline segment. `dptse_env.sb3.PlackettLucePolicy` gives them to its critic alone,
    which is left behind when the training ends.

    **Scaled.** Rewards are multiplied by a constant.
    """

    def __init__(
        self,
        venv: SB3VecEnv,
        first_seed: int,
        *,
        twins: int = 1,
        reward_scale: float = 1.0,
        shows_errors: bool = False,
    ) -> None:
        """Wrap ``venv``; group k of episodes draws from ``first_seed`` + k.

        Raises:
            ValueError: The number of episodes is no multiple of ``twins``, or errors are to be
                shown and the environment does not have ``truth_in_info``.
        """
        super().__init__(venv)
        if shows_errors and not venv.env.config.truth_in_info:
            raise ValueError("shows_errors needs an environment with truth_in_info=True")
        self._errors = TrueErrors(venv.env.config, venv.env.interface) if shows_errors else None
        if self._errors is not None:
            self.observation_space = self._errors.space()
        if venv.num_envs % twins:
            raise ValueError(
                f"episodes must be a multiple of twins {twins}, got {venv.num_envs} episodes"
            )
        self.env, self.twins, self.reward_scale = venv.env, twins, reward_scale
        group = np.arange(venv.num_envs) // twins
        self._seeds_of_all = (first_seed + group).tolist()
        self._length = self.env.config.horizon_steps * self.env.interface.actions.actions_per_step
        n = self.num_envs
        self._breaks = group * twins * self._length // n
        shape = self.action_space.shape or ()
        self._kept = np.zeros((self._length, n, *shape), dtype=self.action_space.dtype)
        self._count = np.zeros(n, dtype=np.int64)
        self._position = np.zeros(n, dtype=np.int64)
        self._clock = 0
        self._total, self._n_seconds = 0.0, 0

    def reset(self) -> Observation:
        """Begin all episodes anew from the first seed."""
        observation, _ = self.env.reset(seed=self._seeds_of_all)
        self._clock = 0
        self._count[:], self._position[:] = 1, 0
        return self._shown(observation)

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
        # An unfinished sequential decision is paid nothing; an error is never exactly zero.
        self._n_seconds += int(np.count_nonzero(rewards))
        if self._errors is not None:
            for episode in np.flatnonzero(dones):
                info = infos[episode]
                truth = (info["truth"][name][None] for name in ("density", "speed"))
                last = info["terminal_observation"][None]
                info["terminal_observation"] = self._errors.append(last, *truth)[0]
        due = (self._breaks == self._clock) & ~dones
        if due.any():
            before = self._shown(observation)
            for episode in np.flatnonzero(due):
                infos[episode]["terminal_observation"] = before[episode]
                infos[episode]["TimeLimit.truncated"] = True
            observation, _ = self.env.reset(options={"reset_mask": due})
            dones = dones | due
        self._count[dones] += 1
        self._position[dones] = 0
        return self._shown(observation), rewards * np.float32(self.reward_scale), dones, infos

    def take_mean_reward(self) -> float:
        """Return the mean unscaled reward of a second since the last call; NaN if none passed."""
        mean = self._total / self._n_seconds if self._n_seconds else float("nan")
        self._total, self._n_seconds = 0.0, 0
        return mean

    def recentre(self, advantages: NDArray[np.float32]) -> None:
        """Subtract from advantages (steps, n), in place, the mean of each one's twins."""
        if self.twins > 1:
            groups = advantages.reshape(len(advantages), -1, self.twins)
            others = groups.sum(axis=2, keepdims=True) - groups
            groups -= others / (self.twins - 1)

    def state(self) -> State:
        """Return what `restore` needs: which episode each is at, and its actions so far."""
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
        observation, _ = self.env.reset(seed=self._seeds_of_all)
        # Earlier episodes only move the generators on: each takes the same few draws.
        for earlier in range(2, int(count.max())):
            observation = self._begin(count > earlier, observation)
        for k in range(longest):
            # Whoever begins later idles until then, so that all end together.
            start = longest - position
            observation = self._begin(again & (start == k), observation)
            rows = np.maximum(k - start, 0)
            observation = self.env.advance(actions[rows, np.arange(self.num_envs)]).observation
        observation = self._begin(again & (position == 0), observation)
        self._count, self._position = count.copy(), position.copy()
        self._clock = int(state["clock"])
        self._kept[:longest] = actions
        return self._shown(observation)

    def _shown(self, observation: Observation) -> Observation:
        """Return observations as the model is to see them."""
        if self._errors is None:
            return observation
        truth = self.env.process.truth(np.arange(self.num_envs))
        return self._errors.append(observation, truth[:, :, 0], truth[:, :, 1])

    def _begin(self, mask: BoolArray, observation: Observation) -> Observation:
        """Begin the episodes of ``mask``, if any; return all observations."""
        if not mask.any():
            return observation
        return self.env.reset(options={"reset_mask": mask})[0]
