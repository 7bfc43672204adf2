"""Compiled solution of the bounded program of a window: `minimise z' H z + q' z within bounds`.

A projected Newton method takes most programs from the last solution to the minimum in a few rounds,
to rounding. Where bounds interact its steps become short, in one place or another of the road. An
interior-point method then goes most of the way in these places, and where that is not enough on the
whole road; the number of its rounds has no tail. The caller uses another solver where neither
arrives.
"""

import numpy as np

from dptse_env.estimators.compiled.chain import Chain
from dptse_env.estimators.compiled.envelope import factorise
from dptse_env.estimators.compiled.interior_point import approach
from dptse_env.estimators.compiled.projected_newton import descend
from dptse_env.estimators.compiled.road_order import Order, Space, read_line, write_line
from dptse_env.estimators.compiled.stages import UNSOLVED
from dptse_env.estimators.compiled.window import gradient
from dptse_env.estimators.horizon import AT_BOUND
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray
from dptse_env.utils.kernels import kernel_part

# The projected Newton method is tried again and again. Before each attempt but the first the
# interior-point method is applied in places that begin and end so many segments from a component
# that the Newton step would take out of its bounds; before the last one everywhere.
REACHES = (0, 6, 12, 24, -1)
# Rounds, and halved steps, of the Newton method in each attempt.
ROUNDS = (12, 20, 20, 20, 40)
HALVINGS = (0, 30, 30, 30, 400)


@kernel_part
def minimise(
    road: RoadArrays,
    chain: Chain,
    n_stages: int,
    order: Order,
    space: Space,
    lower: FloatArray,
    upper: FloatArray,
    z: FloatArray,
) -> int:
    """Replace `z` `(L, padded)`, a guess, by the minimiser; return the number of rounds it took.

    `lower` and `upper` `(n_x,)` bound every stage. `space` has H and its factor. Where there is no
    minimiser to the tolerance of `descend`, `UNSOLVED` is returned.
    """
    n_variables, rounds = n_stages * lower.size, 0
    space.free[:] = 1.0
    space.diagonal[:n_variables] = space.matrix[:n_variables, 0]
    read_line(order, n_stages, space.diagonal, space.curvature)
    for attempt in range(len(REACHES)):
        if attempt > 0:
            rounds += _approach(
                road, chain, n_stages, order, space, lower, upper, REACHES[attempt], z
            )
        if attempt == len(REACHES) - 1:  # rounding adds up as the factor is brought up to date
            space.free[:] = 1.0
            first = space.first[:n_variables]
            if not factorise(space.matrix, first, space.last, space.factor):
                return UNSOLVED
        done, more = descend(
            road, chain, n_stages, order, space, lower, upper,
            ROUNDS[attempt], HALVINGS[attempt], z,
        )  # fmt: skip
        rounds += more
        if done:
            return rounds
    return UNSOLVED


@kernel_part
def _approach(
    road: RoadArrays,
    chain: Chain,
    n_stages: int,
    order: Order,
    space: Space,
    lower: FloatArray,
    upper: FloatArray,
    reach: int,
    z: FloatArray,
) -> int:
    """Apply the interior-point method in places, or everywhere for a reach of -1.

    Elsewhere the last Newton step is taken, which stays within the bounds there. Returns the
    largest number of rounds in a place.
    """
    size, table = n_stages * lower.size, np.zeros(z.shape)
    low, high, x, slope = np.empty((4, size))
    for t in range(n_stages):
        table[t, : lower.size] = lower
    write_line(order, n_stages, table, low)
    for t in range(n_stages):
        table[t, : upper.size] = upper
    write_line(order, n_stages, table, high)
    write_line(order, n_stages, z, x)
    is_hard = np.ones(size, np.bool_)
    if reach >= 0:
        is_hard = _mark(x - space.vector[:size], low, high, 2 * reach * n_stages)
    for p in range(size):
        if not is_hard[p]:
            x[p] -= space.vector[p]
    read_line(order, n_stages, x, z)
    gradient(road, chain, n_stages, z, table)
    write_line(order, n_stages, table, slope)
    rounds, start = 0, 0
    while start < size:
        end = start + 1
        while end < size and is_hard[end] == is_hard[start]:
            end += 1
        if is_hard[start]:
            rounds = max(rounds, approach(space, start, end, low, high, x, slope))
        start = end
    read_line(order, n_stages, x, z)
    return rounds


@kernel_part
def _mark(x: FloatArray, low: FloatArray, high: FloatArray, reach: int) -> BoolArray:
    """Return which components are within a reach of one that is outside of its bounds."""
    is_near = np.zeros(x.size, np.bool_)
    for p in range(x.size):
        if not low[p] - AT_BOUND <= x[p] <= high[p] + AT_BOUND:
            is_near[max(p - reach, 0) : p + reach + 1] = True
    return is_near
