"""Choice of query options by the values of the segments that they cover."""

import numpy as np

from dptse_env.release import QueryOptions
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


def best_options(
    queries: QueryOptions, value: FloatArray, fixed: IntArray, step: IntArray
) -> BoolArray:
    """Return the options of the highest value that the bandwidth pays for, shape (k, G).

    They do not overlap, and have the price level nearest to 1. Where bandwidth is left that pays
    for no such option, it is used for others. Ties rotate along the road with the step.

    Args:
        queries: The G options.
        value: Value of each mainline segment, shape (k, n_mainline).
        fixed: Mainline segments with a fixed sensor.
        step: Steps of the episode so far, shape (k,).
    """
    score = option_values(queries, value, fixed)
    turn = (queries.first - step[:, None]) % queries.n_mainline
    other = queries.level != queries.standard_level
    order = np.lexsort((turn, -score, np.broadcast_to(other, score.shape)), axis=1)
    chosen, rows = np.zeros(score.shape, dtype=bool), np.arange(len(score))
    left = np.full(len(score), queries.bandwidth)
    covered = np.zeros((len(score), queries.n_mainline), dtype=bool)
    for is_distinct in (True, False):
        for option in order.T:
            if (left < queries.cost.min()).all():
                return chosen
            fits = (queries.cost[option] <= left) & ~chosen[rows, option]
            if is_distinct:
                fits &= ~other[option] & ~(covered & queries.covers[option]).any(axis=1)
            chosen[rows, option] |= fits
            covered |= queries.covers[option] & fits[:, None]
            left -= np.where(fits, queries.cost[option], 0)
    return chosen


def option_values(queries: QueryOptions, value: FloatArray, fixed: IntArray) -> FloatArray:
    """Return the mean values of the options' segments, shape (k, G), per unit of cost.

    A segment with a fixed sensor counts as the least of the others; an option of such segments
    alone has minus infinity.
    """
    free = np.delete(np.arange(queries.n_mainline), fixed)
    known = np.array(value, dtype=np.float64)
    if free.size:
        known[:, fixed] = known[:, free].min(axis=1, keepdims=True)
    mean = known @ queries.covers.T / queries.span
    mean[:, ~queries.covers[:, free].any(axis=1)] = -np.inf
    return mean / queries.cost if queries.costs_differ else mean
