"""Episodes of one process for stable-baselines3: `SB3VecEnv`, `ReplicaBaseline`."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from dptse_env.config import EnvConfig
from dptse_env.utils.arrays import Action, Observation
from dptse_env.utils.validation import integer
from dptse_env.utils.vector_info import info_of
from dptse_env.vector_env import SensorQueryVectorEnv

_MASKS = "action_masks"


class SB3VecEnv(VecEnv):
    """A `SensorQueryVectorEnv` with the interface of stable-baselines3.

    An episode that ends is replaced by a new one in the same step: the observation is the first of
    the new episode, and ``infos[i]`` has ``terminal_observation``, ``TimeLimit.truncated`` and the
    info of the scalar environment at the end. For episodes that continue, ``infos[i]`` is empty.
    Numbers, seeds and options are those of ``DummyVecEnv`` over as many scalar environments.

    ``env_method("action_masks")`` returns the masks of actions, as MaskablePPO needs them.

    With ``replicas``, each group of that many consecutive episodes has the same traffic and noise
    at every second, whatever its episodes query, and ``seed(s)`` seeds group k with s + k; see
    `ReplicaBaseline`.

    Example::

        env = gymnasium.make_vec(
            "dptse_env:dptse/PaperHighway-v0", num_envs=64, autoreset_mode="SameStep"
        )
        model = PPO("MlpPolicy", VecMonitor(SB3VecEnv(env)))
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], replicas: int = 1) -> None:
        """Wrap a `SensorQueryVectorEnv` without wrappers, made with ``autoreset_mode="SameStep"``.

        Args:
            env: The environment of n episodes.
            replicas: Episodes of the same traffic and noise, a divisor of n.

        Raises:
            ValueError: The environment is of another class, or has another autoreset mode; or it
                cannot have that many replicas.
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
        self.replicas = integer("replicas", replicas, 1, env.num_envs)
        if env.num_envs % self.replicas:
            raise ValueError(f"replicas must divide {env.num_envs} episodes, got {replicas}")
        if self.replicas > 1 and env.config.privacy.noise == "secure":
            raise ValueError("replicas have the same noise, so privacy.noise must not be 'secure'")
        self.env = env
        self._actions: Action | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset, drawing a seed where None is given; return those of the episodes."""
        super().seed(seed)
        self._seeds = [self._seeds[i // self.replicas] for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> Observation:
        """Begin all episodes, with the seeds and options that were set; return (n, size).

        Raises:
            ValueError: An option is unknown or out of range.
        """
        if any("reset_mask" in options for options in self._options):
            raise ValueError("options.reset_mask is not for an SB3VecEnv: reset() begins all")
        if self.replicas > 1 and self._seeds[0] is None:
            # Not each one's own generator: replicas may have had different numbers of episodes.
            firsts = self.env.np_random[:: self.replicas]
            drawn = [int(generator.integers(2**32)) for generator in firsts]
            self._seeds = [drawn[i // self.replicas] for i in range(self.num_envs)]
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
                infos[episode].update(info_of(final.infos, k))
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
            AttributeError: There is none.
        """
        episodes = list(self._get_indices(indices))
        if attr_name == _MASKS:
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
        """Return the masks of actions, each of shape (m,), for `action_masks`.

        Raises:
            AttributeError: The method is another one.
        """
        if method_name != _MASKS:
            raise AttributeError(
                f"env_method knows {_MASKS}, got {method_name!r}: the episodes share one "
                "environment, use its methods"
            )
        masks = self.env.action_masks()
        return [masks[e] for e in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each: scalar wrappers have nothing to wrap here."""
        return [False for _ in self._get_indices(indices)]

    def _note_resets(self, episodes: Sequence[int] | NDArray[np.int64] | range) -> None:
        """Store the infos of resets where stable-baselines3 looks for them."""
        infos = self.env.process.infos(np.asarray(episodes))
        for k, episode in enumerate(episodes):
            self.reset_infos[episode] = info_of(infos, k)


def config_of(env: Any) -> EnvConfig:
    """Return the configuration of an environment of this package, however it is wrapped.

    Raises:
        ValueError: Another environment.
    """
    base = env.unwrapped
    config = getattr(base, "config", None) or getattr(getattr(base, "env", None), "config", None)
    if not isinstance(config, EnvConfig):
        raise ValueError(f"env must be an environment of this package, got {env}")
    return config


class ReplicaBaseline(BaseCallback):
    """Subtracts from each advantage of a rollout the mean of its replicas' at the same step.

    The other episodes of a group (``SB3VecEnv(env, replicas=8)``) draw their actions independently
    of this one's, so their mean is a baseline that leaves the policy gradient unbiased. It takes
    away the luck of traffic and noise, which is the same for all of a group and most of what an
    advantage varies by. It costs no time, as queries do not change the traffic and every episode
    replays a record in any case. It costs variety: n episodes see n / ``replicas`` stretches of
    traffic at a time.
    """

    def __init__(self, replicas: int) -> None:
        """Take the number of replicas in a group, that of the environment."""
        super().__init__()
        self.replicas = integer("replicas", replicas, 2)

    def _init_callback(self) -> None:
        """Raise a ``ValueError`` where there are no advantages or no such replicas."""
        if not isinstance(self.model, OnPolicyAlgorithm):
            raise ValueError(f"a ReplicaBaseline is for PPO and its kin, got {self.model}")
        venv = self.training_env.unwrapped
        found = venv.replicas if isinstance(venv, SB3VecEnv) else 1
        if found != self.replicas:
            raise ValueError(f"replicas must be the environment's {found}, got {self.replicas}")

    def _on_rollout_end(self) -> None:
        """Subtract, after the returns that the critic learns have been computed."""
        advantages = self.locals["rollout_buffer"].advantages  # (steps, n)
        groups = advantages.reshape(len(advantages), -1, self.replicas)
        groups -= (groups.sum(axis=2, keepdims=True) - groups) / (self.replicas - 1)

    def _on_step(self) -> bool:
        return True
