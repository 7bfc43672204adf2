"""Intervals over traffic seeds, and over training seeds crossed with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from dptse_env.utils.arrays import FloatArray


@dataclass(frozen=True)
class Interval:
    """A mean with the ends of its confidence interval.

    Attributes:
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


def mean_interval(values: ArrayLike) -> Interval:
    """Return the mean of independent values with Student's 95 % interval.

    Args:
        values: One value per traffic seed, shape (n,), n >= 2.

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
    low, high = stats.t.interval(0.95, len(array) - 1, loc=mean, scale=error)
    return Interval(mean, float(low), float(high), len(array))


def interquartile_mean(table: FloatArray) -> FloatArray:
    """Return the interquartile mean over training seeds of means over traffic seeds.

    It leaves the best and the worst quarter of trainings out, one of five each, so that a single
    lucky or failed one does not decide (Agarwal et al., "Deep Reinforcement Learning at the Edge of
    the Statistical Precipice", 2021). Of fewer than four trainings it is the mean. All traffic
    counts: an error on a bad day is one.

    Args:
        table: Values by training seed and traffic seed in the last two axes, shape (..., S, T).
    """
    means: FloatArray = stats.trim_mean(table.mean(axis=-1), 0.25, axis=-1)
    return means


def percent_below(table: FloatArray, reference: FloatArray) -> FloatArray:
    """Return by how much the mean of ``table`` lies below that of ``reference`` [%].

    Means are those of `interquartile_mean`. A ratio of means, not a mean of ratios: traffic with
    large errors weighs as much as it errs.
    """
    return 100.0 * (1.0 - interquartile_mean(table) / interquartile_mean(reference))


def bootstrap(
    statistic: Callable[..., FloatArray],
    *tables: ArrayLike,
    n_resamples: int = 10_000,
    seed: int = 0,
) -> Interval:
    """Return a statistic of paired tables with its two-level 95 % bootstrap interval.

    Training seeds and traffic seeds are crossed: every run meets all traffic. Each resample draws
    traffic seeds with replacement, the same for all tables, which keeps them paired, and training
    seeds with replacement, separately for each table (the "pigeonhole bootstrap" of Owen, 2007).
    The interval lies between the percentiles of the statistic over the resamples. Its coverage is
    nominal where runs differ little on each traffic seed. With five runs that differ by much more
    than the standard error of their means over traffic, a nominal 95 % covers some 89 %
    of interquartile means.

    Args:
        statistic: Takes arrays (r, S, T), one for each table, and returns (r,).
        *tables: Values by training seed and traffic seed, shape (S, T); (T,) for a policy that
            was not trained. T is the same for all tables, S may differ.
        n_resamples: Number of resamples.
        seed: Seeds the resampling.

    Raises:
        ValueError: Tables do not pair up or are too small, or the statistic is not finite.
    """
    arrays = [np.atleast_2d(np.asarray(table, dtype=np.float64)) for table in tables]
    shapes = [array.shape for array in arrays]
    n_columns = shapes[0][-1]
    if n_columns < 2 or any(each[0] < 1 or each[1:] != (n_columns,) for each in shapes):
        raise ValueError(
            f"tables must have training seeds and 2 or more common traffic seeds, got {shapes}"
        )
    generator = np.random.default_rng(seed)
    parts = []
    for first in range(0, n_resamples, _CHUNK):
        size = min(_CHUNK, n_resamples - first)
        columns = generator.integers(n_columns, size=(size, 1, n_columns))
        drawn = []
        for table in arrays:
            rows = generator.integers(len(table), size=(size, len(table), 1))
            drawn.append(table[rows, columns])
        parts.append(statistic(*drawn))
    values = np.concatenate(parts)
    estimate = float(statistic(*(table[None] for table in arrays))[0])
    if not (np.isfinite(values).all() and np.isfinite(estimate)):
        raise ValueError("the statistic must be finite on every resample")
    low, high = np.percentile(values, [2.5, 97.5])
    return Interval(estimate, float(low), float(high), n_columns)


_CHUNK = 500
"""Resamples drawn at once, which bounds the memory."""
