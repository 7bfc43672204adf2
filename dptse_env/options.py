"""The options of ``reset``: which traffic an episode replays, and from which second on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dptse_env.config import EnvConfig


@dataclass(frozen=True)
class ResetOptions:
    """Checked reset options; None where the episode draws for itself.

    Attributes:
        config: The configuration they were checked against.
        slot: Index into ``config.traffic_seeds``.
        start: First second of the record.
    """

    config: EnvConfig
    slot: int | None = None
    start: int | None = None

    @classmethod
    def of(cls, options: Mapping[str, Any] | None, config: EnvConfig) -> ResetOptions:
        """Check ``options``.

        Raises:
            ValueError: A key is unknown or a value out of range.
        """
        options = options or {}
        allowed = ("traffic_seed", "start")
        for key in options:
            if key not in allowed:
                raise ValueError(f"options.{key} is unknown; allowed: {', '.join(allowed)}")
        slot, start = options.get("traffic_seed"), options.get("start")
        if slot is not None:
            if slot not in config.traffic_seeds:
                raise ValueError(
                    f"options.traffic_seed must be one of the environment's "
                    f"{len(config.traffic_seeds)} traffic_seeds, got {slot!r}"
                )
            slot = config.traffic_seeds.index(slot)
        last = config.last_start
        if start is not None and not (
            isinstance(start, int | np.integer)
            and not isinstance(start, bool)
            and 0 <= start <= last
        ):
            raise ValueError(f"options.start must be an integer in 0..{last}, got {start!r}")
        return cls(config, slot, None if start is None else int(start))

    def draw(self, generator: np.random.Generator) -> tuple[int, int]:
        """Return (slot, start) for one episode; what is not fixed is drawn.

        Both are drawn whether needed or not, so that fixing one leaves the other as it was.
        """
        slot = int(generator.integers(len(self.config.traffic_seeds)))
        start = int(generator.integers(self.config.last_start + 1))
        if not self.config.random_start:
            start = 0
        return (
            slot if self.slot is None else self.slot,
            start if self.start is None else self.start,
        )
