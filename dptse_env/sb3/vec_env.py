"""`SB3VecEnv`: many episodes of one process as an environment of stable-baselines3."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from dptse_env.utils.arrays import Action, Observation
from dptse_env.utils.vector_info import row_of
from dptse_env.vector_env import SensorQueryVectorEnv

_MASKS = "action_masks"


class SB3VecEnv(VecEnv):
    """A `SensorQueryVectorEnv` with the interface of stable-baselines3.

    An episode that ends is replaced by a new one in the same step: the observation is the first of
    the new episode, and ``infos[i]`` has ``terminal_observation``, ``TimeLimit.truncated`` and the
    info of the scalar environment at the end. For episodes that continue, ``infos[i]`` is empty.
    Numbers, seeds and options are those of ``DummyVecEnv`` over as many scalar environments.

    ``env_method("action_masks")`` returns the masks of sequential actions, as MaskablePPO needs
    them.

    Example::

        env = gymnasium.make_vec(
            "dptse_env:dptse/PaperHighway-v0", num_envs=64, autoreset_mode="SameStep"
        )
        model = PPO("MlpPolicy", VecMonitor(SB3VecEnv(env)))
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        """Wrap a `SensorQueryVectorEnv` without wrappers, made with ``autoreset_mode="SameStep"``.

        Raises:
            ValueError: The environment is of another class, or has another autoreset mode.
        """
        if not isinstance(env, SensorQueryVectorEnv):
            raise ValueError(
                f"env must be a bare SensorQueryVectorEnv, got {env}; wrap the SB3VecEnv in "
                "wrappers of stable-baselines3 instead"
            )
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"env must be made with autoreset_mode='{AutoresetMode.SAME_STEP.value}', since "
                "stable-baselines3 expects a new episode in the step in which one ends; "
                f"got '{env.autoreset_mode.value}'"
            )
        self.env = env
        self._actions: Action | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Observation:
        """Begin all episodes, with the seeds and options that were set; return (n, size).

        Raises:
            ValueError: An option is unknown or out of range.
        """
        if any("reset_mask" in options for options in self._options):
            raise ValueError("options.reset_mask is not for an SB3VecEnv: reset() begins all")
        distinct = [o for i, o in enumerate(self._options) if o not in self._options[:i]]
        observation = np.empty(0, dtype=np.float32)
        for options in distinct:
            mask = np.array([other == options for other in self._options])
            observation, _ = self.env.reset(
                seed=self._seeds, options={**options, "reset_mask": mask}
            )
        self._note_resets(range(self.num_envs))
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: Action) -> None:
        """Store the actions, shape (n, *action space), until `step_wait` executes them."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Return observations (n, size), rewards (n,), dones (n,) and n infos."""
        if self._actions is None:
            raise RuntimeError("no actions: call step_async() before step_wait()")
        transition = self.env.advance(self._actions)
        self._actions = None
        # One dict each: wrappers and callbacks write into them.
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        final = transition.final
        if final is not None:
            for k, episode in enumerate(final.episodes):
                infos[episode].update(row_of(final.infos, k))
                infos[episode]["terminal_observation"] = final.observation[k].copy()
                infos[episode]["TimeLimit.truncated"] = True
            self._note_resets(final.episodes)
        reward = transition.reward.astype(np.float32)
        return transition.observation, reward, transition.truncated, infos

    def close(self) -> None:
        """Close the environment; closing it again does nothing."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute as each of the scalar environments would return it.

        Raises:
            AttributeError: There is none; `action_masks` exists for sequential actions only.
        """
        episodes = list(self._get_indices(indices))
        if attr_name == _MASKS:
            try:
                self.env.interface.require_sequential()
            except ValueError as problem:
                raise AttributeError(str(problem)) from problem
            return [lambda e=e: self.env.action_masks()[e] for e in episodes]
        if attr_name in ("action_space", "observation_space"):
            return [getattr(self, attr_name)] * len(episodes)
        if attr_name in ("np_random", "np_random_seed"):
            return [getattr(self.env, attr_name)[e] for e in episodes]
        return [getattr(self.env, attr_name)] * len(episodes)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raise ``AttributeError``: the episodes share one environment."""
        raise AttributeError(
            f"{attr_name} cannot be set: the episodes share one environment; make another one"
        )

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Return the masks of sequential actions, each of shape (n_options,), for `action_masks`.

        Raises:
            AttributeError: The method is another one, or the actions are not sequential.
        """
        if method_name != _MASKS:
            raise AttributeError(
                f"env_method knows {_MASKS}, got {method_name!r}: the episodes share one "
                "environment, use its methods"
            )
        self.get_attr(_MASKS, indices)
        masks = self.env.action_masks()
        return [masks[e] for e in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each: scalar wrappers have nothing to wrap here."""
        return [False for _ in self._get_indices(indices)]

    def _note_resets(self, episodes: Sequence[int] | NDArray[np.int64] | range) -> None:
        """Store the infos of resets where stable-baselines3 looks for them."""
        rows = self.env.process.infos(np.asarray(episodes))
        at_reset = self.env.process.reset_info()
        for k, episode in enumerate(episodes):
            self.reset_infos[episode] = {**row_of(rows, k), **at_reset}
