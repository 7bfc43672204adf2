"""Noise of a batch of episodes, and rounding of releases to a public grid."""

from collections.abc import Sequence

import numpy as np

from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernels import kernel, kernel_part

GRID_SHARE = 2.0**-10
"""Largest spacing of the released grid over the noise's standard deviation."""

BLOCK = 32
"""Seconds for which noise is drawn at a time; a large draw costs far less than many small ones."""

_EXPONENT = 0x7FF0_0000_0000_0000  # the bits of a double's exponent


@kernel_part
def grid_of(sigma: float) -> float:
    """Return the spacing of the grid for noise of a standard deviation > 0.

    It is the power of two in (sigma / 2048, sigma / 1024]: scaling by it is exact, so that a
    rounded release is a multiple of the grid.
    """
    # Without its fraction a float is the power of two below it.
    bits = np.float64(sigma * GRID_SHARE).view(np.int64) & np.int64(_EXPONENT)
    return float(np.int64(bits).view(np.float64))


class Noise:
    """Independent normal noise for every column and step of n episodes, with a stream for each.

    Noise is drawn for all columns of all groups at every step, observed or not: different policies
    on the same streams have common random numbers, and an episode's noise depends neither on its
    batch nor on the other episodes.
    """

    def __init__(self, n_episodes: int, n_columns: int, scale: float = 1.0) -> None:
        """Prepare streams; each episode needs a `reset` before its first step.

        A `scale` other than 1 breaks what release models promise, as audits do to be caught.
        """
        self._scale = scale
        self._generators: list[np.random.Generator | None] = [None] * n_episodes
        self._noise = np.empty((n_episodes, BLOCK, n_columns, 2))
        # Next unused step of each block. An episode that was never reset has a used-up block, so
        # that it cannot be released without noise.
        self._next = np.full(n_episodes, BLOCK)
        # Steps for which every block certainly has noise: saves a look at `_next` at each step.
        self._sure = 0
        self._given: FloatArray | None = None

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes (k,), with one stream for each.

        Raises:
            ValueError: There is not exactly one stream for each episode.
        """
        self._given = None
        for row, generator in zip(episodes.tolist(), generators, strict=True):
            self._generators[row] = generator
            self._draw(row, generator)
        self._sure = BLOCK - int(self._next.max())

    def give(self, noise: FloatArray) -> None:
        """Set the next step's noise of all episodes, shape (n, C, 2) in standard deviations.

        It takes the place of the noise drawn for that step. It serves what-if trials in forks,
        which have no guarantee.

        Raises:
            ValueError: ``noise`` has another shape.
        """
        shape = (len(self._generators), *self._noise.shape[2:])
        if noise.shape != shape:
            raise ValueError(f"noise must have shape {shape}, got {noise.shape}")
        self._given = noise

    def added(
        self,
        episodes: IntArray,
        values: FloatArray,
        sigma: FloatArray,
        unit: FloatArray,
    ) -> FloatArray:
        """Return values with the noise of the next step, rounded to `grid_of` it, over their unit.

        The low bits of a sum in double precision depend on the true value: released unrounded, they
        would prove that a segment is empty (Mironov, 2012). Rounding raises the variance by less
        than a millionth.

        Args:
            episodes: Shape (k,).
            values: True values, shape (k, C, 2).
            sigma: Standard deviations of the noise, shape (k, C, 2).
            unit: What released values are divided by, shape (C,).

        Raises:
            RuntimeError: An episode was never reset.
        """
        if self._sure <= 0:
            self._refill(episodes)
        self._sure -= 1
        if self._given is not None:
            self._noise[episodes, self._next[episodes]] = self._given[episodes]
            self._given = None
        released = np.empty(values.shape)
        _add(self._noise, self._next, episodes, values, sigma, unit, released)
        return released

    def _refill(self, episodes: IntArray) -> None:
        """Draw new blocks for those of `episodes` whose block is used up."""
        for row in episodes[self._next[episodes] == BLOCK].tolist():
            generator = self._generators[row]
            if generator is None:
                raise RuntimeError(f"episode {row} was released before its first reset")
            self._draw(row, generator)
        self._sure = BLOCK - int(self._next.max())

    def _draw(self, row: int, generator: np.random.Generator) -> None:
        generator.standard_normal(out=self._noise[row])
        if self._scale != 1.0:
            self._noise[row] *= self._scale
        self._next[row] = 0


@kernel
def _add(
    noise: FloatArray,
    next_: IntArray,
    episodes: IntArray,
    values: FloatArray,
    sigma: FloatArray,
    unit: FloatArray,
    released: FloatArray,
) -> None:
    for k in range(episodes.size):
        step = next_[episodes[k]]
        next_[episodes[k]] += 1
        for c in range(unit.size):
            for q in range(2):
                grid = grid_of(sigma[k, c, q])
                noisy = noise[episodes[k], step, c, q] * sigma[k, c, q] + values[k, c, q]
                released[k, c, q] = np.rint(noisy / grid) * grid / unit[c]
