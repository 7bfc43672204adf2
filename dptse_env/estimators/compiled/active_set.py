"""A compiled active set for the bounded program of a window.

Minimiser of `z' H z + q' z` within bounds: a set of variables is held at bounds, what is found
outside joins it and what no longer presses on its bound leaves it, until nothing changes (the
primal-dual active set of Hintermueller, Ito and Kunisch, 2002). H is factorised once, whatever
the set: holding m variables takes m columns of its inverse, kept from round to round, and an
m x m system. Where that does not end the caller is told and has another solver.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from dptse_env.estimators.compiled.window import Chain, Space, gradient, solve
from dptse_env.estimators.horizon import AT_BOUND
from dptse_env.model.road_arrays import Road
from dptse_env.utils.arrays import FloatArray, IntArray

LARGEST_SET = 96
# Rounds that change all at once, which is quick and may cycle, and rounds in all; the later ones
# change the first variable in line only, which does not cycle (Murty, 1974).
BOLD_ROUNDS, ROUNDS = 12, 80
# How far outside a bound (and how near to it without being put there) a variable must be.
SLACK = AT_BOUND
# The natural residual that is corrected once more, and the largest one that is accepted.
REFINED, ACCEPTED = 3e-13, 1e-9


class Held(NamedTuple):
    """Working space of the active set.

    Attributes:
        side: `(L, padded)` -1 at the lower bound, 1 at the upper, 0 free; in and out.
        slot: `(L, padded)` which column a variable has, -1 for none.
        columns: `(LARGEST_SET, L, padded)` columns of H^-1.
        members: `(LARGEST_SET, 2)` stage and component of the variables held.
    """

    side: IntArray
    slot: IntArray
    columns: FloatArray
    members: IntArray


@njit(cache=True, error_model="numpy")
def held_for(n_stages: int, width: int) -> Held:
    """Allocate the working space."""
    return Held(
        np.zeros((n_stages, width), np.int64),
        np.full((n_stages, width), -1, np.int64),
        np.zeros((LARGEST_SET, n_stages, width)),
        np.zeros((LARGEST_SET, 2), np.int64),
    )


@njit(cache=True, error_model="numpy")
def minimise(
    road: Road,
    chain: Chain,
    n_stages: int,
    space: Space,
    lower: FloatArray,
    upper: FloatArray,
    held: Held,
    z: FloatArray,
) -> bool:
    """Replace `z` `(L, padded)`, a guess, by the minimiser; returns whether it was found.

    `lower` and `upper` `(2 S,)` bound every stage. What is found is judged by the natural
    residual |z - clip(z - g / diag H, lower, upper)|.
    """
    n, width = lower.size, z.shape[1]
    slope, step, free = np.zeros((3, n_stages, width))
    held.slot[:] = -1
    gradient(road, chain, n_stages, z, slope)
    solve(road, chain, n_stages, 0, space, slope, step)
    free[:] = z[:n_stages] - step
    n_columns, settled = 0, False
    for turn in range(ROUNDS):
        m = _members(n_stages, n, held)
        if m < 0:
            return False
        n_columns = _columns(road, chain, n_stages, space, held, m, n_columns, step)
        if n_columns < 0:
            return False
        excess = np.empty(m)
        for a in range(m):
            t, i = held.members[a]
            excess[a] = free[t, i] - (lower[i] if held.side[t, i] < 0 else upper[i])
        pull = _hold(held, m, excess)
        z[:n_stages] = free
        for a in range(m):
            _subtract(pull[a], _column(held, a), z, n_stages)
        if not _revise(n_stages, lower, upper, held, pull, z, turn >= BOLD_ROUNDS):
            settled = True
            break
    if not settled:
        return False
    for trial in range(6):
        _snap(held, m, lower, upper, z)
        _settle(n_stages, lower, upper, z)
        gradient(road, chain, n_stages, z, slope)
        residual = _natural_residual(n_stages, space, lower, upper, slope, z)
        if residual <= REFINED or trial == 5:
            return bool(residual <= ACCEPTED)
        solve(road, chain, n_stages, 0, space, slope, step)
        for a in range(m):
            excess[a] = -step[held.members[a, 0], held.members[a, 1]]
        pull = _hold(held, m, excess)
        _subtract(1.0, step, z, n_stages)
        for a in range(m):
            _subtract(pull[a], _column(held, a), z, n_stages)
    return False


@njit(cache=True, error_model="numpy")
def _members(n_stages: int, n: int, held: Held) -> int:
    """List the variables held; -1 if they are too many."""
    m = 0
    for t in range(n_stages):
        for i in range(n):
            if held.side[t, i] != 0:
                if m == LARGEST_SET:
                    return -1
                held.members[m, 0], held.members[m, 1] = t, i
                m += 1
    return m


@njit(cache=True, error_model="numpy")
def _columns(
    road: Road,
    chain: Chain,
    n_stages: int,
    space: Space,
    held: Held,
    m: int,
    n_columns: int,
    unit: FloatArray,
) -> int:
    """Solve for missing columns of H^-1; returns how many there are, -1 if too many."""
    unit[:] = 0.0
    for a in range(m):
        t, i = held.members[a]
        if held.slot[t, i] >= 0:
            continue
        if n_columns == LARGEST_SET:
            return -1
        unit[t, i] = 1.0
        solve(road, chain, n_stages, t, space, unit, held.columns[n_columns])
        unit[t, i] = 0.0
        held.slot[t, i] = n_columns
        n_columns += 1
    return n_columns


@njit(cache=True, error_model="numpy")
def _column(held: Held, a: int) -> FloatArray:
    column: FloatArray = held.columns[held.slot[held.members[a, 0], held.members[a, 1]]]
    return column


@njit(cache=True, error_model="numpy")
def _hold(held: Held, m: int, excess: FloatArray) -> FloatArray:
    """Multipliers that take the excess off the variables held: a Cholesky solve, m x m."""
    L, x = np.empty((m, m)), excess.copy()
    for a in range(m):
        column = _column(held, a)
        for b in range(a, m):
            L[b, a] = column[held.members[b, 0], held.members[b, 1]]
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


@njit(cache=True, error_model="numpy")
def _subtract(factor: float, column: FloatArray, z: FloatArray, n_stages: int) -> None:
    for t in range(n_stages):
        for i in range(z.shape[1]):
            z[t, i] -= factor * column[t, i]


@njit(cache=True, error_model="numpy")
def _revise(
    n_stages: int,
    lower: FloatArray,
    upper: FloatArray,
    held: Held,
    pull: FloatArray,
    z: FloatArray,
    only_first: bool,
) -> bool:
    """Let go what pulls inwards, hold what is outside; returns whether anything changed."""
    changed, a = False, 0
    for t in range(n_stages):
        for i in range(lower.size):
            side = held.side[t, i]
            if side != 0:  # the members are in this order, too
                # At the lower bound the free minimum lies below: the pull on it is negative.
                wrong, side, a = pull[a] * side < 0.0, 0, a + 1
            elif z[t, i] < lower[i] - SLACK:
                wrong, side = True, -1
            else:
                wrong, side = z[t, i] > upper[i] + SLACK, 1
            if wrong:
                held.side[t, i], changed = side, True
                if only_first:
                    return True
    return changed


@njit(cache=True, error_model="numpy")
def _settle(n_stages: int, lower: FloatArray, upper: FloatArray, z: FloatArray) -> None:
    """Put what lies at a bound but for rounding there: a speed is a quotient of two of them."""
    for t in range(n_stages):
        for i in range(lower.size):
            if z[t, i] < lower[i] + SLACK:
                z[t, i] = lower[i]
            elif z[t, i] > upper[i] - SLACK:
                z[t, i] = upper[i]


@njit(cache=True, error_model="numpy")
def _snap(held: Held, m: int, lower: FloatArray, upper: FloatArray, z: FloatArray) -> None:
    for a in range(m):
        t, i = held.members[a]
        z[t, i] = lower[i] if held.side[t, i] < 0 else upper[i]


@njit(cache=True, error_model="numpy")
def _natural_residual(
    n_stages: int,
    space: Space,
    lower: FloatArray,
    upper: FloatArray,
    slope: FloatArray,
    z: FloatArray,
) -> float:
    largest = 0.0
    for t in range(n_stages):
        for i in range(lower.size):
            target = z[t, i] - slope[t, i] / space.diagonal[t, i]
            gap = abs(z[t, i] - min(max(target, lower[i]), upper[i]))
            if not gap <= largest:  # a NaN stays one
                largest = gap
    return largest
