"""Intervals over traffic seeds, and over training seeds crossed with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


def mean(table: FloatArray) -> FloatArray:
    """Return the mean over the last two axes."""
    means: FloatArray = table.mean(axis=(-2, -1))
    return means


def percent_below(table: FloatArray, reference: FloatArray) -> FloatArray:
    """Return by how much the mean of ``table`` lies below that of ``reference`` [%].

    A ratio of means, not a mean of ratios: traffic with large errors weighs as much as it errs.
    """
    return 100.0 * (1.0 - mean(table) / mean(reference))


def percent_of_way(table: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """Return how far the mean of ``table`` has come from that of ``start`` to ``end``'s [%]."""
    return 100.0 * (mean(start) - mean(table)) / (mean(start) - mean(end))


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
    than the standard error of their means over traffic, a nominal 95 % covers some 84 %:
    `crossed_t` accounts for the small number of runs.

    Args:
        statistic: Takes arrays (r, S, T), one for each table, and returns (r,).
        *tables: Values by training seed and traffic seed, shape (S, T); (T,) for a policy that
            was not trained. T is the same for all tables, S may differ.
        n_resamples: Number of resamples.
        seed: Seeds the resampling.

    Raises:
        ValueError: Tables do not pair up, are too small or not finite, or the statistic is not.
    """
    checked = _paired_tables(tables)
    if n_resamples < 100:
        raise ValueError(f"n_resamples must be >= 100, got {n_resamples}")
    n_columns = checked[0].shape[1]
    generator = np.random.default_rng(seed)
    parts = []
    for first in range(0, n_resamples, _CHUNK):
        size = min(_CHUNK, n_resamples - first)
        columns = generator.integers(n_columns, size=(size, 1, n_columns))
        drawn = []
        for table in checked:
            rows = generator.integers(len(table), size=(size, len(table), 1))
            drawn.append(table[rows, columns])
        parts.append(statistic(*drawn))
    values = np.concatenate(parts)
    estimate = float(statistic(*(table[None] for table in checked))[0])
    if not (np.isfinite(values).all() and np.isfinite(estimate)):
        raise ValueError("the statistic must be finite on every resample")
    low, high = np.percentile(values, [2.5, 97.5])
    return Interval(estimate, float(low), float(high), n_columns)


_CHUNK = 500
"""Resamples drawn at once, which bounds the memory."""


def crossed_t(table: ArrayLike) -> tuple[Interval, float]:
    """Return the mean of crossed values with its 95 % interval, and the p-value of a zero mean.

    A two-way random-effects model with one value in each cell: training seed, traffic seed and
    their interaction. The mean squares of the rows plus those of the columns minus those of the
    residual estimate the variance of the mean, and Satterthwaite's formula its degrees of
    freedom. With one training seed this is the paired t test over traffic seeds.

    Args:
        table: Paired differences by training seed and traffic seed, shape (S, T) or (T,).

    Raises:
        ValueError: The table is too small or not finite.
    """
    (values,) = _paired_tables([table])
    n_rows, n_columns = values.shape
    centre, by_row, by_column = values.mean(), values.mean(axis=1), values.mean(axis=0)
    variance = n_rows * by_column.var(ddof=1)
    terms = [(variance, n_columns - 1)]
    if n_rows > 1:
        residual = values - by_row[:, None] - by_column + centre
        df = (n_rows - 1) * (n_columns - 1)
        rows, rest = n_columns * by_row.var(ddof=1), np.sum(residual**2) / df
        # Sampling may leave the difference of mean squares below either of them.
        variance = max(variance + rows - rest, variance, rows)
        terms += [(rows, n_rows - 1), (rest, df)]
    if variance == 0.0:
        point = float(centre)
        return Interval(point, point, point, n_columns), float(point == 0.0)
    freedom = variance**2 / sum(square**2 / df for square, df in terms)
    spread = np.sqrt(variance / values.size)
    low, high = stats.t.interval(0.95, freedom, loc=centre, scale=spread)
    p_value = 2.0 * stats.t.sf(abs(centre) / spread, freedom)
    return Interval(float(centre), float(low), float(high), n_columns), float(p_value)


def holm(p_values: Sequence[float]) -> float:
    """Return the largest of some p-values, adjusted by Holm's (1979) step-down procedure.

    Where it is below alpha, all are rejected with a family-wise error rate of alpha, however the
    tests depend on one another. Of none it is 1.
    """
    steps = [(len(p_values) - k) * each for k, each in enumerate(sorted(p_values))]
    return min(1.0, max(steps, default=1.0))


def _paired_tables(tables: Sequence[ArrayLike]) -> list[FloatArray]:
    """Return tables as arrays (S, T), checked."""
    checked = []
    for table in tables:
        array = np.asarray(table, dtype=np.float64)
        array = array[None] if array.ndim == 1 else array
        if array.ndim != 2 or len(array) < 1 or array.shape[1] < 2:
            raise ValueError(
                f"a table needs a training seed and 2 traffic seeds, got shape {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"values must be finite, {np.sum(~np.isfinite(array))} are not")
        checked.append(array)
    if len({array.shape[1] for array in checked}) != 1:
        raise ValueError(
            f"tables must have the same traffic seeds, got {[a.shape for a in checked]}"
        )
    return checked
