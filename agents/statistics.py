"""Intervals for means over traffic seeds, and for paired differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats


@dataclass(frozen=True)
class Interval:
    """A mean with its confidence interval.

    Attributes:
        mean: The mean.
        low: Lower end.
        high: Upper end.
        n: Number of values behind it.
    """

    mean: float
    low: float
    high: float
    n: int

    @property
    def half_width(self) -> float:
        """Half of the interval's length."""
        return (self.high - self.low) / 2

    def excludes_zero(self) -> bool:
        """Whether zero lies outside the interval."""
        return self.low > 0.0 or self.high < 0.0


def mean_interval(values: ArrayLike, confidence: float = 0.95) -> Interval:
    """Return the mean of independent values with Student's t interval.

    Args:
        values: One value per traffic seed, shape (n,), n >= 2.
        confidence: Coverage of the interval, in (0, 1).

    Raises:
        ValueError: There are fewer than two values or one is not finite.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or len(array) < 2:
        raise ValueError(f"an interval needs at least 2 values, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"values must be finite, got {array.tolist()}")
    mean, error = float(array.mean()), float(stats.sem(array))
    if error == 0.0:
        return Interval(mean, mean, mean, len(array))
    low, high = stats.t.interval(confidence, len(array) - 1, loc=mean, scale=error)
    return Interval(mean, float(low), float(high), len(array))


def geometric_mean_interval(values: ArrayLike) -> Interval:
    """Return the geometric mean of positive values with its 95 % interval.

    For times and ratios: the interval is that of the logarithms, so it never reaches zero, and
    the inverse ratios give the inverse interval.

    Raises:
        ValueError: There are fewer than two values or one is not positive and finite.
    """
    array = np.asarray(values, dtype=np.float64)
    if not (array > 0.0).all():
        raise ValueError(f"values must be above zero, got {array.tolist()}")
    logs = mean_interval(np.log(array))
    mean, low, high = (float(np.exp(end)) for end in (logs.mean, logs.low, logs.high))
    return Interval(mean, low, high, logs.n)


def paired_difference(values: ArrayLike, reference: ArrayLike) -> Interval:
    """Return the mean of ``values - reference``, paired by position, with its 95 % interval.

    Raises:
        ValueError: The two do not pair up.
    """
    a, b = np.asarray(values, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if a.shape != b.shape:
        raise ValueError(f"paired values must have one shape, got {a.shape} and {b.shape}")
    return mean_interval(a - b)
