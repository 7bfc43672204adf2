"""Compiled interior-point method for the bounded program of a window, or of a part of the road.

Mehrotra's (1992) predictor and corrector from a point on the central path. The number of rounds
hardly depends on the number of bounds that bind and on how they interact; in exchange each round
factorises a matrix anew, and the solution stops short of the bounds.

Vectors here are lines along the road, in the order of `road_order.Order`. A part of the road is a
range of places, whose rows of H have entries near the diagonal only as well; what lies outside
stays as it is.
"""

import numpy as np

from dptse_env.estimators.compiled.envelope import factorise, multiply, solve
from dptse_env.estimators.compiled.road_order import Space
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel_part

ROUNDS = 50
# The natural residual at which the bounds that bind show.
CLOSE = 1e-8
# Distance of the start from the bounds, as a share of their distance; and its complementarity, as a
# share of what the objective falls without bounds.
INSIDE, CENTRED = 0.01, 0.1
# Share of the way to the nearest bound that a step may go.
SHORT = 0.995


@kernel_part
def approach(
    space: Space, start: int, end: int, low: FloatArray, high: FloatArray, x: FloatArray,
    slope: FloatArray,
) -> int:  # fmt: skip
    """Bring a part of `x` near the minimiser, given the rest; return the number of rounds.

    Components that are nearer to a bound than their multiplier, over the diagonal of H, are set to
    it. The number is -1 where a factor is unsound.

    Args:
        space: Has H. Its `inverse` is scratch.
        start: First place of the part.
        end: The place after the last one.
        low: `(N,)` lower bounds.
        high: `(N,)` upper bounds.
        x: `(N,)` a point within the bounds, replaced.
        slope: `(N,)` half the objective's gradient there.
    """
    x, low, high, g = x[start:end], low[start:end], high[start:end], slope[start:end].copy()
    matrix, factor, diagonal = space.matrix[start:end], space.inverse, space.diagonal[start:end]
    first = np.maximum(space.first[start:end], start) - start
    last = np.minimum(space.last[start:end], end - 1) - start
    size, product = x.size, np.empty(x.size)
    if not factorise(matrix, first, last, factor):
        return -1
    step = g.copy()
    solve(factor, last, step)
    centre = CENTRED * max(0.5 * np.sum(g * step), 1e-9) / (2 * size)
    inside = INSIDE * (high - low)
    step = np.minimum(np.maximum(x, low + inside), high - inside) - x
    x += step
    multiply(matrix, last, step, product)
    g += product
    by_low, by_high = centre / (x - low), centre / (high - x)  # multipliers of the bounds
    rounds = 0
    while rounds < ROUNDS:
        rounds += 1
        below, above = 1.0 / (x - low), 1.0 / (high - x)
        matrix[:, 0] = diagonal + by_low * below + by_high * above
        is_sound = factorise(matrix, first, last, factor)
        matrix[:, 0] = diagonal
        if not is_sound:
            return -1
        # Predict: all products of a multiplier and its distance go to zero.
        step = -g
        solve(factor, last, step)
        d_low, d_high = -by_low * (1.0 + below * step), -by_high * (1.0 - above * step)
        length = _longest(step, below, above, d_low, by_low, d_high, by_high)
        before = np.sum(by_low * (x - low) + by_high * (high - x))
        after = np.sum((by_low + length * d_low) * (x + length * step - low))
        after += np.sum((by_high + length * d_high) * (high - x - length * step))
        # Correct: they become equal, the second order of the prediction considered.
        centre = (after / before) ** 3 * before / (2 * size)
        aim_low, aim_high = centre - step * d_low, centre + step * d_high
        step = aim_low * below - aim_high * above - g
        solve(factor, last, step)
        d_low = (aim_low - by_low * step) * below - by_low
        d_high = (aim_high + by_high * step) * above - by_high
        length = SHORT * _longest(step, below, above, d_low, by_low, d_high, by_high)
        step *= length
        x += step
        by_low += length * d_low
        by_high += length * d_high
        multiply(matrix, last, step, product)
        g += product
        clipped = np.minimum(np.maximum(x - g / diagonal, low), high)
        if np.max(np.abs(x - clipped)) <= CLOSE:
            break
    x[:] = np.where(diagonal * (x - low) < by_low, low, x)
    x[:] = np.where(diagonal * (high - x) < by_high, high, x)
    return rounds


@kernel_part
def _longest(
    step: FloatArray,
    below: FloatArray,
    above: FloatArray,
    d_low: FloatArray,
    by_low: FloatArray,
    d_high: FloatArray,
    by_high: FloatArray,
) -> float:
    """Return the longest step, up to 1, that leaves distances and multipliers positive."""
    largest = 1.0
    for i in range(step.size):
        largest = max(largest, -step[i] * below[i], step[i] * above[i])
        if -d_low[i] > largest * by_low[i]:
            largest = -d_low[i] / by_low[i]
        if -d_high[i] > largest * by_high[i]:
            largest = -d_high[i] / by_high[i]
    return 1.0 / largest
