"""`Learner`: the part of a training that differs between recipes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeAlias

from stable_baselines3.common.policies import BasePolicy

from agents.training.run_files import Row

Record: TypeAlias = Callable[[float, Row], None]
"""Called after every update with the seconds that it took and its values for the curve."""


class Learner(Protocol):
    """A policy and a way to train it, update by update, with a state that can be kept."""

    @property
    def policy(self) -> BasePolicy:
        """The policy, changed in place by the training."""

    @property
    def policies(self) -> Sequence[BasePolicy]:
        """The policy of each environment of the plan; they have their weights in common."""

    @property
    def update(self) -> int:
        """Number of updates, or of rounds, that are done."""

    def train(self, record: Record) -> None:
        """Train until the end of the plan; record every update, and what precedes the first."""

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs, as tensors, numbers and strings."""

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a kept state, to the same numbers."""
