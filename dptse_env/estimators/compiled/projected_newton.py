"""Compiled solution of the bounded program of a window, by a projected Newton method.

It minimises `z' H z + q' z` within bounds (Bertsekas, 1982): variables at a bound that the gradient
presses against it are fixed, Newton's step is taken in the others and clipped to the bounds, and is
shortened until the objective falls far enough. Many variables are fixed or freed in one round, and
the objective falls in every round, so that no set of fixed variables comes back. The set found in a
few rounds is mostly the right one, and the last step then is exact. Where bounds interact, steps
may become short.
"""

import numpy as np

from dptse_env.estimators.compiled.chain import Chain
from dptse_env.estimators.compiled.envelope import refactorise, solve
from dptse_env.estimators.compiled.road_order import Order, Space, place
from dptse_env.estimators.compiled.window import gradient, natural_residual
from dptse_env.estimators.horizon import AT_BOUND
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernel_loops import copy_matrix
from dptse_env.utils.kernels import kernel_part

TRIALS = 40  # most lengths of a step that are tried in a round
# The natural residual above which a solution is corrected again, the largest accepted one, and the
# one from which on it is the residual that has to fall.
REFINED, ACCEPTED, NEAR = 3e-13, 1e-9, 1e-7
SUFFICIENT = 1e-4  # share of the fall along the gradient that is enough (Armijo, 1966)


@kernel_part
def descend(
    road: RoadArrays,
    chain: Chain,
    n_stages: int,
    order: Order,
    space: Space,
    lower: FloatArray,
    upper: FloatArray,
    n_rounds: int,
    n_halvings: int,
    z: FloatArray,
) -> tuple[bool, int]:
    """Bring `z` `(L, padded)` down to the minimum; return whether it is there, and the rounds.

    It gives up after `n_rounds`, or where a step would have to be halved once more than
    `n_halvings` times. A minimum is known by its natural residual
    |z - clip(z - g / diag H, lower, upper)|.

    `lower` and `upper` `(n_x,)` bound every stage. `space` has H, and the factor of H with the
    variables fixed that are not `free`; both change. `space.vector` is left with minus the step
    that was not taken in full, if there was one.
    """
    slope, trial, trial_slope = np.zeros((3, *z.shape))
    for t in range(n_stages):
        for i in range(lower.size):
            z[t, i] = _clip(z[t, i], lower[i], upper[i])
    gradient(road, chain, n_stages, z, slope)
    residual = natural_residual(n_stages, space.curvature, lower, upper, slope, z)
    for turn in range(n_rounds):
        if residual <= REFINED:
            return True, turn
        if not _find_direction(n_stages, order, space, lower, upper, z, slope):
            return False, turn
        before, length, is_found = residual, 1.0, False
        for _ in range(TRIALS):
            _move(n_stages, order, space, lower, upper, length, z, trial)
            gradient(road, chain, n_stages, trial, trial_slope)
            residual = natural_residual(n_stages, space.curvature, lower, upper, trial_slope, trial)
            # Next to the minimum, rounding decides whether the objective falls.
            is_near = before <= NEAR and residual <= 0.5 * before
            if is_near or _falls(n_stages, lower.size, z, slope, trial, trial_slope):
                is_found = True
                break
            if n_halvings == 0:
                return before <= ACCEPTED, turn + 1
            length, n_halvings = 0.5 * length, n_halvings - 1
        if not (is_found and residual < before) and before <= ACCEPTED:
            return True, turn + 1  # no better than it was, which is good enough
        if not is_found:
            return False, turn + 1
        copy_matrix(trial, z)
        copy_matrix(trial_slope, slope)
    space.vector[:] = 0.0
    return residual <= ACCEPTED, n_rounds


@kernel_part
def _find_direction(
    n_stages: int,
    order: Order,
    space: Space,
    lower: FloatArray,
    upper: FloatArray,
    z: FloatArray,
    slope: FloatArray,
) -> bool:
    """Fix variables, and write minus Newton's step in the others; False where there is none."""
    n_variables, free = n_stages * lower.size, space.free
    for t in range(n_stages):
        for i in range(lower.size):
            p, g = place(order, n_stages, t, i), slope[t, i]
            is_fixed = (z[t, i] <= lower[i] and g > 0.0) or (z[t, i] >= upper[i] and g < 0.0)
            space.vector[p] = 0.0 if is_fixed else g
            space.flips[p] = is_fixed == (free[p] != 0.0)
    n_changed = 0
    for p in range(n_variables):
        if space.flips[p]:
            free[p] = 1.0 - free[p]
            space.changed[n_changed] = p
            n_changed += 1
    first, last, factor = space.first[:n_variables], space.last, space.factor
    n_rows = refactorise(
        space.matrix, first, last, space.diagonal, free, space.changed, n_changed, factor, space.row
    )
    if n_rows < 0:
        return False
    solve(factor, last, space.vector[:n_variables])
    return True


@kernel_part
def _move(
    n_stages: int,
    order: Order,
    space: Space,
    lower: FloatArray,
    upper: FloatArray,
    length: float,
    z: FloatArray,
    out: FloatArray,
) -> None:
    """Write a point along the direction, clipped to the bounds."""
    for t in range(n_stages):
        for i in range(lower.size):
            step = space.vector[place(order, n_stages, t, i)]
            out[t, i] = _clip(z[t, i] - length * step, lower[i], upper[i])


@kernel_part
def _clip(value: float, low: float, high: float) -> float:
    """Clip to bounds; near one it is the bound: speeds are quotients of components."""
    if value < low + AT_BOUND:
        return low
    return high if value > high - AT_BOUND else value


@kernel_part
def _falls(
    n_stages: int,
    n: int,
    z: FloatArray,
    slope: FloatArray,
    trial: FloatArray,
    trial_slope: FloatArray,
) -> bool:
    """Return whether the objective falls far enough from one point to another."""
    along, change = 0.0, 0.0
    for t in range(n_stages):
        for i in range(n):
            step = trial[t, i] - z[t, i]
            along += slope[t, i] * step
            change += 0.5 * (slope[t, i] + trial_slope[t, i]) * step
    return change <= SUFFICIENT * along
