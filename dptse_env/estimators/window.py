"""The bounded least-squares program of a window, and its solution by forward and backward sweeps.

A window is a chain of L states z_0, ..., z_{L-1} within bounds, which minimise

    J(z) = (z_0 - m)' P_0^-1 (z_0 - m)
         + sum_t (z_{t+1} - A_t z_t - b_t)' Q_t^-1 (z_{t+1} - A_t z_t - b_t)
         + sum_t (y_t - C_t z_t)' R_t^-1 (y_t - C_t z_t)

with the arrival's mean m and variance P_0, defects of the transitions and residuals of what was
measured. Half its Hessian, H, is block-tridiagonal, and its factorisation in the order of time is
the forward pass of a Kalman filter. A component at a bound is a measurement without noise. So a
filter's forward pass and the backward pass of Bryson and Frazier (1963) give the minimum for a
given active set, the components at bounds.

`minimise` looks for the active set. An active-set method adds the components that are most outside
of their bounds and removes those whose multiplier points inwards, by columns of H^-1 from a factor
without a set; it is fast but may cycle. Then a projected Newton method (Bertsekas, 1982), whose
objective decreases in every round, factorises anew for each set. All quantities are normalised.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.linalg import (
    add_product,
    apply,
    apply_transposed,
    divide_by_noise,
    mirror,
    pair_update,
    propagate,
    scalar_update,
    solve,
)
from dptse_env.estimators.linalg import factor as cholesky
from dptse_env.model.arrays import Channels
from dptse_env.road import Road
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import copy_matrix, copy_vector, fill_vector, kernel_part

# How a program was solved.
UNSOLVED, ACTIVE_SET, NEWTON = 0, 1, 2
# Components so near to a bound are set to it: a speed is a quotient of numbers that may vanish.
AT_BOUND = 1e-13
LARGEST_SET = 96  # components at a bound, in the active-set method
# The natural residual above which a solution is corrected again, the largest accepted one, and the
# one from which on it is the residual that has to decrease.
REFINED, ACCEPTED, NEAR = 3e-13, 1e-9, 1e-7
# Components join the set if they are outside by more than this share of the largest excess: the
# others mostly come back with it, and would cost a column of H^-1 each.
ADDED = 0.9
ROUNDS = 50  # of the active-set method
NEWTON_ROUNDS, HALVINGS, CORRECTIONS = 200, 4, 6
SUFFICIENT = 1e-4  # share of the decrease along the gradient that is enough (Armijo, 1966)


class Window(NamedTuple):
    """A linearised window of L stages, normalised; what belongs to transitions has L - 1 or L."""

    arrival: FloatArray  # (n_x,) mean of the first state
    arrival_variance: FloatArray  # (n_x,)
    blocks: FloatArray  # (L, S, K, 4) of the transitions A that leave each stage
    by_factor: FloatArray  # (L, E, 3) derivatives by demand factors; see `multiply`
    offsets: FloatArray  # (L, n_x)
    process_variance: FloatArray  # (L, n_x) of Q; see `add_noise`
    slopes: FloatArray  # (L, S) of Q
    observed: BoolArray  # (L, M)
    weights: FloatArray  # (L, M, 2, 2 x largest span) of both numbers of each row
    targets: FloatArray  # (L, M, 2) values less the constants of the linearisation
    noise: FloatArray  # (L, M, 2) variances
    lower: FloatArray  # (n_x,)
    upper: FloatArray  # (n_x,)


class Iterate(NamedTuple):
    """A trajectory with its defects, residuals and gradient."""

    z: FloatArray  # (L, padded)
    defects: FloatArray  # (L, padded) m - z_0, then A z_t + b - z_{t+1} of each transition
    residuals: FloatArray  # (L, 2 M) y - C z of the observed numbers, one after the other
    negative_gradient: FloatArray  # (L, padded) of J / 2, -(H z + q / 2)


class Factor(NamedTuple):
    """The factor of a window for an active set, and working space of sweeps.

    The updates of a stage, U at most, are those of components at bounds, then of observed numbers.
    """

    length: IntArray  # (1,) stages that are factorised
    active_set: IntArray  # (L, n_x) -1 at the lower bound, 1 at the upper one, 0 free
    covariances: FloatArray  # (L, n_x, padded) filtered
    before: FloatArray  # (n_x, padded) the last one before its stage's updates
    n_active: IntArray  # (L,) components at a bound
    n_updates: IntArray  # (L,)
    first: IntArray  # (L, U) the first components that the updates' numbers depend on,
    size: IntArray  # (L, U) the number of these
    rows: FloatArray  # (L, U, 2 x largest span) and the derivatives
    totals: FloatArray  # (L, U) variances of the updates' numbers
    gains: FloatArray  # (L, U, padded)
    weighted_residuals: FloatArray  # (L, U) over these variances, in a sweep
    scratch: FloatArray  # (2, n_x, padded)
    vectors: FloatArray  # (4, padded)


class Columns(NamedTuple):
    """Columns of H^-1 for components at bounds."""

    known: IntArray  # (1,) their number
    slot: IntArray  # (L, n_x) which one is that of a component, -1 for none
    inverse: FloatArray  # (LARGEST_SET, L, padded)
    unit: Iterate  # zero, but for the component whose column is written
    members: IntArray  # (LARGEST_SET, 2) stage and component of those at a bound
    multipliers: FloatArray  # (LARGEST_SET,) of these


@kernel_part
def make_iterate(n_stages: int, width: int, n_channels: int) -> Iterate:
    """Return a trajectory of zeros without defects and residuals."""
    shape = n_stages, width
    residuals = np.zeros((n_stages, 2 * n_channels))
    return Iterate(np.zeros(shape), np.zeros(shape), residuals, np.zeros(shape))


@kernel_part
def make_factor(n_stages: int, n: int, n_channels: int, size: int, width: int) -> Factor:
    """Allocate a factor for windows of up to L stages, and working space.

    Args:
        n_stages: L.
        n: Components of a state.
        n_channels: M.
        size: Components that a row may depend on.
        width: Length of padded rows.
    """
    n_updates = n + 2 * n_channels
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
def factorise(
    road: Road, channels: Channels, window: Window, active_set: IntArray, factor: Factor
) -> bool:
    """Filter covariances from the first stage whose active set changed; return success."""
    n, n_stages, start = window.lower.size, window.targets.shape[0], 0
    while start < factor.length[0] and _is_same(active_set[start], factor.active_set[start]):
        start += 1
    for t in range(start, n_stages):
        P = factor.covariances[t]
        if t == 0:
            for i in range(n):
                fill_vector(P[i], 0.0)
                P[i, i] = window.arrival_variance[i]
        else:
            blocks, by_factor = window.blocks[t - 1], window.by_factor[t - 1]
            noise, slopes = window.process_variance[t - 1], window.slopes[t - 1]
            previous = factor.covariances[t - 1]
            propagate(road, blocks, by_factor, noise, slopes, previous, factor.scratch, P)
            mirror(P)
        if t == n_stages - 1:
            copy_matrix(P, factor.before)
        factor.length[0], factor.n_updates[t] = t, 0
        if not (
            _condition(factor, t, active_set[t])
            and _update_by_channels(channels, window, factor, t)
        ):
            return False
    factor.length[0] = n_stages
    return True


@kernel_part
def _condition(factor: Factor, t: int, active_set: IntArray) -> bool:
    """Condition a stage's covariance on the components at bounds; return success."""
    P, known, column, u = factor.covariances[t], np.ones(1), factor.vectors[0], 0
    for i in range(P.shape[0]):
        factor.active_set[t, i] = active_set[i]
        if active_set[i] == 0:
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
    factor.n_active[t] = factor.n_updates[t] = u
    return True


@kernel_part
def _update_by_channels(channels: Channels, window: Window, factor: Factor, t: int) -> bool:
    """Update a stage's covariance by what is observed; return success."""
    P, work, u = factor.covariances[t], factor.vectors, factor.n_active[t]
    for m in range(channels.first.size):
        if not window.observed[t, m]:
            continue
        first, size, noise = 2 * channels.first[m], 2 * channels.span[m], window.noise[t, m]
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
    road: Road,
    window: Window,
    factor: Factor,
    start: int,
    iterate: Iterate,
    from_gradient: bool,
    step: FloatArray,
) -> None:
    """Write the step from an iterate to the minimum on the factor's active set.

    Far from the optimum the gradient is a difference of large numbers, so the step is computed
    from defects and residuals, as a filter computes its means; near the optimum the gradient is
    more accurate. From a gradient of -1 in one component alone, the step is a column of H^-1.

    Args:
        road: The road.
        window: The window.
        factor: Its factor.
        start: The iterate has no defects, residuals and gradient before this stage.
        iterate: The iterate.
        from_gradient: Whether to solve H step = negative_gradient, or to use defects and residuals.
        step: `(L, padded)`, written.
    """
    _sweep_forwards(road, window, factor, start, iterate, from_gradient, step)
    _sweep_backwards(road, window, factor, start, iterate, from_gradient, step)


@kernel_part
def _sweep_forwards(
    road: Road,
    window: Window,
    factor: Factor,
    start: int,
    iterate: Iterate,
    from_gradient: bool,
    step: FloatArray,
) -> None:
    """Write a filter's means of the step, and the weighted residuals of its updates."""
    n_factors = window.lower.size - 2 * road.n_segments
    for t in range(start):
        step[t, :] = 0.0
        factor.weighted_residuals[t, :] = 0.0
    for t in range(start, step.shape[0]):
        mean, n_active = step[t], factor.n_active[t]
        if t == start:
            mean[:] = 0.0
        else:  # mean = A mean + defect
            apply(road, window.blocks[t - 1], window.by_factor[t - 1], n_factors, step[t - 1], mean)
        if not from_gradient:
            _add(1.0, iterate.defects[t], mean)
        for u in range(factor.n_updates[t]):
            # mean = mean + k (r - h' mean), with the gain k (Kalman, 1960)
            r = 0.0 if from_gradient or u < n_active else iterate.residuals[t, u - n_active]
            for i in range(factor.size[t, u]):
                r -= factor.rows[t, u, i] * mean[factor.first[t, u] + i]
            _add(r, factor.gains[t, u], mean)
            factor.weighted_residuals[t, u] = r / factor.totals[t, u]
        if from_gradient:
            add_product(factor.covariances[t], iterate.negative_gradient[t], mean)


@kernel_part
def _sweep_backwards(
    road: Road,
    window: Window,
    factor: Factor,
    start: int,
    iterate: Iterate,
    from_gradient: bool,
    step: FloatArray,
) -> None:
    """Turn the means into the step, by the costates l of later stages."""
    n, costate, adjoint = window.lower.size, factor.vectors[2], factor.vectors[3]
    costate[:] = 0.0
    for t in range(step.shape[0] - 1, -1, -1):
        if t < step.shape[0] - 1:
            # l = A' l and step = mean + P l (Bryson and Frazier, 1963)
            blocks, by_factor = window.blocks[t], window.by_factor[t]
            apply_transposed(road, blocks, by_factor, n - 2 * road.n_segments, costate, adjoint)
            add_product(factor.covariances[t], adjoint, step[t])
            copy_vector(adjoint, costate)
        for i in range(n if from_gradient and t >= start else 0):
            if factor.active_set[t, i] == 0:
                costate[i] += iterate.negative_gradient[t, i]
        for u in range(factor.n_updates[t] - 1, -1, -1):
            # l = l + h (r / s - k' l), with the variance s of the number
            multiplier = factor.weighted_residuals[t, u] - _dot(factor.gains[t, u], costate)
            for i in range(factor.size[t, u]):
                costate[factor.first[t, u] + i] += multiplier * factor.rows[t, u, i]


@kernel_part
def solve_on_active_set(
    road: Road,
    window: Window,
    factor: Factor,
    columns: Columns,
    z: FloatArray,
    active_set: IntArray,
    step: FloatArray,
) -> bool:
    """Correct a free step so that an active set gets to its bounds; return success.

    It does what a `sweep` with the set would, from the factor without one, by columns of H^-1. It
    fails where the set has more than `LARGEST_SET` components or is not of full rank.

    Args:
        road: The road.
        channels: What is measured.
        window: The window.
        factor: Its factor without components at bounds.
        columns: Known columns, to which others are added; members and multipliers are written.
        z: `(L, padded)` the trajectory.
        active_set: `(L, padded)`.
        step: `(L, padded)` the free step, replaced.
    """
    m, members, unit = 0, columns.members, columns.unit
    for t in range(step.shape[0]):
        for i in range(window.lower.size):
            if active_set[t, i] == 0:
                continue
            known = columns.known[0]
            if m == LARGEST_SET or (columns.slot[t, i] < 0 and known == LARGEST_SET):
                return False
            members[m, 0], members[m, 1], m = t, i, m + 1
            if columns.slot[t, i] < 0:
                unit.negative_gradient[t, i], column = 1.0, columns.inverse[known]
                sweep(road, window, factor, t, unit, True, column)
                unit.negative_gradient[t, i] = 0.0
                columns.slot[t, i], columns.known[0] = known, known + 1
    # (H^-1)_AA multipliers = bounds - z - step on the set A; step = step + H^-1_A multipliers
    matrix, multipliers = np.empty((m, m)), columns.multipliers
    for a in range(m):
        t, i = members[a, 0], members[a, 1]
        bound = window.lower[i] if active_set[t, i] < 0 else window.upper[i]
        multipliers[a] = bound - z[t, i] - step[t, i]
        column = columns.inverse[columns.slot[t, i]]
        for b in range(a, m):
            matrix[b, a] = column[members[b, 0], members[b, 1]]
    if not cholesky(matrix):
        return False
    solve(matrix, multipliers[:m])
    for a in range(m):
        column = columns.inverse[columns.slot[members[a, 0], members[a, 1]]]
        for t in range(step.shape[0]):
            _add(multipliers[a], column[t], step[t])
    for a in range(m):
        t, i = members[a, 0], members[a, 1]
        step[t, i] = (window.lower[i] if active_set[t, i] < 0 else window.upper[i]) - z[t, i]
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
def evaluate(road: Road, channels: Channels, window: Window, iterate: Iterate) -> None:
    """Write the defects, residuals and gradient of an iterate's trajectory."""
    z, defects, descent, n = (
        iterate.z,
        iterate.defects,
        iterate.negative_gradient,
        window.lower.size,
    )
    n_factors, adjoint, weighted = (
        n - 2 * road.n_segments,
        np.empty(z.shape[1]),
        np.empty(z.shape[1]),
    )
    for i in range(n):  # d_0 = m - z_0
        defects[0, i] = window.arrival[i] - z[0, i]
        descent[0, i] = defects[0, i] / window.arrival_variance[i]
    for t in range(1, z.shape[0]):
        blocks, by_factor = window.blocks[t - 1], window.by_factor[t - 1]
        apply(road, blocks, by_factor, n_factors, z[t - 1], weighted)
        # d_t = A z_{t-1} + b - z_t adds Q^-1 d_t to stage t and -A' Q^-1 d_t to stage t - 1
        for i in range(n):
            defects[t, i] = weighted[i] + window.offsets[t - 1, i] - z[t, i]
            weighted[i] = defects[t, i]
        divide_by_noise(window.process_variance[t - 1], window.slopes[t - 1], weighted)
        for i in range(n):
            descent[t, i] = weighted[i]
        apply_transposed(road, blocks, by_factor, n_factors, weighted, adjoint)
        for i in range(n):
            descent[t - 1, i] -= adjoint[i]
    for t in range(z.shape[0]):
        u = 0
        for m in range(channels.first.size):
            if not window.observed[t, m]:
                continue
            first, size = 2 * channels.first[m], 2 * channels.span[m]
            for q in range(2):  # r = y - c' z_t adds c r / R
                row, r = window.weights[t, m, q], window.targets[t, m, q]
                for i in range(size):
                    r -= row[i] * z[t, first + i]
                iterate.residuals[t, u], u = r, u + 1
                for i in range(size):
                    descent[t, first + i] += row[i] * r / window.noise[t, m, q]


@kernel_part
def write_diagonal(road: Road, channels: Channels, window: Window, diagonal: FloatArray) -> None:
    """Write the diagonal `(L, padded)` of H, P_0^-1 or Q^-1 plus A' Q^-1 A plus C' R^-1 C."""
    n, n_stages = 2 * road.n_segments, diagonal.shape[0]
    for t in range(n_stages):
        variance = window.arrival_variance if t == 0 else window.process_variance[t - 1]
        for i in range(variance.size):
            diagonal[t, i] = 1.0 / variance[i]
        for s in range(road.n_segments if t > 0 else 0):
            diagonal[t, 2 * s] += window.slopes[t - 1, s] ** 2 / variance[2 * s + 1]
        for m in range(channels.first.size):
            if not window.observed[t, m]:
                continue
            for q in range(2):
                for i in range(2 * channels.span[m]):
                    weight = window.weights[t, m, q, i]
                    diagonal[t, 2 * channels.first[m] + i] += weight**2 / window.noise[t, m, q]
    for t in range(n_stages - 1):
        out, K = diagonal[t], window.process_variance[t]
        for c in range(road.n_segments):
            slope = window.slopes[t, c]
            for slot in range(road.degree[c]):
                b, block = road.neighbours[c, slot], window.blocks[t, c, slot]
                by_rho, by_psi = block[2] - slope * block[0], block[3] - slope * block[1]
                out[2 * b] += block[0] ** 2 / K[2 * c] + by_rho**2 / K[2 * c + 1]
                out[2 * b + 1] += block[1] ** 2 / K[2 * c] + by_psi**2 / K[2 * c + 1]
        for e in range(K.size - n):
            c, by_factor = road.entries[e], window.by_factor[t, e]
            beside = by_factor[1] - window.slopes[t, c] * by_factor[0]
            out[n + e] += by_factor[0] ** 2 / K[2 * c] + beside**2 / K[2 * c + 1]
            out[n + e] += by_factor[2] ** 2 / K[n + e]


@kernel_part
def minimise(
    road: Road,
    channels: Channels,
    window: Window,
    factor: Factor,
    active_set: IntArray,
    z: FloatArray,
) -> int:
    """Replace a trajectory by the minimiser; return how, or `UNSOLVED`.

    A solution is accepted by its `_natural_residual`.

    Args:
        road: The road.
        channels: What is measured.
        window: The window.
        factor: Its factor without components at bounds; another one afterwards.
        active_set: `(L, padded)` a guess, replaced.
        z: `(L, padded)` a guess of the trajectory, replaced.
    """
    n_stages, width, n_channels = *z.shape, channels.first.size
    current, trial = (
        make_iterate(n_stages, width, n_channels),
        make_iterate(n_stages, width, n_channels),
    )
    diagonal = np.ones((n_stages, width))
    write_diagonal(road, channels, window, diagonal)
    _clip(window.lower, window.upper, z, 0.0, z, current.z)
    evaluate(road, channels, window, current)
    if _find_active_set(road, channels, window, factor, diagonal, active_set, current, trial):
        copy_matrix(trial.z, z)
        return ACTIVE_SET
    if _projected_newton(road, channels, window, factor, diagonal, active_set, current, z):
        return NEWTON
    return UNSOLVED


@kernel_part
def _find_active_set(
    road: Road,
    channels: Channels,
    window: Window,
    factor: Factor,
    diagonal: FloatArray,
    active_set: IntArray,
    current: Iterate,
    trial: Iterate,
) -> bool:
    """Look for the active set, and write its minimum to `trial`; return whether it is optimal."""
    n, n_stages, width = window.lower.size, *trial.z.shape
    columns = Columns(
        np.zeros(1, np.int64),
        np.full((n_stages, n), -1),
        np.empty((LARGEST_SET, n_stages, width)),
        make_iterate(n_stages, width, 0),
        np.empty((LARGEST_SET, 2), np.int64),
        np.empty(LARGEST_SET),
    )
    lower, upper = window.lower, window.upper
    free, step = np.empty((n_stages, width)), np.empty((n_stages, width))
    sweep(road, window, factor, 0, current, False, free)
    for _ in range(ROUNDS):
        copy_matrix(free, step)
        if not solve_on_active_set(road, window, factor, columns, current.z, active_set, step):
            return False
        if not _revise_active_set(lower, upper, columns.multipliers, current.z, step, active_set):
            break
    else:
        return False
    _clip(lower, upper, current.z, 1.0, step, trial.z)
    for _ in range(CORRECTIONS):
        evaluate(road, channels, window, trial)
        if _natural_residual(lower, upper, diagonal, trial) <= REFINED:
            return True
        sweep(road, window, factor, 0, trial, True, step)
        solve_on_active_set(road, window, factor, columns, trial.z, active_set, step)
        _clip(lower, upper, trial.z, 1.0, step, trial.z)
    evaluate(road, channels, window, trial)
    return _natural_residual(lower, upper, diagonal, trial) <= ACCEPTED


@kernel_part
def _revise_active_set(
    lower: FloatArray,
    upper: FloatArray,
    multipliers: FloatArray,
    z: FloatArray,
    step: FloatArray,
    active_set: IntArray,
) -> bool:
    """Remove components whose multiplier points inwards, add those that are furthest outside.

    Returns:
        Whether the set changed.
    """
    changed, least, a = False, AT_BOUND, 0
    for t in range(z.shape[0]):
        for i in range(lower.size):
            if active_set[t, i] == 0:
                value = z[t, i] + step[t, i]
                least = max(least, ADDED * max(lower[i] - value, value - upper[i]))
    for t in range(z.shape[0]):
        for i in range(lower.size):
            value, new = z[t, i] + step[t, i], active_set[t, i]
            if new != 0:
                new = 0 if multipliers[a] * new > 0.0 else new
                a += 1
            elif value < lower[i] - least:
                new = -1
            elif value > upper[i] + least:
                new = 1
            if new != active_set[t, i]:
                active_set[t, i], changed = new, True
    return changed


@kernel_part
def _projected_newton(
    road: Road,
    channels: Channels,
    window: Window,
    factor: Factor,
    diagonal: FloatArray,
    active_set: IntArray,
    current: Iterate,
    z: FloatArray,
) -> bool:
    """Minimise from an iterate within bounds by projected Newton steps; return success.

    The active set has the components that the gradient presses against their bound. The step to
    the minimum of the others is clipped to the bounds, and halved until the objective decreases
    enough. After some halvings it ends at the first bound instead, so that the objective decreases
    in any case: components at a bound that it would take across join the set, until there are none.
    """
    lower, upper, step = window.lower, window.upper, np.empty(z.shape)
    residual = _natural_residual(lower, upper, diagonal, current)
    trial = make_iterate(z.shape[0], z.shape[1], channels.first.size)
    for _ in range(NEWTON_ROUNDS):
        if residual <= REFINED:
            break
        for t in range(z.shape[0]):
            for i in range(lower.size):
                at_lower = current.z[t, i] <= lower[i] and current.negative_gradient[t, i] < 0.0
                at_upper = current.z[t, i] >= upper[i] and current.negative_gradient[t, i] > 0.0
                active_set[t, i] = int(at_upper) - int(at_lower)
        is_near, before, length, found = residual <= NEAR, residual, 1.0, False
        if not _newton_step(road, channels, window, factor, active_set, current, is_near, step):
            return False
        for halving in range(HALVINGS + 1):
            if halving == HALVINGS:
                length = _step_to_bound(lower, upper, current.z, step, active_set)
                while length < 0.0:
                    if not _newton_step(
                        road, channels, window, factor, active_set, current, is_near, step
                    ):
                        return False
                    length = _step_to_bound(lower, upper, current.z, step, active_set)
            _clip(lower, upper, current.z, length, step, trial.z)
            evaluate(road, channels, window, trial)
            residual = _natural_residual(lower, upper, diagonal, trial)
            # Near the minimum, rounding decides whether the objective decreases.
            found = (is_near and residual <= 0.5 * before) or _decreases(lower.size, current, trial)
            if found:
                break
            length *= 0.5
        if before <= ACCEPTED and not (found and residual < before):
            residual = before
            break
        if not found:
            return False
        current, trial = trial, current
    copy_matrix(current.z, z)
    return residual <= ACCEPTED


@kernel_part
def _newton_step(
    road: Road,
    channels: Channels,
    window: Window,
    factor: Factor,
    active_set: IntArray,
    iterate: Iterate,
    is_near: bool,
    step: FloatArray,
) -> bool:
    """Write the step to the minimum on an active set; return success."""
    sound = factorise(road, channels, window, active_set, factor)
    if sound:
        sweep(road, window, factor, 0, iterate, is_near, step)
    return sound


@kernel_part
def _step_to_bound(
    lower: FloatArray, upper: FloatArray, z: FloatArray, step: FloatArray, active_set: IntArray
) -> float:
    """Return the share of a step, 0 to 1, up to the first bound.

    Returns -1 if a component already at a bound would leave the feasible set; it is then added to
    the active set.
    """
    length, crosses, stage, component = 1.0, False, -1, -1
    for t in range(z.shape[0]):
        for i in range(lower.size):
            d = step[t, i]
            if active_set[t, i] != 0 or d == 0.0:
                continue
            room = lower[i] - z[t, i] if d < 0.0 else upper[i] - z[t, i]
            if room == 0.0:
                active_set[t, i], crosses = (-1 if d < 0.0 else 1), True
            elif room / d < length:
                length, stage, component = room / d, t, i
    if crosses:
        return -1.0
    if stage >= 0:  # so that rounding does not leave it next to the bound
        step[stage, component] *= 1.0 + 1e-12
    return length


@kernel_part
def _decreases(n: int, current: Iterate, trial: Iterate) -> bool:
    """Return whether the objective decreases enough from one iterate to another."""
    # J(trial) - J(current) <= SUFFICIENT g' (trial - current) (Armijo, 1966)
    along, change = 0.0, 0.0
    for t in range(current.z.shape[0]):
        for i in range(n):
            step = trial.z[t, i] - current.z[t, i]
            along -= current.negative_gradient[t, i] * step
            change -= 0.5 * (current.negative_gradient[t, i] + trial.negative_gradient[t, i]) * step
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
def _natural_residual(
    lower: FloatArray, upper: FloatArray, diagonal: FloatArray, iterate: Iterate
) -> float:
    """Return the largest |z - clip(z - g / diag H, lower, upper)|, g = H z + q / 2; may be NaN."""
    largest = 0.0
    for t in range(diagonal.shape[0]):
        for i in range(lower.size):
            target = iterate.z[t, i] + iterate.negative_gradient[t, i] / diagonal[t, i]
            gap = abs(iterate.z[t, i] - min(max(target, lower[i]), upper[i]))
            if not gap <= largest:  # also true for a NaN
                largest = gap
    return largest
