"""The bounded program of a window, and its solution by forward and backward sweeps.

A window is a chain of L states: `minimise |x_0 - arrival|^2 / variance + sum |x_t+1 - A x_t -
offset|^2 / variance + sum |target - h'x_t|^2 / noise` within bounds. Its Hessian H is
block-tridiagonal, and its factorisation in the order of time is a Kalman filter's forward pass. A
component at a bound is a number that is known: a row with a noise of zero. So a filter's forward
pass and the backward one of Bryson and Frazier (1963) give the minimum for a given set of
components at bounds, and the multipliers of these.

`minimise` looks for the set. An active-set method adds the components that are most outside of
their bounds and releases those whose multiplier points inwards, by columns of H^-1 from a factor
without a set; it is fast but may cycle. Then a projected Newton method (Bertsekas, 1982), whose
objective falls in every round, factorises anew for each set. All quantities are normalised.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.linalg import (
    add_product,
    factor,
    mirror,
    move,
    move_back,
    pair_update,
    propagate,
    scalar_update,
    solve,
)
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import kernel_part

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
    """A linearised window of up to L stages, normalised."""

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


class Work(NamedTuple):
    """The factor of a window for a set of components at bounds, and working space."""

    length: IntArray  # (1,) stages of the factor
    side: IntArray  # (L, padded) its set: -1 at the lower bound, 1 at the upper one, 0 free
    n_fixed: IntArray  # (L,) components of the set in each stage
    covariances: FloatArray  # (L, n_x, padded) filtered
    before: FloatArray  # (n_x, padded) the last one before its stage's measurements
    gains: FloatArray  # (L, n_x, padded) of each component at a bound
    totals: FloatArray  # (L, n_x) variances of these
    n_rows: IntArray  # (L,) observed numbers of each stage,
    first: IntArray  # (L, 2 M) the first components that they depend on,
    size: IntArray  # (L, 2 M) the number of these
    rows: FloatArray  # (L, 2 M, 2 x largest span) and their derivatives over their deviations
    unit: FloatArray  # (L, padded) zero
    diagonal: FloatArray  # (L, padded) of H
    scratch: FloatArray  # (2, n_x, padded)
    columns: FloatArray  # (4, padded)
    vectors: FloatArray  # (2, padded)
    slot: IntArray  # (L, padded) which column of H^-1 is that of a component, -1 for none
    inverse: FloatArray  # (LARGEST_SET, L, padded) these columns
    members: IntArray  # (LARGEST_SET, 2) stage and component of those at a bound


@kernel_part
def make_work(n_stages: int, n_states: int, n_rows: int, size: int, width: int) -> Work:
    """Allocate an empty factor and working space."""
    return Work(
        np.zeros(1, np.int64),
        np.zeros((n_stages, width), np.int64),
        np.zeros(n_stages, np.int64),
        np.zeros((n_stages, n_states, width)),
        np.zeros((n_states, width)),
        np.zeros((n_stages, n_states, width)),
        np.zeros((n_stages, n_states)),
        np.zeros(n_stages, np.int64),
        np.zeros((n_stages, 2 * n_rows), np.int64),
        np.zeros((n_stages, 2 * n_rows), np.int64),
        np.zeros((n_stages, 2 * n_rows, size)),
        np.zeros((n_stages, width)),
        np.ones((n_stages, width)),
        np.zeros((2, n_states, width)),
        np.zeros((4, width)),
        np.zeros((2, width)),
        np.zeros((n_stages, width), np.int64),
        np.zeros((LARGEST_SET, n_stages, width)),
        np.zeros((LARGEST_SET, 2), np.int64),
    )


@kernel_part
def factorise(road: RoadArrays, window: Window, n_stages: int, side: IntArray, work: Work) -> bool:
    """Filter covariances from the first stage whose set of bounds changed; return success."""
    n, start, known = window.lower.size, 0, np.ones(1)
    while start < work.length[0] and _is_same(side[start], work.side[start], n):
        start += 1
    for t in range(start, n_stages):
        work.length[0], work.n_fixed[t] = t, 0
        _list_rows(road, window, t, work)
        P = work.covariances[t]
        if t == 0:
            P[:] = 0.0
            for i in range(n):
                P[i, i] = window.arrival_variance[i]
        else:
            blocks, by_factor = window.blocks[t - 1], window.by_factor[t - 1]
            noise = window.process_variance[t - 1]
            propagate(road, blocks, by_factor, noise, work.covariances[t - 1], work.scratch, P)
            mirror(P)
        if t == n_stages - 1:
            work.before[:] = P
        for i in range(n):
            work.side[t, i] = side[t, i]
            if side[t, i] != 0:
                work.n_fixed[t] += 1
                total = scalar_update(P, i, known, 0.0, work.columns[0], work.gains[t, i])
                work.totals[t, i] = total
                if not total > 0.0:
                    return False
                P[i] = 0.0
                P[:, i] = 0.0
        for m in range(road.row_first.size):
            if window.observed[t, m]:
                first, rows = 2 * road.row_first[m], window.weights[t, m, :, : 2 * road.row_span[m]]
                if not pair_update(P, first, rows, window.noise[t, m], work.columns):
                    return False
        mirror(P)
    work.length[0] = n_stages
    return True


@kernel_part
def _is_same(one: IntArray, other: IntArray, n: int) -> bool:
    for i in range(n):  # noqa: SIM110, a generator takes longer to compile
        if one[i] != other[i]:
            return False
    return True


@kernel_part
def sweep(
    road: RoadArrays,
    window: Window,
    n_stages: int,
    start: int,
    force: FloatArray,
    work: Work,
    step: FloatArray,
    multipliers: FloatArray,
) -> None:
    """Write H^-1 r, the components of the factor's set fixed, by a forward and a backward pass.

    Forwards, a filter's means, m = A m_before + P (r - C'C/R A m_before); backwards, with the
    costate l of the next stage, d = m + P A' l.

    Args:
        road: The road.
        window: The window.
        n_stages: Its stages.
        start: Stages before this one have no r.
        force: `(L, padded)` r.
        work: The factor.
        step: `(L, padded)`, written.
        multipliers: `(L, padded)`, written at fixed components: what r lacks for H d = r.
    """
    n = window.lower.size
    n_factors, costate, pull = n - 2 * road.jam.size, work.vectors[0], work.vectors[1]
    step[: start + 1] = 0.0
    for t in range(start, n_stages):
        mean = step[t]
        if t > start:
            move(road, window.blocks[t - 1], window.by_factor[t - 1], n_factors, step[t - 1], mean)
        for i in range(n if work.n_fixed[t] > 0 else 0):
            if work.side[t, i] != 0:
                gap = -mean[i]
                multipliers[t, i] = gap / work.totals[t, i]
                _add(gap, work.gains[t, i], mean)
                mean[i] = 0.0
        _copy(force[t], pull)
        _weigh(work, t, mean, pull)
        add_product(work.covariances[t], pull, mean)
    costate[:] = 0.0
    for t in range(n_stages - 1, -1, -1):
        if t < n_stages - 1:
            move_back(road, window.blocks[t], window.by_factor[t], n_factors, costate, pull)
            add_product(work.covariances[t], pull, step[t])
            _copy(pull, costate)
        if t >= start:
            _add(1.0, force[t], costate)
        _weigh(work, t, step[t], costate)
        for i in range(n - 1 if work.n_fixed[t] > 0 else -1, -1, -1):
            if work.side[t, i] != 0:
                if t < start:
                    multipliers[t, i] = 0.0
                multipliers[t, i] -= _dot(work.gains[t, i], costate)
                costate[i] += multipliers[t, i]


@kernel_part
def _copy(source: FloatArray, out: FloatArray) -> None:
    for j in range(out.size):
        out[j] = source[j]


@kernel_part
def _weigh(work: Work, t: int, x: FloatArray, out: FloatArray) -> None:
    """Subtract C'C/R x from `out`, C the observed rows of a stage."""
    for r in range(work.n_rows[t]):
        first, size, total = work.first[t, r], work.size[t, r], 0.0
        for i in range(size):
            total += work.rows[t, r, i] * x[first + i]
        for i in range(size):
            out[first + i] -= work.rows[t, r, i] * total


@kernel_part
def _list_rows(road: RoadArrays, window: Window, t: int, work: Work) -> None:
    """List the observed rows of a stage, over their deviations."""
    r = 0
    for m in range(road.row_first.size):
        if window.observed[t, m]:
            for q in range(2):
                work.first[t, r], work.size[t, r] = 2 * road.row_first[m], 2 * road.row_span[m]
                inverse = 1.0 / np.sqrt(window.noise[t, m, q])
                for i in range(work.size[t, r]):
                    work.rows[t, r, i] = window.weights[t, m, q, i] * inverse
                r += 1
    work.n_rows[t] = r


@kernel_part
def fix(
    road: RoadArrays,
    window: Window,
    n_stages: int,
    z: FloatArray,
    side: IntArray,
    n_columns: int,
    work: Work,
    step: FloatArray,
    multipliers: FloatArray,
) -> int:
    """Correct a free step so that components of a set get to their bounds.

    It does what a `sweep` with the set would, from the factor without one, by columns of H^-1.

    Args:
        road: The road.
        window: The window.
        n_stages: Its stages.
        z: `(L, padded)` the trajectory.
        side: `(L, padded)` the set.
        n_columns: Number of columns that are known.
        work: The factor, and the known columns.
        step: `(L, padded)` the free step from `sweep`; replaced.
        multipliers: `(L, padded)`, written as by `sweep`.

    Returns:
        The number of columns that are known now, -1 if they are too many or no set of full rank.
    """
    m = 0
    for t in range(n_stages):
        for i in range(window.lower.size):
            if side[t, i] == 0:
                continue
            if m == LARGEST_SET:
                return -1
            work.members[m, 0], work.members[m, 1], m = t, i, m + 1
            if work.slot[t, i] < 0:
                if n_columns == LARGEST_SET:
                    return -1
                work.unit[t, i] = 1.0
                column = work.inverse[n_columns]
                sweep(road, window, n_stages, t, work.unit, work, column, multipliers)
                work.unit[t, i] = 0.0
                work.slot[t, i], n_columns = n_columns, n_columns + 1
    matrix, needed = np.empty((m, m)), np.empty(m)
    for a in range(m):
        t, i = work.members[a]
        bound = window.lower[i] if side[t, i] < 0 else window.upper[i]
        needed[a] = bound - z[t, i] - step[t, i]
        column = work.inverse[work.slot[t, i]]
        for b in range(a, m):
            matrix[b, a] = column[work.members[b, 0], work.members[b, 1]]
    if not factor(matrix):
        return -1
    solve(matrix, needed)
    for a in range(m):
        t, i = work.members[a]
        multipliers[t, i] = needed[a]
        column = work.inverse[work.slot[t, i]]
        for k in range(n_stages):
            _add(needed[a], column[k], step[k])
    for a in range(m):
        t, i = work.members[a]
        step[t, i] = (window.lower[i] if side[t, i] < 0 else window.upper[i]) - z[t, i]
    return n_columns


@kernel_part(fastmath={"contract"})
def _add(factor: float, x: FloatArray, out: FloatArray) -> None:
    for j in range(out.size):
        out[j] += factor * x[j]


@kernel_part(fastmath={"contract", "reassoc"})
def _dot(x: FloatArray, y: FloatArray) -> float:
    total = 0.0
    for j in range(x.size):
        total += x[j] * y[j]
    return total


@kernel_part
def write_force(
    road: RoadArrays, window: Window, n_stages: int, z: FloatArray, work: Work, force: FloatArray
) -> None:
    """Write minus half the objective's gradient, -(H z + q / 2), `(L, padded)`."""
    n, pull, weighed = window.lower.size, work.vectors[0], work.vectors[1]
    for t in range(n_stages):
        if t == 0:
            for i in range(n):
                force[0, i] = (window.arrival[i] - z[0, i]) / window.arrival_variance[i]
            continue
        blocks, by_factor = window.blocks[t - 1], window.by_factor[t - 1]
        move(road, blocks, by_factor, n - 2 * road.jam.size, z[t - 1], weighed)
        for i in range(n):
            gap = weighed[i] + window.offsets[t - 1, i] - z[t, i]
            force[t, i] = weighed[i] = gap / window.process_variance[t - 1, i]
        move_back(road, blocks, by_factor, n - 2 * road.jam.size, weighed, pull)
        for i in range(n):
            force[t - 1, i] -= pull[i]
    for t in range(n_stages):
        for m in range(road.row_first.size):
            if window.observed[t, m]:
                first, size = 2 * road.row_first[m], 2 * road.row_span[m]
                for q in range(2):
                    row, gap = window.weights[t, m, q], window.targets[t, m, q]
                    for i in range(size):
                        gap -= row[i] * z[t, first + i]
                    gap /= window.noise[t, m, q]
                    for i in range(size):
                        force[t, first + i] += row[i] * gap


@kernel_part
def write_diagonal(road: RoadArrays, window: Window, n_stages: int, diagonal: FloatArray) -> None:
    """Write the diagonal `(L, padded)` of H, in whose units a residual is measured."""
    n = 2 * road.jam.size
    for t in range(n_stages):
        variance = window.arrival_variance if t == 0 else window.process_variance[t - 1]
        for i in range(variance.size):
            diagonal[t, i] = 1.0 / variance[i]
        for m in range(road.row_first.size):
            if window.observed[t, m]:
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
    road: RoadArrays, window: Window, n_stages: int, work: Work, side: IntArray, z: FloatArray
) -> int:
    """Replace a trajectory by the minimiser; return how, or `UNSOLVED`.

    A solution is accepted by its natural residual |z - clip(z - g / diag H, lower, upper)|.

    Args:
        road: The road.
        window: The window.
        n_stages: Its stages.
        work: Working space, with the factor of this window without components at bounds.
        side: `(L, padded)` a guess of the set of bounds; replaced by that of the solution.
        z: `(L, padded)` a guess of the trajectory, replaced.
    """
    force, free = np.zeros(z.shape), np.zeros(z.shape)
    step, multipliers = np.zeros(z.shape), np.zeros(z.shape)
    write_diagonal(road, window, n_stages, work.diagonal)
    _clip(window, n_stages, z, 0.0, step, z)
    write_force(road, window, n_stages, z, work, force)
    sweep(road, window, n_stages, 0, force, work, free, multipliers)
    work.slot[:] = -1
    n_columns, trial = 0, z.copy()
    for _ in range(ROUNDS):
        step[:] = free
        n_columns = fix(road, window, n_stages, z, side, n_columns, work, step, multipliers)
        if n_columns < 0:
            break
        if _revise(window, n_stages, side, z, step, multipliers):
            continue
        _clip(window, n_stages, z, 1.0, step, trial)
        if _correct(road, window, n_stages, side, n_columns, work, force, step, multipliers, trial):
            z[:] = trial
            return ACTIVE_SET
        break
    write_force(road, window, n_stages, z, work, force)
    if _descend(road, window, n_stages, work, force, step, multipliers, trial, side, z):
        return NEWTON
    return UNSOLVED


@kernel_part
def _revise(
    window: Window,
    n_stages: int,
    side: IntArray,
    z: FloatArray,
    step: FloatArray,
    multipliers: FloatArray,
) -> bool:
    """Release components that pull inwards, add those far outside; return whether any did."""
    changed, least = False, AT_BOUND
    for t in range(n_stages):
        for i in range(window.lower.size):
            if side[t, i] == 0:
                value = z[t, i] + step[t, i]
                outside = max(window.lower[i] - value, value - window.upper[i])
                least = max(least, ADDED * outside)
    for t in range(n_stages):
        for i in range(window.lower.size):
            value, new = z[t, i] + step[t, i], side[t, i]
            if new != 0:
                new = 0 if multipliers[t, i] * new > 0.0 else new
            elif value < window.lower[i] - least:
                new = -1
            elif value > window.upper[i] + least:
                new = 1
            if new != side[t, i]:
                side[t, i], changed = new, True
    return changed


@kernel_part
def _correct(
    road: RoadArrays,
    window: Window,
    n_stages: int,
    side: IntArray,
    n_columns: int,
    work: Work,
    force: FloatArray,
    step: FloatArray,
    multipliers: FloatArray,
    z: FloatArray,
) -> bool:
    """Correct the rounding error of a solution on its set; return whether it is accepted."""
    for trial in range(CORRECTIONS):
        write_force(road, window, n_stages, z, work, force)
        residual = _residual(window, n_stages, work.diagonal, force, z)
        if residual <= REFINED or trial == CORRECTIONS - 1:
            return residual <= ACCEPTED
        sweep(road, window, n_stages, 0, force, work, step, multipliers)
        fix(road, window, n_stages, z, side, n_columns, work, step, multipliers)
        _clip(window, n_stages, z, 1.0, step, z)
    return False


@kernel_part
def _descend(
    road: RoadArrays,
    window: Window,
    n_stages: int,
    work: Work,
    force: FloatArray,
    step: FloatArray,
    multipliers: FloatArray,
    trial: FloatArray,
    side: IntArray,
    z: FloatArray,
) -> bool:
    """Bring a trajectory within bounds down to the minimum; return whether it is there.

    Components that the gradient presses against their bound are fixed. The step to the minimum of
    the others is clipped to the bounds, and halved until the objective falls far enough. After some
    halvings it ends at the first bound instead, so that the objective falls in any case.
    """
    n, trial_force = window.lower.size, np.zeros(z.shape)
    residual = _residual(window, n_stages, work.diagonal, force, z)
    for _ in range(NEWTON_ROUNDS):
        if residual <= REFINED:
            break
        for t in range(n_stages):
            for i in range(n):
                at_lower = z[t, i] <= window.lower[i] and force[t, i] < 0.0
                at_upper = z[t, i] >= window.upper[i] and force[t, i] > 0.0
                side[t, i] = int(at_upper) - int(at_lower)
        if not factorise(road, window, n_stages, side, work):
            return False
        sweep(road, window, n_stages, 0, force, work, step, multipliers)
        before, length, found = residual, 1.0, False
        for halving in range(HALVINGS + 1):
            if halving == HALVINGS:
                length = _reach(road, window, n_stages, work, force, side, z, step, multipliers)
            _clip(window, n_stages, z, length, step, trial)
            write_force(road, window, n_stages, trial, work, trial_force)
            residual = _residual(window, n_stages, work.diagonal, trial_force, trial)
            # Next to the minimum, rounding decides whether the objective falls.
            found = before <= NEAR and residual <= 0.5 * before
            if found or _falls(n_stages, n, z, force, trial, trial_force):
                found = True
                break
            length *= 0.5
        if before <= ACCEPTED and not (found and residual < before):
            residual = before
            break
        if not found:
            return False
        z[:] = trial
        force[:] = trial_force
    return residual <= ACCEPTED


@kernel_part
def _reach(
    road: RoadArrays,
    window: Window,
    n_stages: int,
    work: Work,
    force: FloatArray,
    side: IntArray,
    z: FloatArray,
    step: FloatArray,
    multipliers: FloatArray,
) -> float:
    """Return how far a step goes up to the first bound, 0 to 1.

    Components at a bound that the step would take across it are fixed first, and the step is
    written anew.
    """
    for _ in range(n_stages * window.lower.size):
        n_crossing, length, stage, component = 0, 1.0, -1, -1
        for t in range(n_stages):
            for i in range(window.lower.size):
                d, low, high = step[t, i], window.lower[i], window.upper[i]
                if side[t, i] != 0 or d == 0.0:
                    continue
                room = low - z[t, i] if d < 0.0 else high - z[t, i]
                if room == 0.0:
                    side[t, i], n_crossing = (-1 if d < 0.0 else 1), n_crossing + 1
                elif room / d < length:
                    length, stage, component = room / d, t, i
        if n_crossing == 0:
            if stage >= 0:  # so that rounding does not leave it next to the bound
                step[stage, component] *= 1.0 + 1e-12
            return length
        if not factorise(road, window, n_stages, side, work):
            return 0.0
        sweep(road, window, n_stages, 0, force, work, step, multipliers)
    return 0.0


@kernel_part
def _falls(
    n_stages: int,
    n: int,
    z: FloatArray,
    force: FloatArray,
    trial: FloatArray,
    trial_force: FloatArray,
) -> bool:
    """Return whether the objective falls far enough from one trajectory to another."""
    along, change = 0.0, 0.0
    for t in range(n_stages):
        for i in range(n):
            step = trial[t, i] - z[t, i]
            along -= force[t, i] * step
            change -= 0.5 * (force[t, i] + trial_force[t, i]) * step
    return change <= SUFFICIENT * along


@kernel_part
def _clip(
    window: Window, n_stages: int, z: FloatArray, length: float, step: FloatArray, out: FloatArray
) -> None:
    """Write a trajectory some way along a step, clipped to the bounds."""
    for t in range(n_stages):
        for i in range(window.lower.size):
            value, low, high = z[t, i] + length * step[t, i], window.lower[i], window.upper[i]
            if value < low + AT_BOUND:
                value = low
            elif value > high - AT_BOUND:
                value = high
            out[t, i] = value


@kernel_part
def _residual(
    window: Window, n_stages: int, diagonal: FloatArray, force: FloatArray, z: FloatArray
) -> float:
    """Return the largest |z - clip(z - g / diag H, lower, upper)|, g = -force; it may be NaN."""
    largest = 0.0
    for t in range(n_stages):
        for i in range(window.lower.size):
            target = z[t, i] + force[t, i] / diagonal[t, i]
            gap = abs(z[t, i] - min(max(target, window.lower[i]), window.upper[i]))
            if not gap <= largest:  # also true for a NaN
                largest = gap
    return largest
