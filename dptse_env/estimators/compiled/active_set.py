"""Compiled active-set method for the bounded program of a window.

It minimises `z' H z + q' z` within bounds by a primal-dual active set (Hintermueller, Ito and
Kunisch, 2002): variables of the set are fixed at a bound; variables outside their bounds join it,
and those whose multiplier points inwards leave it, until it does not change. H is factorised once:
fixing m variables takes m columns of its inverse, kept from round to round, and an m x m system.
The caller uses another solver where the method does not converge.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.compiled.chain import Chain, WindowScratch
from dptse_env.estimators.compiled.stages import UNSOLVED
from dptse_env.estimators.compiled.window import gradient, natural_residual, solve
from dptse_env.estimators.horizon import AT_BOUND
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernel_loops import copy_matrix
from dptse_env.utils.kernels import kernel_part

LARGEST_SET = 96
# Rounds that change all variables at once, which is fast but may cycle, and all rounds; the later
# ones change the first violating variable only, which does not cycle (Murty, 1974).
BLOCK_ROUNDS, ROUNDS = 12, 80
# Tolerance of violated bounds; variables within it of a bound are set to the bound.
SLACK = AT_BOUND
# The natural residual above which a solution is corrected again, and the largest accepted one.
REFINED, ACCEPTED = 3e-13, 1e-9


class ActiveSet(NamedTuple):
    """The active set, with scratch space."""

    side: IntArray  # (L, padded) -1 at the lower bound, 1 at the upper, 0 free; in and out
    slot: IntArray  # (L, padded) index of a variable's column, -1 for none
    columns: FloatArray  # (LARGEST_SET, L, padded) columns of H^-1
    members: IntArray  # (LARGEST_SET, 2) stage and component of active variables


@kernel_part
def make_active_set(n_stages: int, width: int) -> ActiveSet:
    """Allocate an empty active set."""
    return ActiveSet(
        np.zeros((n_stages, width), np.int64),
        np.full((n_stages, width), -1, np.int64),
        np.zeros((LARGEST_SET, n_stages, width)),
        np.zeros((LARGEST_SET, 2), np.int64),
    )


@kernel_part(kept=True)
def minimise(
    road: RoadArrays,
    chain: Chain,
    n_stages: int,
    scratch: WindowScratch,
    lower: FloatArray,
    upper: FloatArray,
    active: ActiveSet,
    z: FloatArray,
) -> int:
    """Replace `z` `(L, padded)`, a guess, by the minimiser; return the number of rounds it took.

    `lower` and `upper` `(n_x,)` bound every stage. A solution is accepted by its natural residual
    |z - clip(z - g / diag H, lower, upper)|; without one `UNSOLVED` is returned.
    """
    n, width = lower.size, z.shape[1]
    # Not parts of one array, whose layout numba would not know.
    slope, step = np.zeros((n_stages, width)), np.zeros((n_stages, width))
    free = np.empty((n_stages, width))
    active.slot[:] = -1
    gradient(road, chain, n_stages, z, slope)
    solve(road, chain, n_stages, 0, scratch, slope, step)
    _write_difference(z, step, free)
    n_columns, settled = 0, False
    for turn in range(ROUNDS):
        m = _members(n_stages, n, active)
        if m < 0:
            return UNSOLVED
        n_columns = _columns(road, chain, n_stages, scratch, active, m, n_columns, step)
        if n_columns < 0:
            return UNSOLVED
        excess = np.empty(m)
        for a in range(m):
            t, i = active.members[a]
            excess[a] = free[t, i] - (lower[i] if active.side[t, i] < 0 else upper[i])
        multipliers = _solve_multipliers(active, m, excess)
        copy_matrix(free, z)
        for a in range(m):
            _subtract(multipliers[a], _column(active, a), z, n_stages)
        if not _revise(n_stages, lower, upper, active, multipliers, z, turn >= BLOCK_ROUNDS):
            settled = True
            break
    if not settled:
        return UNSOLVED
    for trial in range(6):
        _fix(active, m, lower, upper, z)
        _set_near_bounds(n_stages, lower, upper, z)
        gradient(road, chain, n_stages, z, slope)
        residual = natural_residual(n_stages, scratch.diagonal, lower, upper, slope, z)
        if residual <= REFINED or trial == 5:
            return turn + 1 if residual <= ACCEPTED else UNSOLVED
        solve(road, chain, n_stages, 0, scratch, slope, step)
        for a in range(m):
            excess[a] = -step[active.members[a, 0], active.members[a, 1]]
        multipliers = _solve_multipliers(active, m, excess)
        _subtract(1.0, step, z, n_stages)
        for a in range(m):
            _subtract(multipliers[a], _column(active, a), z, n_stages)
    return UNSOLVED


@kernel_part
def _write_difference(z: FloatArray, step: FloatArray, out: FloatArray) -> None:
    for t in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[t, i] = z[t, i] - step[t, i]


@kernel_part
def _members(n_stages: int, n: int, active: ActiveSet) -> int:
    """List the active variables and return their number, -1 if there are too many."""
    m = 0
    for t in range(n_stages):
        for i in range(n):
            if active.side[t, i] != 0:
                if m == LARGEST_SET:
                    return -1
                active.members[m, 0], active.members[m, 1] = t, i
                m += 1
    return m


@kernel_part(kept=True)
def _columns(
    road: RoadArrays,
    chain: Chain,
    n_stages: int,
    scratch: WindowScratch,
    active: ActiveSet,
    m: int,
    n_columns: int,
    unit: FloatArray,
) -> int:
    """Solve for missing columns of H^-1; return the number of columns, -1 if there are too many."""
    unit[:] = 0.0
    for a in range(m):
        t, i = active.members[a]
        if active.slot[t, i] >= 0:
            continue
        if n_columns == LARGEST_SET:
            return -1
        unit[t, i] = 1.0
        solve(road, chain, n_stages, t, scratch, unit, active.columns[n_columns])
        unit[t, i] = 0.0
        active.slot[t, i] = n_columns
        n_columns += 1
    return n_columns


@kernel_part
def _column(active: ActiveSet, a: int) -> FloatArray:
    column: FloatArray = active.columns[active.slot[active.members[a, 0], active.members[a, 1]]]
    return column


@kernel_part
def _solve_multipliers(active: ActiveSet, m: int, excess: FloatArray) -> FloatArray:
    """Return the multipliers that remove the excess of active variables, by a Cholesky solve."""
    L, x = np.empty((m, m)), excess.copy()
    for a in range(m):
        column = _column(active, a)
        for b in range(a, m):
            L[b, a] = column[active.members[b, 0], active.members[b, 1]]
    for a in range(m):
        for k in range(a):
            L[a, a] -= L[a, k] * L[a, k]
        L[a, a] = np.sqrt(L[a, a])
        for b in range(a + 1, m):
            for k in range(a):
                L[b, a] -= L[b, k] * L[a, k]
            L[b, a] /= L[a, a]
    for a in range(m):
        for k in range(a):
            x[a] -= L[a, k] * x[k]
        x[a] /= L[a, a]
    for a in range(m - 1, -1, -1):
        for k in range(a + 1, m):
            x[a] -= L[k, a] * x[k]
        x[a] /= L[a, a]
    return x


@kernel_part
def _subtract(factor: float, column: FloatArray, z: FloatArray, n_stages: int) -> None:
    for t in range(n_stages):
        for i in range(z.shape[1]):
            z[t, i] -= factor * column[t, i]


@kernel_part
def _revise(
    n_stages: int,
    lower: FloatArray,
    upper: FloatArray,
    active: ActiveSet,
    multipliers: FloatArray,
    z: FloatArray,
    only_first: bool,
) -> bool:
    """Release variables that pull inwards, add those outside; return whether the set changed."""
    changed, a = False, 0
    for t in range(n_stages):
        for i in range(lower.size):
            side = active.side[t, i]
            if side != 0:  # the members have this order
                # At the lower bound the free minimum lies below: its multiplier is negative.
                wrong, side, a = multipliers[a] * side < 0.0, 0, a + 1
            elif z[t, i] < lower[i] - SLACK:
                wrong, side = True, -1
            else:
                wrong, side = z[t, i] > upper[i] + SLACK, 1
            if wrong:
                active.side[t, i], changed = side, True
                if only_first:
                    return True
    return changed


@kernel_part
def _set_near_bounds(n_stages: int, lower: FloatArray, upper: FloatArray, z: FloatArray) -> None:
    """Set components within rounding of a bound to it: speeds are quotients of components."""
    for t in range(n_stages):
        for i in range(lower.size):
            if z[t, i] < lower[i] + SLACK:
                z[t, i] = lower[i]
            elif z[t, i] > upper[i] - SLACK:
                z[t, i] = upper[i]


@kernel_part
def _fix(active: ActiveSet, m: int, lower: FloatArray, upper: FloatArray, z: FloatArray) -> None:
    for a in range(m):
        t, i = active.members[a]
        z[t, i] = lower[i] if active.side[t, i] < 0 else upper[i]
