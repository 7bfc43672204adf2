"""Noise of a batch of episodes, and rounding of releases to a public grid."""

from collections.abc import Sequence

import numpy as np

from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.fields import integer

GRID_SHARE = 2.0**-10
"""Largest spacing of the released grid over the noise's standard deviation."""


def grid_of(sigma: FloatArray) -> FloatArray:
    """Return the spacing of the grid for noise of standard deviations `sigma` > 0, of any shape.

    It is the power of two in (sigma / 2048, sigma / 1024]: scaling by it is exact, so that a
    rounded release is a multiple of the grid.
    """
    _, exponent = np.frexp(sigma * GRID_SHARE)
    grid: FloatArray = np.ldexp(1.0, exponent - 1)
    return grid


class NoiseStreams:
    """Independent normal noise for every column and step of n episodes, with a stream for each.

    Noise is drawn for all columns at every step, observed or not: different policies on the same
    streams have common random numbers, and an episode's noise depends neither on its batch nor on
    the other episodes. It is drawn in blocks of steps, since a large draw costs far less than many
    small ones; the size of the blocks does not change the noise.
    """

    def __init__(
        self, n_episodes: int, n_columns: int, scale: FloatArray | float = 1.0, block: int = 32
    ) -> None:
        """Prepare streams; each episode needs a `reset` before its first step.

        Args:
            n_episodes: Episodes n.
            n_columns: Columns C of a release.
            scale: Standard deviations, of a shape that broadcasts to (C, 2).
            block: Steps for which noise is drawn at a time.

        Raises:
            ValueError: A size is below 1.
        """
        n_episodes = integer("n_episodes", n_episodes, 1)
        n_columns = integer("n_segments", n_columns, 1)
        block = integer("block", block, 1)
        self._scale, self._block = scale, block
        self._generators: list[np.random.Generator | None] = [None] * n_episodes
        self._noise = np.empty((n_episodes, block, n_columns, 2))
        # Next unused step of each block. An episode that was never reset has a used-up block, so
        # that it cannot be released without noise.
        self._next = np.full(n_episodes, block)
        # Steps for which every block certainly has noise: saves a look at `_next` at each step.
        self._sure = 0
        self._given: FloatArray | None = None

    @property
    def n_episodes(self) -> int:
        """Size n of the batch."""
        return len(self._generators)

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes, with one stream for each.

        Raises:
            ValueError: There is not exactly one stream for each episode.
        """
        rows, self._given = episodes.tolist(), None
        if len(generators) != len(rows):
            raise ValueError(
                f"generators must be one for each of {len(rows)} episodes, got {len(generators)}"
            )
        for row, generator in zip(rows, generators, strict=True):
            self._generators[row] = generator
            self._draw(row, generator)
        self._sure = self._block - int(self._next.max())

    def give(self, noise: FloatArray) -> None:
        """Set the next step's noise of all episodes, shape (n, C, 2) in standard deviations.

        The noise drawn for that step is skipped. It serves what-if trials in forks, which have no
        guarantee.

        Raises:
            ValueError: ``noise`` has another shape.
        """
        shape = (self.n_episodes, *self._noise.shape[2:])
        if noise.shape != shape:
            raise ValueError(f"noise must have shape {shape}, got {noise.shape}")
        self._given = noise * self._scale

    def next(self, episodes: IntArray) -> FloatArray:
        """Return the noise of the next step of some episodes, shape (k, C, 2), a fresh array.

        Raises:
            RuntimeError: An episode was never reset.
        """
        if self._sure <= 0:
            self._refill(episodes)
        step = self._next[episodes]
        noise: FloatArray = self._noise[episodes, step]  # a copy, as for any index array
        step += 1
        self._next[episodes] = step
        self._sure -= 1
        if self._given is not None:
            noise, self._given = self._given[episodes], None
        return noise

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
        self._noise[row] *= self._scale
        self._next[row] = 0
