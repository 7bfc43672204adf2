"""Exact Gaussian noise on a public grid, for a batch of episodes.

What noise is added to is a sum of multiples of a grid, a power of two (`grid_of`). Its release is
the sum plus ``grid * round(sigma / grid * Z)`` with Z standard normal. That equals the sum plus
``sigma * Z``, rounded to the grid: post-processing of the Gaussian mechanism, so that its mu holds
as it stands. (Unrounded sums in double precision would have no guarantee, since their low bits
depend on the true value; Mironov, 2012.)

The integer is sampled without error, by inversion. 64 random bits say in which interval of width
2^-64 the distribution function of Z lies. Where double precision leaves no doubt about the
integer, that settles it. Elsewhere, in about one of ten million draws, the two ends of the interval
are compared with the distribution function at the border between two integers, with as many
further bits and digits as it takes (`rounded_normal`).
"""

from __future__ import annotations

import copy
import os
import weakref
from collections.abc import Callable, Sequence
from typing import Any, Literal

import mpmath
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import kernel, kernel_part

NoiseSource = Literal["seeded", "secure"]
"""Source of random bits: the stream of the episode, or the operating system."""

GRID_SHARE = 2.0**-10
"""Largest spacing of the released grid over the noise's standard deviation."""

COARSEST = 1.0
"""Largest spacing of the grid, so that a vehicle counts as 1, and its speed in km/h as finely."""

LARGEST_SIGMA = 2.0**49
"""Largest standard deviation of noise [vehicles, km/h].

With sums below 2^52 steps of the grid, as other limits have it, releases are exact in double
precision up to it: 64 bits are no further out than 9.2 deviations.
"""

BLOCK = 32
"""Seconds for which noise is drawn at a time; a large draw costs far less than many small ones."""

DOUBT = 2.0**-38
"""Bound on the error of a normal number z in double precision, over 1 + abs(z), up to `FAR`.

It covers the 2^-65 that the bits leave open of the distribution function, which is 2^-41 in z at
`FAR`, and scipy's ``ndtri``, with a thousand times the error that is found against mpmath.
"""

FAR = 5.5
"""Size from which on a normal number is always settled by `rounded_normal`."""

_EXPONENT = 0x7FF0_0000_0000_0000  # the bits of a double's exponent

Bits = NDArray[np.uint64]


@kernel_part
def grid_of(sigma: float) -> float:
    """Return the spacing of the grid for noise of a standard deviation > 0.

    It is the power of two in (sigma / 2048, sigma / 1024], or `COARSEST` if that is smaller.
    Scaling by it is exact.
    """
    # Without its fraction a float is the power of two below it.
    bits = np.float64(sigma * GRID_SHARE).view(np.int64) & np.int64(_EXPONENT)
    return min(float(np.int64(bits).view(np.float64)), COARSEST)


def normal_of(bits: Bits) -> FloatArray:
    """Return the standard normal numbers of 64 random bits each, of the same shape.

    The lowest bit is the sign, 1 below zero. The others are an integer v, and (v + 1/2) 2^-64 is
    the probability of a number further out on that side.
    """
    tail = (bits >> np.uint64(1)).view(np.int64).astype(np.float64)
    tail += 0.5
    tail *= 2.0**-64
    sign = (bits << np.uint64(63)).view(np.float64)
    normal: FloatArray = np.copysign(ndtri(tail), sign)
    return normal


def rounded_normal(scale: float, bits: int, more: Callable[[], int]) -> int:
    """Return ``round(scale * Z)`` for the normal number Z that begins with some bits, exactly.

    Args:
        scale: Standard deviation over the grid, > 0.
        bits: 64 random bits, as in `normal_of`.
        more: Returns further 64 random bits.
    """
    tail, size = bits >> 1, 64
    found = round(-scale * float(ndtri((tail + 0.5) * 2.0**-64)))
    while True:
        with mpmath.workprec(size + 64):
            least, most = mpmath.ldexp(tail, -size), mpmath.ldexp(tail + 1, -size)
            error = mpmath.ldexp(1, -size - 32)
            # The probabilities of a number beyond either border of the integer.
            outer, inner = (_beyond(scale, found + side) for side in (0.5, -0.5))
            # Newton's step towards the middle of the interval.
            missing = _beyond(scale, found) - (least + most) / 2
            step = max(1, int(abs(missing) / mpmath.npdf(found, 0, scale)))
            if least > inner + error:
                found -= step
            elif most < outer - error:
                found += step
            elif outer + error < least and most < inner - error:
                return -found if bits & 1 else found
            else:
                tail, size = tail << 64 | more(), size + 64


def _beyond(scale: float, border: float) -> mpmath.mpf:
    """Return the probability that ``scale * Z`` lies beyond a border, in the working precision."""
    return mpmath.erfc(border / (scale * mpmath.sqrt(2))) / 2


class Noise:
    """Independent normal noise for every channel and step of n episodes, with a stream for each.

    Noise is drawn for all channels of all groups at every step, observed or not: different policies
    on the same streams have common random numbers, and an episode's noise depends neither on its
    batch nor on the other episodes.

    A copy of seeded noise repeats it. A copy of secure noise, a pickled one, or that of a forked
    process has none until its episodes are reset, since ledgers would be spent twice, too.
    """

    __copy__ = copy.deepcopy  # two that share a block would not know which step is unused

    def __init__(
        self, n_episodes: int, n_channels: int, source: NoiseSource = "seeded", scale: float = 1.0
    ) -> None:
        """Prepare streams; each episode needs a `reset` before its first step.

        A `scale` other than 1 breaks what release models promise, as audits do to be caught.
        """
        self._is_secure, self._scale = source == "secure", scale
        self._generators: list[np.random.Generator | None] = [None] * n_episodes
        self._bits: Bits = np.zeros((n_episodes, BLOCK, n_channels, 2), dtype=np.uint64)
        self._normal = np.zeros(self._bits.shape)
        # Next unused step of each block. An episode that was never reset has a used-up block, so
        # that it cannot be released without noise.
        self._next = np.full(n_episodes, BLOCK)
        # Steps for which every block certainly has noise: saves a look at `_next` at each step.
        self._sure = 0
        self._given: FloatArray | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle has: of secure noise, that of no episode."""
        n_episodes, _, n_channels, _ = self._bits.shape
        made = Noise(n_episodes, n_channels, "secure", self._scale) if self._is_secure else self
        return vars(made)

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes (k,), with one stream for each, which secure noise leaves unused.

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
        shape = (len(self._generators), *self._normal.shape[2:])
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
        """Return values with the noise of the next step, on the grid of their noise, over a unit.

        Rounding raises the variance of the noise by less than a millionth.

        Args:
            episodes: Shape (k,).
            values: What noise is added to, shape (k, C, 2): multiples of `grid_of` the deviation
                where a guarantee is to hold; others are rounded to it.
            sigma: Standard deviations of the noise, above 0 and up to `LARGEST_SIGMA`, shape
                (k, C, 2).
            unit: What released values are divided by, shape (C,).

        Raises:
            ValueError: A standard deviation is out of range.
            RuntimeError: An episode was never reset, or is a copy whose noise is secure.
        """
        if self._sure <= 0:
            self._refill(episodes)
        self._sure -= 1
        given, self._given = self._given, None
        if given is not None:
            self._normal[episodes, self._next[episodes]] = given[episodes]
        released, open_, n_open = _add(
            self._normal, self._next, episodes, values, self._scale, sigma, unit, DOUBT
        )
        if n_open < 0:
            raise ValueError(
                "privacy.epsilon must be such that noise has standard deviations in "
                f"(0, {LARGEST_SIGMA:.3g}], got {sigma.min():.3g} to {sigma.max():.3g}"
            )
        if n_open > 0 and given is None:
            self._settle(episodes, values, sigma, unit, released, open_)
        return released

    def _settle(
        self,
        episodes: IntArray,
        values: FloatArray,
        sigma: FloatArray,
        unit: FloatArray,
        released: FloatArray,
        open_: BoolArray,
    ) -> None:
        """Write the releases whose noise double precision leaves open."""
        for k, c, q in np.argwhere(open_).tolist():
            row = int(episodes[k])
            grid = grid_of(sigma[k, c, q])
            bits = int(self._bits[row, self._next[row] - 1, c, q])
            scale = self._scale * float(sigma[k, c, q]) / grid
            steps = rounded_normal(scale, bits, self._further(row))
            released[k, c, q] = (np.rint(values[k, c, q] / grid) + steps) * grid / unit[c]

    def _further(self, row: int) -> Callable[[], int]:
        """Return a source of 64 further bits, which leaves the stream of an episode as it is."""
        if self._is_secure:
            return lambda: int.from_bytes(os.urandom(8))
        generator = self._generators[row]
        assert generator is not None  # it has drawn the bits that leave the number open
        child = generator.spawn(1)[0]
        return lambda: int(child.integers(2**64, dtype=np.uint64))

    def _refill(self, episodes: IntArray) -> None:
        """Draw new blocks for those of `episodes` whose block is used up."""
        for row in episodes[self._next[episodes] == BLOCK].tolist():
            generator = self._generators[row]
            if generator is None:
                raise RuntimeError(
                    f"episode {row} must be reset before it is released: it never was, or its "
                    "secure noise stayed with the process that it was copied or forked from"
                )
            self._draw(row, generator)
        self._sure = BLOCK - int(self._next.max())

    def _draw(self, row: int, generator: np.random.Generator) -> None:
        bits = self._bits[row]
        if self._is_secure:
            _SECURE.add(self)
            bits[:] = np.frombuffer(os.urandom(bits.nbytes), dtype=np.uint64).reshape(bits.shape)
        else:
            bits[:] = generator.integers(2**64, size=bits.shape, dtype=np.uint64)
        self._normal[row] = normal_of(bits)
        self._next[row] = 0

    def _forget(self) -> None:
        """Leave all episodes without noise, as they were before their first reset."""
        self._generators[:] = [None] * len(self._generators)
        self._next[:] = BLOCK
        self._sure = 0


_SECURE: weakref.WeakSet[Noise] = weakref.WeakSet()
"""The secure noise that this process has drawn, which is not a forked one's to use."""


def _forget_secure() -> None:
    for noise in _SECURE:
        noise._forget()


if hasattr(os, "register_at_fork"):  # Windows has no forks
    os.register_at_fork(after_in_child=_forget_secure)


@kernel
def _add(
    normal: FloatArray,
    next_: IntArray,
    episodes: IntArray,
    values: FloatArray,
    scale: float,
    sigma: FloatArray,
    unit: FloatArray,
    doubt: float,
) -> tuple[FloatArray, BoolArray, int]:
    """Return releases, flags of those that double precision leaves open, and their number.

    That is negative, and nothing is done, where a deviation is out of range.
    """
    released, open_ = np.empty(values.shape), np.empty(values.shape, dtype=np.bool_)
    for k in range(episodes.size):
        for c in range(unit.size):
            for q in range(2):
                if not 0.0 < sigma[k, c, q] <= LARGEST_SIGMA:
                    return released, open_, -1
    n_open = 0
    for k in range(episodes.size):
        step = next_[episodes[k]]
        next_[episodes[k]] += 1
        for c in range(unit.size):
            for q in range(2):
                grid = grid_of(sigma[k, c, q])
                ratio = scale * sigma[k, c, q] / grid
                z = normal[episodes[k], step, c, q]
                steps = np.rint(ratio * z)
                size = abs(z)
                margin = 0.5 - abs(ratio * z - steps)
                is_open = size > FAR or margin < ratio * (1.0 + size) * doubt
                open_[k, c, q] = is_open
                n_open += is_open
                released[k, c, q] = (np.rint(values[k, c, q] / grid) + steps) * grid / unit[c]
    return released, open_, n_open
