"""The bounded program of a window, and its solution by forward and backward sweeps.

A window is a chain of L states: `minimise |x_0 - arrival|^2 / variance + sum |x_t+1 - A x_t -
offset|^2 / variance + sum |target - h'x_t|^2 / noise` within bounds. Its Hessian H is
block-tridiagonal, and its factorisation in the order of time is a Kalman filter's forward pass. A
component at a bound is a number that is known: a row with a noise of zero. So a filter's forward
pass and the backward one of Bryson and Frazier (1963) give the minimum for a given set of
components at bounds.

`minimise` looks for the set. An active-set method adds the components that are most outside of
their bounds and releases those whose multiplier points inwards, by columns of H^-1 from a factor
without a set; it is fast but may cycle. Then a projected Newton method (Bertsekas, 1982), whose
objective falls in every round, factorises anew for each set. All quantities are normalised.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.linalg import (
    add_product,
    mirror,
    move,
    move_back,
    pair_update,
    propagate,
    scalar_update,
    solve,
)
from dptse_env.estimators.linalg import factor as cholesky
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import copy_matrix, copy_vector, fill_vector, kernel_part

# How a program was solved.
UNSOLVED, ACTIVE_SET, NEWTON = 0, 1, 2
# Components so near to a bound are set to it: a speed is a quotient of numbers that may vanish.
AT_BOUND = 1e-13
LARGEST_SET = 96  # components at a bound, in the active set's rounds
# The natural residual above which a solution is corrected again, the largest accepted one, and the
# one from which on it is the residual that has to fall.
REFINED, ACCEPTED, NEAR = 3e-13, 1e-9, 1e-7
# Components join the set if they are outside by more than this share of the largest excess: the
# others mostly come back with it, and would cost a column of H^-1 each.
ADDED = 0.9
ROUNDS = 50  # of the active set
NEWTON_ROUNDS, HALVINGS, CORRECTIONS = 200, 4, 6
SUFFICIENT = 1e-4  # share of the fall along the gradient that is enough (Armijo, 1966)


class Window(NamedTuple):
    """A linearised window of L stages, normalised; what belongs to transitions has L - 1 or L."""

    arrival: FloatArray  # (n_x,) mean of the first state
    arrival_variance: FloatArray  # (n_x,)
    blocks: FloatArray  # (L, S, K, 4) of the transitions A that leave each stage
    by_factor: FloatArray  # (L, E, 2) derivatives of the entries' segments by demand factors
    offsets: FloatArray  # (L, n_x)
    process_variance: FloatArray  # (L, n_x)
    observed: BoolArray  # (L, M)
    weights: FloatArray  # (L, M, 2, 2 x largest span) of both numbers of each row
    targets: FloatArray  # (L, M, 2) values less the constants of the linearisation
    noise: FloatArray  # (L, M, 2) variances
    lower: FloatArray  # (n_x,)
    upper: FloatArray  # (n_x,)


class Point(NamedTuple):
    """A trajectory, and what it leaves of each part of the window."""

    z: FloatArray  # (L, padded)
    gaps: FloatArray  # (L, padded) of the arrival, then of each transition
    misfits: FloatArray  # (L, 2 M) of the observed numbers, one after the other
    force: FloatArray  # (L, padded) minus half the objective's gradient, -(H z + q / 2)


class Factor(NamedTuple):
    """The factor of a window for a set of components at bounds, and working space of sweeps.

    The updates of a stage, U at most, are those of components at bounds, then of observed numbers.
    """

    length: IntArray  # (1,) stages that are factorised
    side: IntArray  # (L, n_x) the set: -1 at the lower bound, 1 at the upper one, 0 free
    covariances: FloatArray  # (L, n_x, padded) filtered
    before: FloatArray  # (n_x, padded) the last one before its stage's updates
    n_fixed: IntArray  # (L,) components at a bound
    n_updates: IntArray  # (L,)
    first: IntArray  # (L, U) the first components that the updates' numbers depend on,
    size: IntArray  # (L, U) the number of these
    rows: FloatArray  # (L, U, 2 x largest span) and the derivatives
    totals: FloatArray  # (L, U) variances of the updates' numbers
    gains: FloatArray  # (L, U, padded)
    pulls: FloatArray  # (L, U) residuals over these variances, in a sweep
    scratch: FloatArray  # (2, n_x, padded)
    vectors: FloatArray  # (4, padded)


class Columns(NamedTuple):
    """Columns of H^-1 for components at bounds."""

    known: IntArray  # (1,) their number
    slot: IntArray  # (L, n_x) which one is that of a component, -1 for none
    inverse: FloatArray  # (LARGEST_SET, L, padded)
    unit: Point  # zero, but for the component whose column is written
    members: IntArray  # (LARGEST_SET, 2) stage and component of those at a bound
    multipliers: FloatArray  # (LARGEST_SET,) of these


@kernel_part
def make_point(n_stages: int, width: int, n_rows: int) -> Point:
    """Return a trajectory of zeros that leaves nothing."""
    shape = n_stages, width
    misfits = np.zeros((n_stages, 2 * n_rows))
    return Point(np.zeros(shape), np.zeros(shape), misfits, np.zeros(shape))


@kernel_part
def make_factor(n_stages: int, n: int, n_rows: int, size: int, width: int) -> Factor:
    """Allocate a factor for windows of up to L stages, and working space.

    Args:
        n_stages: L.
        n: Components of a state.
        n_rows: M.
        size: Components that a row may depend on.
        width: Length of padded rows.
    """
    n_updates = n + 2 * n_rows
    return Factor(
        np.zeros(1, np.int64),
        np.zeros((n_stages, n), np.int64),
        np.zeros((n_stages, n, width)),
        np.empty((n, width)),
        np.zeros(n_stages, np.int64),
        np.zeros(n_stages, np.int64),
        np.empty((n_stages, n_updates), np.int64),
        np.empty((n_stages, n_updates), np.int64),
        np.empty((n_stages, n_updates, size)),
        np.empty((n_stages, n_updates)),
        np.empty((n_stages, n_updates, width)),
        np.empty((n_stages, n_updates)),
        np.empty((2, n, width)),
        np.zeros((4, width)),
    )


@kernel_part
def factorise(road: RoadArrays, window: Window, side: IntArray, factor: Factor) -> bool:
    """Filter covariances from the first stage whose set of bounds changed; return success."""
    n, n_stages, start = window.lower.size, window.targets.shape[0], 0
    while start < factor.length[0] and _is_same(side[start], factor.side[start]):
        start += 1
    for t in range(start, n_stages):
        P = factor.covariances[t]
        if t == 0:
            for i in range(n):
                fill_vector(P[i], 0.0)
                P[i, i] = window.arrival_variance[i]
        else:
            blocks, by_factor = window.blocks[t - 1], window.by_factor[t - 1]
            noise, previous = window.process_variance[t - 1], factor.covariances[t - 1]
            propagate(road, blocks, by_factor, noise, previous, factor.scratch, P)
            mirror(P)
        if t == n_stages - 1:
            copy_matrix(P, factor.before)
        factor.length[0], factor.n_updates[t] = t, 0
        if not (_fix(factor, t, side[t]) and _take_rows(road, window, factor, t)):
            return False
    factor.length[0] = n_stages
    return True


@kernel_part
def _fix(factor: Factor, t: int, side: IntArray) -> bool:
    """Condition a stage's covariance on the components of a set; return success."""
    P, known, column, u = factor.covariances[t], np.ones(1), factor.vectors[0], 0
    for i in range(P.shape[0]):
        factor.side[t, i] = side[i]
        if side[i] == 0:
            continue
        factor.first[t, u], factor.size[t, u], factor.rows[t, u, 0] = i, 1, 1.0
        gain = factor.gains[t, u]
        factor.totals[t, u] = scalar_update(P, i, known, 0.0, column, gain)
        if not factor.totals[t, u] > 0.0:
            return False
        gain[i] = 1.0  # without rounding, so that the component becomes what it is known to be
        for j in range(P.shape[0]):
            P[i, j] = P[j, i] = 0.0
        u += 1
    factor.n_fixed[t] = factor.n_updates[t] = u
    return True


@kernel_part
def _take_rows(road: RoadArrays, window: Window, factor: Factor, t: int) -> bool:
    """Update a stage's covariance by its observed rows; return success."""
    P, work, u = factor.covariances[t], factor.vectors, factor.n_fixed[t]
    for m in range(road.row_first.size):
        if not window.observed[t, m]:
            continue
        first, size, noise = 2 * road.row_first[m], 2 * road.row_span[m], window.noise[t, m]
        rows = window.weights[t, m, :, :size]
        if not pair_update(P, first, rows, noise, work):
            return False
        for q in range(2):
            factor.first[t, u], factor.size[t, u] = first, size
            factor.totals[t, u] = noise[q]
            for i in range(size):
                factor.rows[t, u, i] = rows[q, i]
                factor.totals[t, u] += rows[q, i] * work[q, first + i]
            copy_vector(work[2 + q], factor.gains[t, u])
            u += 1
    mirror(P)
    factor.n_updates[t] = u
    return True


@kernel_part
def _is_same(one: IntArray, other: IntArray) -> bool:
    for i in range(other.size):  # noqa: SIM110, a generator takes longer to compile
        if one[i] != other[i]:
            return False
    return True


@kernel_part
def sweep(
    road: RoadArrays,
    window: Window,
    factor: Factor,
    start: int,
    point: Point,
    by_force: bool,
    step: FloatArray,
) -> None:
    """Write the step from a point to the minimum, the factor's set fixed: H step = force.

    It is found from gaps and misfits, as a filter's means are: where there is far to go, forces are
    large numbers that cancel, and lose all digits. Next to the minimum, forces vanish and tell
    more. From a force of one on one component, by force, the step is a column of H^-1.

    Forwards, a filter's means; backwards, with the costate l of the next stage, d = m + P A' l.

    Args:
        road: The road.
        window: The window.
        factor: Its factor.
        start: The point leaves nothing before this stage.
        point: The point.
        by_force: Whether to go by its force, or by its gaps and misfits.
        step: `(L, padded)`, written.
    """
    _go_forwards(road, window, factor, start, point, by_force, step)
    _come_back(road, window, factor, start, point, by_force, step)


@kernel_part
def _go_forwards(
    road: RoadArrays,
    window: Window,
    factor: Factor,
    start: int,
    point: Point,
    by_force: bool,
    step: FloatArray,
) -> None:
    """Write means, and the residuals of updates."""
    n_factors = window.lower.size - 2 * road.jam.size
    for t in range(start):
        step[t, :] = 0.0
        factor.pulls[t, :] = 0.0
    for t in range(start, step.shape[0]):
        mean, n_fixed = step[t], factor.n_fixed[t]
        if t == start:
            mean[:] = 0.0
        else:
            move(road, window.blocks[t - 1], window.by_factor[t - 1], n_factors, step[t - 1], mean)
        if not by_force:
            _add(1.0, point.gaps[t], mean)
        for u in range(factor.n_updates[t]):
            gap = 0.0 if by_force or u < n_fixed else point.misfits[t, u - n_fixed]
            for i in range(factor.size[t, u]):
                gap -= factor.rows[t, u, i] * mean[factor.first[t, u] + i]
            _add(gap, factor.gains[t, u], mean)
            factor.pulls[t, u] = gap / factor.totals[t, u]
        if by_force:
            add_product(factor.covariances[t], point.force[t], mean)


@kernel_part
def _come_back(
    road: RoadArrays,
    window: Window,
    factor: Factor,
    start: int,
    point: Point,
    by_force: bool,
    step: FloatArray,
) -> None:
    """Turn means into the minimum, by what later stages pull."""
    n, costate, pull = window.lower.size, factor.vectors[2], factor.vectors[3]
    costate[:] = 0.0
    for t in range(step.shape[0] - 1, -1, -1):
        if t < step.shape[0] - 1:
            blocks, by_factor = window.blocks[t], window.by_factor[t]
            move_back(road, blocks, by_factor, n - 2 * road.jam.size, costate, pull)
            add_product(factor.covariances[t], pull, step[t])
            copy_vector(pull, costate)
        for i in range(n if by_force and t >= start else 0):
            if factor.side[t, i] == 0:
                costate[i] += point.force[t, i]
        for u in range(factor.n_updates[t] - 1, -1, -1):
            multiplier = factor.pulls[t, u] - _dot(factor.gains[t, u], costate)
            for i in range(factor.size[t, u]):
                costate[factor.first[t, u] + i] += multiplier * factor.rows[t, u, i]


@kernel_part
def fix(
    road: RoadArrays,
    window: Window,
    factor: Factor,
    columns: Columns,
    z: FloatArray,
    side: IntArray,
    step: FloatArray,
) -> bool:
    """Correct a free step so that components of a set get to their bounds; return success.

    It does what a `sweep` with the set would, from the factor without one, by columns of H^-1. It
    fails where they are too many, or the set is not of full rank.

    Args:
        road: The road.
        window: The window.
        factor: Its factor without components at bounds.
        columns: Known columns, to which others are added; members and multipliers are written.
        z: `(L, padded)` the trajectory.
        side: `(L, padded)` the set.
        step: `(L, padded)` the free step, replaced.
    """
    m, members, unit = 0, columns.members, columns.unit
    for t in range(step.shape[0]):
        for i in range(window.lower.size):
            if side[t, i] == 0:
                continue
            known = columns.known[0]
            if m == LARGEST_SET or (columns.slot[t, i] < 0 and known == LARGEST_SET):
                return False
            members[m, 0], members[m, 1], m = t, i, m + 1
            if columns.slot[t, i] < 0:
                unit.force[t, i], column = 1.0, columns.inverse[known]
                sweep(road, window, factor, t, unit, True, column)
                unit.force[t, i] = 0.0
                columns.slot[t, i], columns.known[0] = known, known + 1
    matrix, needed = np.empty((m, m)), columns.multipliers
    for a in range(m):
        t, i = members[a, 0], members[a, 1]
        bound = window.lower[i] if side[t, i] < 0 else window.upper[i]
        needed[a] = bound - z[t, i] - step[t, i]
        column = columns.inverse[columns.slot[t, i]]
        for b in range(a, m):
            matrix[b, a] = column[members[b, 0], members[b, 1]]
    if not cholesky(matrix):
        return False
    solve(matrix, needed[:m])
    for a in range(m):
        column = columns.inverse[columns.slot[members[a, 0], members[a, 1]]]
        for t in range(step.shape[0]):
            _add(needed[a], column[t], step[t])
    for a in range(m):
        t, i = members[a, 0], members[a, 1]
        step[t, i] = (window.lower[i] if side[t, i] < 0 else window.upper[i]) - z[t, i]
    return True


@kernel_part(fastmath={"contract"})
def _add(scale: float, x: FloatArray, out: FloatArray) -> None:
    for j in range(out.size):
        out[j] += scale * x[j]


@kernel_part(fastmath={"contract", "reassoc"})
def _dot(x: FloatArray, y: FloatArray) -> float:
    total = 0.0
    for j in range(x.size):
        total += x[j] * y[j]
    return total


@kernel_part
def look(road: RoadArrays, window: Window, point: Point) -> None:
    """Write the gaps, misfits and force of a point's trajectory."""
    z, gaps, force, n = point.z, point.gaps, point.force, window.lower.size
    n_factors, pull, weighed = n - 2 * road.jam.size, np.empty(z.shape[1]), np.empty(z.shape[1])
    for i in range(n):
        gaps[0, i] = window.arrival[i] - z[0, i]
        force[0, i] = gaps[0, i] / window.arrival_variance[i]
    for t in range(1, z.shape[0]):
        blocks, by_factor = window.blocks[t - 1], window.by_factor[t - 1]
        move(road, blocks, by_factor, n_factors, z[t - 1], weighed)
        for i in range(n):
            gaps[t, i] = weighed[i] + window.offsets[t - 1, i] - z[t, i]
            force[t, i] = weighed[i] = gaps[t, i] / window.process_variance[t - 1, i]
        move_back(road, blocks, by_factor, n_factors, weighed, pull)
        for i in range(n):
            force[t - 1, i] -= pull[i]
    for t in range(z.shape[0]):
        r = 0
        for m in range(road.row_first.size):
            if not window.observed[t, m]:
                continue
            first, size = 2 * road.row_first[m], 2 * road.row_span[m]
            for q in range(2):
                row, gap = window.weights[t, m, q], window.targets[t, m, q]
                for i in range(size):
                    gap -= row[i] * z[t, first + i]
                point.misfits[t, r], r = gap, r + 1
                for i in range(size):
                    force[t, first + i] += row[i] * gap / window.noise[t, m, q]


@kernel_part
def write_diagonal(road: RoadArrays, window: Window, diagonal: FloatArray) -> None:
    """Write the diagonal `(L, padded)` of H, in whose units a residual is measured."""
    n, n_stages = 2 * road.jam.size, diagonal.shape[0]
    for t in range(n_stages):
        variance = window.arrival_variance if t == 0 else window.process_variance[t - 1]
        for i in range(variance.size):
            diagonal[t, i] = 1.0 / variance[i]
        for m in range(road.row_first.size):
            if not window.observed[t, m]:
                continue
            for q in range(2):
                for i in range(2 * road.row_span[m]):
                    weight = window.weights[t, m, q, i]
                    diagonal[t, 2 * road.row_first[m] + i] += weight**2 / window.noise[t, m, q]
    for t in range(n_stages - 1):
        out, K = diagonal[t], window.process_variance[t]
        for c in range(road.jam.size):
            for slot in range(road.degree[c]):
                b, block = road.neighbours[c, slot], window.blocks[t, c, slot]
                out[2 * b] += block[0] ** 2 / K[2 * c] + block[2] ** 2 / K[2 * c + 1]
                out[2 * b + 1] += block[1] ** 2 / K[2 * c] + block[3] ** 2 / K[2 * c + 1]
        for e in range(K.size - n):
            c, by_factor = road.entries[e], window.by_factor[t, e]
            out[n + e] += by_factor[0] ** 2 / K[2 * c] + by_factor[1] ** 2 / K[2 * c + 1]
            out[n + e] += 1.0 / K[n + e]


@kernel_part
def minimise(
    road: RoadArrays, window: Window, factor: Factor, side: IntArray, z: FloatArray
) -> int:
    """Replace a trajectory by the minimiser; return how, or `UNSOLVED`.

    A solution is accepted by its natural residual |z - clip(z - g / diag H, lower, upper)|.

    Args:
        road: The road.
        window: The window.
        factor: Its factor without components at bounds; another one afterwards.
        side: `(L, padded)` a guess of the set of bounds, replaced.
        z: `(L, padded)` a guess of the trajectory, replaced.
    """
    n_stages, width, n_rows = *z.shape, road.row_first.size
    here, there = make_point(n_stages, width, n_rows), make_point(n_stages, width, n_rows)
    diagonal = np.ones((n_stages, width))
    write_diagonal(road, window, diagonal)
    _clip(window.lower, window.upper, z, 0.0, z, here.z)
    look(road, window, here)
    if _find_set(road, window, factor, diagonal, side, here, there):
        copy_matrix(there.z, z)
        return ACTIVE_SET
    if _descend(road, window, factor, diagonal, side, here, there, z):
        return NEWTON
    return UNSOLVED


@kernel_part
def _find_set(
    road: RoadArrays,
    window: Window,
    factor: Factor,
    diagonal: FloatArray,
    side: IntArray,
    here: Point,
    there: Point,
) -> bool:
    """Look for the set of bounds, and write its minimum to `there`; return whether it is one."""
    n, n_stages, width = window.lower.size, *there.z.shape
    columns = Columns(
        np.zeros(1, np.int64),
        np.full((n_stages, n), -1),
        np.empty((LARGEST_SET, n_stages, width)),
        make_point(n_stages, width, 0),
        np.empty((LARGEST_SET, 2), np.int64),
        np.empty(LARGEST_SET),
    )
    lower, upper = window.lower, window.upper
    free, step = np.empty((n_stages, width)), np.empty((n_stages, width))
    sweep(road, window, factor, 0, here, False, free)
    for _ in range(ROUNDS):
        copy_matrix(free, step)
        if not fix(road, window, factor, columns, here.z, side, step):
            return False
        if not _revise(lower, upper, columns.multipliers, here.z, step, side):
            break
    else:
        return False
    _clip(lower, upper, here.z, 1.0, step, there.z)
    for _ in range(CORRECTIONS):
        look(road, window, there)
        if _residual(lower, upper, diagonal, there) <= REFINED:
            return True
        sweep(road, window, factor, 0, there, True, step)
        fix(road, window, factor, columns, there.z, side, step)
        _clip(lower, upper, there.z, 1.0, step, there.z)
    look(road, window, there)
    return _residual(lower, upper, diagonal, there) <= ACCEPTED


@kernel_part
def _revise(
    lower: FloatArray,
    upper: FloatArray,
    multipliers: FloatArray,
    z: FloatArray,
    step: FloatArray,
    side: IntArray,
) -> bool:
    """Release components that pull inwards, add those far outside; return whether any did."""
    changed, least, a = False, AT_BOUND, 0
    for t in range(z.shape[0]):
        for i in range(lower.size):
            if side[t, i] == 0:
                value = z[t, i] + step[t, i]
                least = max(least, ADDED * max(lower[i] - value, value - upper[i]))
    for t in range(z.shape[0]):
        for i in range(lower.size):
            value, new = z[t, i] + step[t, i], side[t, i]
            if new != 0:
                new = 0 if multipliers[a] * new > 0.0 else new
                a += 1
            elif value < lower[i] - least:
                new = -1
            elif value > upper[i] + least:
                new = 1
            if new != side[t, i]:
                side[t, i], changed = new, True
    return changed


@kernel_part
def _descend(
    road: RoadArrays,
    window: Window,
    factor: Factor,
    diagonal: FloatArray,
    side: IntArray,
    here: Point,
    there: Point,
    z: FloatArray,
) -> bool:
    """Bring a point within bounds down to the minimum, and write it; return whether it is there.

    Components that the gradient presses against their bound are fixed. The step to the minimum of
    the others is clipped to the bounds, and halved until the objective falls far enough. After some
    halvings it ends at the first bound instead, so that the objective falls in any case: components
    at a bound that it would take across are fixed as well, until there is none.
    """
    lower, upper, step = window.lower, window.upper, np.empty(z.shape)
    residual = _residual(lower, upper, diagonal, here)
    for _ in range(NEWTON_ROUNDS):
        if residual <= REFINED:
            break
        for t in range(z.shape[0]):
            for i in range(lower.size):
                at_lower = here.z[t, i] <= lower[i] and here.force[t, i] < 0.0
                at_upper = here.z[t, i] >= upper[i] and here.force[t, i] > 0.0
                side[t, i] = int(at_upper) - int(at_lower)
        is_near, before, length, found = residual <= NEAR, residual, 1.0, False
        if not _step_on(road, window, factor, side, here, is_near, step):
            return False
        for halving in range(HALVINGS + 1):
            if halving == HALVINGS:
                length = _reach(lower, upper, here.z, step, side)
                while length < 0.0:
                    if not _step_on(road, window, factor, side, here, is_near, step):
                        return False
                    length = _reach(lower, upper, here.z, step, side)
            _clip(lower, upper, here.z, length, step, there.z)
            look(road, window, there)
            residual = _residual(lower, upper, diagonal, there)
            # Next to the minimum, rounding decides whether the objective falls.
            found = (is_near and residual <= 0.5 * before) or _falls(lower.size, here, there)
            if found:
                break
            length *= 0.5
        if before <= ACCEPTED and not (found and residual < before):
            residual = before
            break
        if not found:
            return False
        here, there = there, here
    copy_matrix(here.z, z)
    return residual <= ACCEPTED


@kernel_part
def _step_on(
    road: RoadArrays,
    window: Window,
    factor: Factor,
    side: IntArray,
    point: Point,
    is_near: bool,
    step: FloatArray,
) -> bool:
    """Write the step to the minimum with a set fixed; return success."""
    sound = factorise(road, window, side, factor)
    if sound:
        sweep(road, window, factor, 0, point, is_near, step)
    return sound


@kernel_part
def _reach(
    lower: FloatArray, upper: FloatArray, z: FloatArray, step: FloatArray, side: IntArray
) -> float:
    """Return how far a step goes up to the first bound, 0 to 1.

    It is -1 where the step takes components at a bound across it; these join the set.
    """
    length, crosses, stage, component = 1.0, False, -1, -1
    for t in range(z.shape[0]):
        for i in range(lower.size):
            d = step[t, i]
            if side[t, i] != 0 or d == 0.0:
                continue
            room = lower[i] - z[t, i] if d < 0.0 else upper[i] - z[t, i]
            if room == 0.0:
                side[t, i], crosses = (-1 if d < 0.0 else 1), True
            elif room / d < length:
                length, stage, component = room / d, t, i
    if crosses:
        return -1.0
    if stage >= 0:  # so that rounding does not leave it next to the bound
        step[stage, component] *= 1.0 + 1e-12
    return length


@kernel_part
def _falls(n: int, here: Point, there: Point) -> bool:
    """Return whether the objective falls far enough from one point to another."""
    along, change = 0.0, 0.0
    for t in range(here.z.shape[0]):
        for i in range(n):
            step = there.z[t, i] - here.z[t, i]
            along -= here.force[t, i] * step
            change -= 0.5 * (here.force[t, i] + there.force[t, i]) * step
    return change <= SUFFICIENT * along


@kernel_part
def _clip(
    lower: FloatArray,
    upper: FloatArray,
    z: FloatArray,
    length: float,
    step: FloatArray,
    out: FloatArray,
) -> None:
    """Write a trajectory some way along a step, clipped to the bounds."""
    for t in range(z.shape[0]):
        for i in range(lower.size):
            value = z[t, i] + length * step[t, i]
            if value < lower[i] + AT_BOUND:
                value = lower[i]
            elif value > upper[i] - AT_BOUND:
                value = upper[i]
            out[t, i] = value


@kernel_part
def _residual(lower: FloatArray, upper: FloatArray, diagonal: FloatArray, point: Point) -> float:
    """Return the largest |z - clip(z - g / diag H, lower, upper)|, g = -force; it may be NaN."""
    largest = 0.0
    for t in range(diagonal.shape[0]):
        for i in range(lower.size):
            target = point.z[t, i] + point.force[t, i] / diagonal[t, i]
            gap = abs(point.z[t, i] - min(max(target, lower[i]), upper[i]))
            if not gap <= largest:  # also true for a NaN
                largest = gap
    return largest
