"""The observation: the operator's knowledge as a flat float32 vector.

It consists of named blocks, each with fixed bounds and scaled by physical constants of the
corridor, so there are no running statistics that could be lost between training and use. It has
released values, the estimator's output, the query history and public settings, but neither the
truth, nor a clock, nor anything that distinguishes an empty segment from an occupied one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from dptse_env.spaces.blocks import (
    AGE_CAP,
    BLOCKS,
    DEFAULT,
    SHIPPED_BLOCKS,
    ObservationBlock,
    ObservationSetup,
    PublicState,
    default_blocks,
)
from dptse_env.utils.arrays import Observation
from dptse_env.utils.registry import is_foreign, name_of_class

__all__ = [
    "AGE_CAP",
    "BLOCKS",
    "DEFAULT",
    "ObservationBlock",
    "ObservationEncoding",
    "ObservationSetup",
    "PublicState",
    "default_blocks",
]


class ObservationEncoding:
    """Encoding of public states as vectors, with the space and the position of every block.

    `dptse_env.env.SensorQueryEnv` has a table of the default blocks. Values beyond
    the bounds are clipped.

    Attributes:
        setup: The public configuration.
        space: The Gymnasium space, a float32 ``Box``.
        slices: Position of each block, by name.
    """

    def __init__(self, setup: ObservationSetup, blocks: Sequence[Any] = (DEFAULT,)) -> None:
        """Arrange blocks in a vector.

        Args:
            setup: The public configuration.
            blocks: Names, ``"package.module:Class"``, objects or classes; ``"default"`` stands for
                all default blocks.

        Raises:
            ValueError: There is no such block, it lacks a method, or two have the same name.
        """
        self.setup = setup
        names = [name for value in blocks for name in _expanded(value, setup)]
        self.blocks: tuple[ObservationBlock, ...] = tuple(map(_made, names))
        sizes = [_checked_size(block, setup) for block in self.blocks]
        ends = np.cumsum(sizes).tolist()
        self.slices: dict[str, slice] = {}
        for block, size, end in zip(self.blocks, sizes, ends, strict=True):
            if block.name in self.slices:
                raise ValueError(f"observation has two blocks named {block.name!r}")
            self.slices[block.name] = slice(end - size, end)
        low = np.repeat([block.low for block in self.blocks], sizes).astype(np.float32)
        high = np.repeat([block.high for block in self.blocks], sizes).astype(np.float32)
        self.space = spaces.Box(low, high, dtype=np.float32)
        places = self.slices.values()
        self._plan = tuple(zip(self.blocks, places, map(is_foreign, self.blocks), strict=True))

    def encode(self, state: PublicState) -> Observation:
        """Return the observations of k episodes, shape (k, size), always inside the space."""
        k = len(state.released)
        flat = np.empty((k, self.space.shape[0]), dtype=np.float32)
        for block, place, checked in self._plan:
            values = block.values(state, self.setup)
            if checked:
                _check_values(block, values, (k, place.stop - place.start))
            flat[:, place] = values
        np.maximum(flat, self.space.low, out=flat)
        return np.minimum(flat, self.space.high, out=flat)

    def block(self, observation: Observation, name: str) -> Observation:
        """Return the block ``name`` of observations of shape (..., size).

        Raises:
            ValueError: There is no such block.
        """
        if name not in self.slices:
            raise ValueError(f"unknown observation block {name!r}; known: {', '.join(self.slices)}")
        return observation[..., self.slices[name]]


def _expanded(value: Any, setup: ObservationSetup) -> list[Any]:
    return default_blocks(setup) if isinstance(value, str) and value == DEFAULT else [value]


def _made(value: Any) -> ObservationBlock:
    """Return a block; one of another package must have a new name and valid bounds."""
    block = BLOCKS.find(value)
    block = block() if isinstance(block, type) else block
    if is_foreign(block):
        name = name_of_class(block)
        if block.name in {shipped.name for shipped in SHIPPED_BLOCKS}:
            raise ValueError(
                f"observation {name} must not be named {block.name!r}, which is a block of "
                "dptse_env"
            )
        low, high = getattr(block, "low", None), getattr(block, "high", None)
        numbers = isinstance(low, int | float) and isinstance(high, int | float)
        if not numbers or not block.low < block.high:
            raise ValueError(f"observation {name} must have bounds low < high, got {low}, {high}")
    made: ObservationBlock = block
    return made


def _checked_size(block: ObservationBlock, setup: ObservationSetup) -> int:
    size = block.size(setup)
    if type(size) is not int or size < 0:
        raise ValueError(
            f"observation {name_of_class(block)}.size() must return an integer >= 0, got {size!r}"
        )
    return size


def _check_values(block: ObservationBlock, values: Any, shape: tuple[int, int]) -> None:
    array = np.asarray(values)
    if array.shape not in ((), shape) or array.dtype.kind not in "biuf":
        raise ValueError(
            f"observation {name_of_class(block)}.values() must return numbers of shape {shape}, "
            f"got {array.dtype} of shape {array.shape}"
        )
    if not np.isfinite(array).all():
        raise ValueError(f"observation {name_of_class(block)}.values() must return finite numbers")
