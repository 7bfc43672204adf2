"""A module of RLlib as a query policy, which dptse evaluate puts beside schedules.

dptse evaluate --policies examples.rllib_policy:RLlibPolicy=results/rllib/policy.zip
"""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tree
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.rl_module import RLModule


class RLlibPolicy:
    """Acts with an `RLModule`, feed-forward or recurrent, without a Ray cluster."""

    def __init__(self, module: Any) -> None:
        """Take the module of a trained algorithm, ``algorithm.get_module()``."""
        self.module = module
        self.observation_space: gym.Space[Any] = module.observation_space
        self.action_space: gym.Space[Any] = module.action_space

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> RLlibPolicy:
        """Load what `save` wrote. This unpickles the file: load those that you trust."""
        with TemporaryDirectory() as folder:
            shutil.unpack_archive(path, folder, "zip")
            module: Any = RLModule.from_checkpoint(folder)
        return cls(module.to(device))

    def save(self, path: str | Path) -> None:
        """Save the module's checkpoint, which is a folder, as one .zip file."""
        with TemporaryDirectory() as folder:
            self.module.save_to_path(folder)
            shutil.make_archive(str(Path(path).with_suffix("")), "zip", folder)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """Return actions and the next state, for one observation or a batch of them.

        Args:
            observation: Shape (size,) or (n, size).
            state: What the call before returned; None at first.
            episode_start: Flags of the episodes that begin, whose state is set back, shape (n,).
            deterministic: Whether to take the likeliest action instead of drawing one.
        """
        batch = np.atleast_2d(observation)
        inputs: dict[str, Any] = {Columns.OBS: torch.as_tensor(batch, dtype=torch.float32)}
        if self.module.is_stateful():
            # Recurrent modules take sequences, here of one step.
            inputs[Columns.OBS] = inputs[Columns.OBS][:, None]
            inputs[Columns.STATE_IN] = self._state(len(batch), state, episode_start)
        with torch.no_grad():
            outputs = self.module.forward_inference(inputs)
        # Heads of several choices come as a tuple, others as one array.
        logits = outputs[Columns.ACTION_DIST_INPUTS].reshape(len(batch), -1)
        actions = self.module.get_inference_action_dist_cls().from_logits(logits)
        if deterministic:
            actions = actions.to_deterministic()
        action = actions.sample().numpy()
        if isinstance(self.action_space, gym.spaces.Box):
            # RLlib draws from a normal distribution and clips, so the same is done here.
            action = np.clip(action, self.action_space.low, self.action_space.high)
        is_batch = np.ndim(observation) > 1
        return action if is_batch else action[0], outputs.get(Columns.STATE_OUT)

    def _state(self, n: int, state: Any, episode_start: Any) -> Any:
        """Return the state of n episodes, set back to the initial one where they begin."""
        initial = tree.map_structure(
            lambda each: torch.as_tensor(each).expand(n, *each.shape),
            self.module.get_initial_state(),
        )
        if state is None:
            return initial
        if episode_start is None:
            return state
        start = torch.as_tensor(np.atleast_1d(episode_start))

        def renewed(first: torch.Tensor, now: torch.Tensor) -> torch.Tensor:
            return torch.where(start.reshape(n, *[1] * (now.ndim - 1)), first, now)

        return tree.map_structure(renewed, initial, state)
