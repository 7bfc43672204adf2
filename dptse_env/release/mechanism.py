"""Mechanisms, which turn true aggregates into released values."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.validation import integer

GRID_SHARE = 2.0**-10
"""Largest spacing of the released grid over the noise's standard deviation."""


class Mechanism(Protocol):
    """Interface of mechanisms, for a batch of n episodes of S segments."""

    @property
    def sigma(self) -> FloatArray:
        """Noise standard deviation of the two released quantities, (2,) [veh/km, km/h]."""

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes.

        Args:
            episodes: (k,) distinct rows of the batch.
            generators: k noise streams, one for each; only the mechanism uses them from now on.
        """

    def release(self, episodes: IntArray, values: FloatArray) -> FloatArray:
        """Release one step of some episodes.

        Args:
            episodes: (k,) distinct rows of the batch.
            values: (k, S, 2) true density [veh/km] and speed [km/h] of all segments; those of
                unobserved segments are arbitrary, and their release is to be discarded.

        Returns:
            (k, S, 2) a fresh array of released values, in the same units.
        """


class GaussianMechanism:
    """Adds independent Gaussian noise to every value and rounds the sum to a public grid.

    The low bits of a sum in double precision depend on the true value: released unrounded, they
    would prove that a segment is empty (Mironov, 2012). Rounding to a grid of spacing
    `grid`, a power of two between sigma / 2048 and sigma / 1024, removes them. It depends on sigma
    alone and raises the variance by less than a millionth.

    Noise is drawn for all segments at every step, observed or not: different policies on the same
    streams have common random numbers, and an episode's noise depends neither on its batch nor on
    the other episodes. It is drawn in blocks of steps, since a large draw costs far less than many
    small ones; the size of the blocks does not change the noise.
    """

    def __init__(
        self, sigma: npt.ArrayLike, *, n_episodes: int, n_segments: int, block: int = 32
    ) -> None:
        """Make a mechanism; each episode needs a `reset` before its first release.

        `block` is the number of steps for which noise is drawn at a time.

        Raises:
            ValueError: `sigma` is not two finite numbers above zero, or a size is below 1.
        """
        std = np.array(sigma, dtype=np.float64)
        if std.shape != (2,) or not (np.isfinite(std).all() and (std > 0.0).all()):
            raise ValueError(f"sigma must be two finite numbers > 0, got {sigma!r}")
        n_episodes = integer("n_episodes", n_episodes, 1)
        n_segments = integer("n_segments", n_segments, 1)
        block = integer("block", block, 1)
        std.flags.writeable = False
        self._sigma = std
        # Powers of two: scaling by them is exact, so that a release is a multiple of the grid.
        self._grid = 2.0 ** np.floor(np.log2(std * GRID_SHARE))
        self._grid.flags.writeable = False
        self._per_grid = 1.0 / self._grid
        self._block = block
        self._generators: list[np.random.Generator | None] = [None] * n_episodes
        self._noise = np.empty((n_episodes, block, n_segments, 2))
        # Next unused step of each block. An episode that was never reset has a used-up block, so
        # that it cannot be released without noise.
        self._next = np.full(n_episodes, block)
        # Releases for which every block certainly has noise: saves a look at `_next` at each step.
        self._sure = 0

    @property
    def sigma(self) -> FloatArray:
        """See `Mechanism.sigma`."""
        return self._sigma

    @property
    def grid(self) -> FloatArray:
        """Spacing of the grid that releases are rounded to, (2,), in the units of `sigma`."""
        return self._grid

    @property
    def n_episodes(self) -> int:
        """Size n of the batch."""
        return len(self._generators)

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `Mechanism.reset`.

        Raises:
            ValueError: There is not exactly one stream for each episode.
        """
        rows = episodes.tolist()
        if len(generators) != len(rows):
            raise ValueError(
                f"generators must be one for each of {len(rows)} episodes, got {len(generators)}"
            )
        for row, generator in zip(rows, generators, strict=True):
            self._generators[row] = generator
            self._draw(row, generator)
        self._sure = self._block - int(self._next.max())

    def release(self, episodes: IntArray, values: FloatArray) -> FloatArray:
        """See `Mechanism.release`; releases are multiples of `grid`.

        Raises:
            RuntimeError: An episode was never reset.
            ValueError: `values` has another shape.
        """
        if self._sure <= 0:
            self._refill(episodes)
        step = self._next[episodes]
        released: FloatArray = self._noise[episodes, step]  # a copy, as for any index array
        if values.shape != released.shape:
            raise ValueError(f"values must have shape {released.shape}, got {values.shape}")
        released += values
        released *= self._per_grid
        np.rint(released, out=released)
        released *= self._grid
        step += 1
        self._next[episodes] = step
        self._sure -= 1
        return released

    def _refill(self, episodes: IntArray) -> None:
        """Draw new blocks for those of `episodes` whose block is used up."""
        for row in episodes[self._next[episodes] == self._block].tolist():
            generator = self._generators[row]
            if generator is None:
                raise RuntimeError(f"episode {row} was released before its first reset")
            self._draw(row, generator)
        self._sure = self._block - int(self._next.max())

    def _draw(self, row: int, generator: np.random.Generator) -> None:
        generator.standard_normal(out=self._noise[row])
        self._noise[row] *= self._sigma
        self._next[row] = 0
