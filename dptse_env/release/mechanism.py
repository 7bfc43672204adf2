"""Mechanisms, which turn true aggregates into released values."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dptse_env.release.noise import NoiseStreams, grid_of
from dptse_env.utils.arrays import FloatArray, IntArray


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


class GaussianMechanism(NoiseStreams):
    """Adds independent Gaussian noise to every value and rounds the sum to a public grid.

    The low bits of a sum in double precision depend on the true value: released unrounded, they
    would prove that a segment is empty (Mironov, 2012). Rounding to a grid of spacing
    `grid`, a power of two between sigma / 2048 and sigma / 1024, removes them. It depends on sigma
    alone and raises the variance by less than a millionth.
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
        self._sigma, self._grid = std, grid_of(std)
        for array in (self._sigma, self._grid):
            array.flags.writeable = False
        self._per_grid = 1.0 / self._grid
        super().__init__(n_episodes, n_segments, std, block)

    @property
    def sigma(self) -> FloatArray:
        """See `Mechanism.sigma`."""
        return self._sigma

    @property
    def grid(self) -> FloatArray:
        """Spacing of the grid that releases are rounded to, (2,), in the units of `sigma`."""
        return self._grid

    def release(self, episodes: IntArray, values: FloatArray) -> FloatArray:
        """See `Mechanism.release`; releases are multiples of `grid`.

        Raises:
            RuntimeError: An episode was never reset.
            ValueError: `values` has another shape.
        """
        shape = (len(episodes), *self._noise.shape[2:])
        if values.shape != shape:
            raise ValueError(f"values must have shape {shape}, got {values.shape}")
        released = self.next(episodes)
        released += values
        released *= self._per_grid
        np.rint(released, out=released)
        released *= self._grid
        return released
