"""`World`: an environment that a policy is trained in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dptse_env.config import EnvConfig


@dataclass(frozen=True)
class World:
    """An environment that a policy is trained in.

    Attributes:
        env: Environment id.
        keywords: Keywords of the environment, plain JSON, without those that the training chooses.
        config: Its configuration, with those.
        share: Its part of episodes and samples over that of the first environment: a road of more
            segments has as many fewer, since every segment of every second is a sample.
    """

    env: str
    keywords: Mapping[str, Any]
    config: EnvConfig = field(repr=False)
    share: float = 1.0

    def part(self, count: int, multiple: int = 1) -> int:
        """Return the world's part of a number, a multiple of another one and not zero."""
        return max(round(count * self.share / multiple), 1) * multiple

    def __str__(self) -> str:
        """Return the id, with the keywords after it if there are any."""
        return f"{self.env} {dict(self.keywords)}" if self.keywords else self.env
