"""An actor of plain torch as a query policy, which dptse evaluate puts beside schedules.

dptse evaluate --policies examples.slots_policy:SlotsPolicy=results/cleanrl/policy.zip
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import torch


class SlotsPolicy:
    """A network that gives every slot of ``action="slots"`` the logits of its options."""

    def __init__(
        self,
        network: torch.nn.Module,
        observation_space: gym.Space[Any],
        action_space: gym.spaces.MultiDiscrete,
    ) -> None:
        """Take a network from observations (n, size) to logits (n, slots * options).

        Args:
            network: Made of torch's own modules, so that its file needs no code of ours.
            observation_space: Space of one observation.
            action_space: Space of one action.
        """
        self.network = network
        self.observation_space = observation_space
        self.action_space = action_space

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> SlotsPolicy:
        """Load what `save` wrote. This unpickles the file: load those that you trust."""
        return cls(**torch.load(path, map_location=device, weights_only=False))

    def save(self, path: str | Path) -> None:
        """Save network and spaces as a .zip file, which is what `torch.save` writes."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        torch.save(vars(self), path)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """Return actions and no state, for one observation or a batch of them."""
        with torch.no_grad():
            logits = self.network(torch.as_tensor(observation, dtype=torch.float32))
        logits = logits.unflatten(-1, (len(self.action_space.nvec), -1))
        if deterministic:
            return logits.argmax(-1).numpy(), None
        return torch.distributions.Categorical(logits=logits).sample().numpy(), None
