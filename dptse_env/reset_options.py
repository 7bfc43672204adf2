"""The options of ``reset``: the traffic that an episode replays, and its first second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dptse_env.config import EnvConfig
from dptse_env.utils.arrays import IntArray

NAMES = ("traffic_seed", "start")


@dataclass(frozen=True)
class ResetOptions:
    """Checked reset options of k episodes; None where an episode draws a random value.

    Attributes:
        config: The configuration of the environment.
        traffic: Indices into ``config.traffic_seeds``, k of them.
        starts: First seconds of the record, k of them.
    """

    config: EnvConfig
    traffic: list[int | None]
    starts: list[int | None]

    @classmethod
    def from_mapping(
        cls, options: Mapping[str, Any] | None, config: EnvConfig, n_episodes: int = 1
    ) -> ResetOptions:
        """Check ``options``: each one value for all episodes, or one for each.

        Raises:
            ValueError: A key is unknown, a value out of range, or there are too many or too few.
        """
        options = options or {}
        for key in options:
            if key not in NAMES:
                raise ValueError(f"options.{key} is unknown; allowed: {', '.join(NAMES)}")
        seeds, starts = (per_episode(key, options.get(key), n_episodes) for key in NAMES)
        known, last = config.traffic_seeds, config.last_start
        for seed in seeds:
            if seed is not None and (type(seed) is not int or seed not in known):
                raise ValueError(
                    f"options.traffic_seed must be one of the environment's "
                    f"{len(known)} traffic_seeds, got {seed!r}"
                )
        for start in starts:
            if start is not None and (type(start) is not int or not 0 <= start <= last):
                raise ValueError(f"options.start must be an integer in 0..{last}, got {start!r}")
        traffic = [None if seed is None else known.index(seed) for seed in seeds]
        return cls(config, traffic, starts)

    def draw(self, generators: Sequence[np.random.Generator]) -> tuple[IntArray, IntArray]:
        """Return traffic indices and first seconds of the episodes, drawn where they are not fixed.

        Both are always drawn, so that fixing one does not change the other.
        """
        traffic = np.empty(len(generators), dtype=np.int64)
        starts = np.empty(len(generators), dtype=np.int64)
        for k, generator in enumerate(generators):
            index = int(generator.integers(len(self.config.traffic_seeds)))
            start = int(generator.integers(self.config.last_start + 1))
            fixed_index, fixed_start = self.traffic[k], self.starts[k]
            traffic[k] = index if fixed_index is None else fixed_index
            if fixed_start is None:
                fixed_start = start if self.config.random_start else 0
            starts[k] = fixed_start
        return traffic, starts


def per_episode(name: str, value: Any, n_episodes: int) -> list[Any]:
    """Return the values of option ``name``, one per episode, given one for all or one for each.

    numpy's integers come back as Python's.

    Raises:
        ValueError: There are too many or too few.
    """
    if not isinstance(value, list | tuple | np.ndarray) or np.ndim(value) == 0:
        values = [value] * n_episodes
    elif len(value) != n_episodes:
        raise ValueError(
            f"options.{name} must be one value or {n_episodes}, one per episode, got {len(value)}"
        )
    else:
        values = list(value)
    return [value.item() if isinstance(value, np.integer) else value for value in values]
