"""`ActingPolicy`: a policy of stable-baselines3 that acts in an environment of this package."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecNormalize

from dptse_env.parts import QueryInterface
from dptse_env.policies import DETERMINISTIC
from dptse_env.utils.arrays import Action, AnyArray, BoolArray, FloatArray, Observation
from dptse_env.utils.files import require_arrays

_NORMALISATION = "normalisation."


@dataclass(frozen=True, eq=False)
class Normalisation:
    """Statistics by which ``VecNormalize`` scales observations.

    An observation x becomes (x - mean) / sqrt(variance + epsilon), clipped to -clip..clip.

    Attributes:
        mean: Shape (size,).
        variance: Shape (size,).
        clip: Largest scaled value.
        epsilon: Added to variances.
    """

    mean: FloatArray
    variance: FloatArray
    clip: FloatArray
    epsilon: FloatArray

    @classmethod
    def of(cls, scaled: VecNormalize | None) -> Normalisation | None:
        """Return the present statistics; None where observations are not scaled."""
        if scaled is None or not scaled.norm_obs:
            return None
        mean, variance = (np.array(each, dtype=np.float64) for each in _moments(scaled))
        return cls(mean, variance, np.array(float(scaled.clip_obs)), np.array(scaled.epsilon))

    @classmethod
    def taken_from(cls, arrays: dict[str, AnyArray], size: int) -> Normalisation | None:
        """Take the statistics out of the arrays of a file; None where it has none.

        Raises:
            ValueError: They are incomplete, of another shape or type, or out of range.
        """
        own = {key: arrays.pop(key) for key in list(arrays) if key.startswith(_NORMALISATION)}
        if not own:
            return None
        shapes = {f"{_NORMALISATION}{field.name}": () for field in dataclasses.fields(cls)}
        vectors = dict.fromkeys([f"{_NORMALISATION}{x}" for x in ("mean", "variance")], (size,))
        require_arrays(own, {**shapes, **vectors}, np.float64)
        found = cls(**{key.removeprefix(_NORMALISATION): own[key] for key in own})
        if (found.variance < 0).any() or found.clip <= 0 or found.epsilon <= 0:
            raise ValueError("normalisation must have variances >= 0, clip and epsilon above 0")
        return found

    def arrays(self) -> dict[str, AnyArray]:
        """Return the statistics as arrays of a file."""
        return {f"{_NORMALISATION}{key}": each for key, each in vars(self).items()}

    def __call__(self, observation: Observation) -> Observation:
        """Return scaled observations."""
        scaled = (observation - self.mean) / np.sqrt(self.variance + self.epsilon)
        clipped: Observation = np.clip(scaled, -self.clip, self.clip).astype(np.float32)
        return clipped


def _moments(scaled: VecNormalize) -> tuple[Any, Any]:
    statistics: Any = scaled.obs_rms
    return statistics.mean, statistics.var


class ActingPolicy:
    """A policy of stable-baselines3 that acts in an environment of this package.

    Attributes:
        policy: The policy of stable-baselines3.
        interface: Interface of the environment.
        card: Description of the policy, its training, and the environments it fits; empty where it
            was not loaded.
        deterministic: Whether it takes its likeliest action unless told otherwise.
    """

    def __init__(
        self,
        policy: BasePolicy,
        interface: QueryInterface,
        card: Mapping[str, Any] | None = None,
        normalisation: VecNormalize | Normalisation | None = None,
    ) -> None:
        """Bind a policy to an environment's interface.

        Args:
            policy: The policy.
            interface: Interface of the environment.
            card: Its card, if it has one.
            normalisation: Of its observations; the statistics of a ``VecNormalize`` are those of
                this moment.
        """
        if isinstance(normalisation, VecNormalize):
            normalisation = Normalisation.of(normalisation)
        self.policy, self.interface, self.card = policy, interface, dict(card or {})
        self.deterministic = self.card.get("acts", DETERMINISTIC) == DETERMINISTIC
        self._normalisation = normalisation
        # A maskable policy expects masks as an argument; they are part of the observation.
        self._takes_masks = type(policy).__name__ == "MaskableActorCriticPolicy"

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool | None = None,
    ) -> tuple[Action, Any]:
        """Return actions for one observation (size,) or a batch (k, size), and the new state.

        Args:
            observation: From the environment.
            state: The state returned by the last call, None at the first.
            episode_start: Flags of episodes that have just begun, shape (k,) or a single flag.
            deterministic: Whether to take the likeliest action instead of a random one, drawn by
                torch's generator; None for what the card says.
        """
        if deterministic is None:
            deterministic = self.deterministic
        if episode_start is not None:
            shape = np.shape(observation)[:-1] or (1,)
            episode_start = np.broadcast_to(episode_start, shape).astype(bool)
        observation, extra = np.asarray(observation), {}
        if self._takes_masks:
            extra["action_masks"] = self._masks(observation)
        if self._normalisation is not None:
            observation = self._normalisation(observation)
        return self.policy.predict(observation, state, episode_start, deterministic, **extra)

    def _masks(self, observation: Observation) -> BoolArray:
        """Return flags of the valid choices, (m,) or (k, m)."""
        picked = self.interface.picked(observation)
        masks = self.interface.actions.masks(np.atleast_2d(picked))
        return masks.reshape(*picked.shape[:-1], -1)
