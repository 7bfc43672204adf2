"""Compiled algebra of a window: gradient, factor and inverse of its block-tridiagonal H.

H is the inverse covariance of a chain of states, so its block factorisation in the order of time
is a Kalman filter's forward pass: the filtered covariances are the inverses of the pivots. With
them H d = r takes a forward and a backward sweep (the smoother of Bryson and Frazier, 1963) without
further inverses. All quantities are normalised; vectors and rows are padded as in `algebra`.
"""

import numpy as np

from dptse_env.estimators.compiled.algebra import (
    mirror,
    propagate,
    scratch_vectors,
    segment_update,
    sum_update,
)
from dptse_env.estimators.compiled.chain import Chain, WindowScratch
from dptse_env.estimators.compiled.window_rows import (
    add_diagonal,
    add_slope,
    inform,
    weigh,
    weigh_wide,
)
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernel_loops import copy_matrix, copy_vector
from dptse_env.utils.kernels import kernel_part


@kernel_part(kept=True)
def factorise(road: RoadArrays, chain: Chain, n_stages: int, scratch: WindowScratch) -> bool:
    """Filter covariances through the window; return whether all variances are sound."""
    n, width = scratch.before.shape
    row, shift, work = np.zeros(4), np.zeros(width), scratch_vectors(width)
    inform(road, chain, n_stages, scratch)
    for t in range(n_stages):
        P = scratch.factors[t]
        if t == 0:
            P[:] = 0.0
            for i in range(n):
                P[i, i] = chain.arrival_variance[i]
        else:
            copy_matrix(scratch.factors[t - 1], P)
            propagate(
                road,
                chain.blocks[t - 1],
                chain.by_factor[t - 1],
                chain.process_variance[t - 1],
                P,
                scratch.product[0],
                scratch.product[1],
            )
        if t == n_stages - 1:
            copy_matrix(P, scratch.before)
        for m in range(road.row_first.size):
            if chain.observed[t, m] and road.row_span[m] == 1:
                s = road.row_first[m]
                row[2], row[3] = chain.slopes[t, s, 0], chain.slopes[t, s, 1]
                if not segment_update(P, s, row, chain.noise[t, m], shift, work):
                    return False
        if scratch.n_wide[t] > 0 and not _update_wide(road, chain, t, scratch, shift, work):
            return False
        mirror(P)
    _write_diagonal(road, chain, n_stages, scratch)
    return True


@kernel_part(kept=True)
def _update_wide(
    road: RoadArrays,
    chain: Chain,
    t: int,
    scratch: WindowScratch,
    shift: FloatArray,
    work: tuple[FloatArray, ...],
) -> bool:
    """Update a stage's covariance by its rows of several segments, as `segment_update`."""
    # A call next to `segment_update` would slow down a window that has no such rows.
    P, slopes, residuals = scratch.factors[t], chain.slopes[t], np.zeros(2)
    for i in range(scratch.n_wide[t]):
        m = scratch.wide[t, i]
        first, span, noise = road.row_first[m], road.row_span[m], chain.noise[t, m]
        if not sum_update(P, first, span, residuals, slopes, noise, shift, work):
            return False
    return True


@kernel_part(kept=True)
def _write_diagonal(road: RoadArrays, chain: Chain, n_stages: int, scratch: WindowScratch) -> None:
    """Write the diagonal of H."""
    n = 2 * road.jam.size
    for t in range(n_stages):
        for i in range(chain.arrival.size):
            before = chain.arrival_variance[i] if t == 0 else chain.process_variance[t - 1, i]
            scratch.diagonal[t, i] = 1.0 / before
    add_diagonal(road, chain, n_stages, scratch)
    for t in range(n_stages - 1):
        diagonal, w = scratch.diagonal[t], 1.0 / chain.process_variance[t]
        for c in range(road.jam.size):
            w_rho, w_psi = w[2 * c], w[2 * c + 1]
            for slot in range(road.degree[c]):
                b, block = road.neighbours[c, slot], chain.blocks[t, c, slot]
                diagonal[2 * b] += w_rho * block[0] ** 2 + w_psi * block[2] ** 2
                diagonal[2 * b + 1] += w_rho * block[1] ** 2 + w_psi * block[3] ** 2
        for e in range(chain.by_factor.shape[1]):
            c, (by_rho, by_psi) = road.entries[e], chain.by_factor[t, e]
            diagonal[n + e] += w[2 * c] * by_rho**2 + w[2 * c + 1] * by_psi**2 + w[n + e]


@kernel_part(kept=True)
def gradient(road: RoadArrays, chain: Chain, n_stages: int, z: FloatArray, out: FloatArray) -> None:
    """Write H z + q / 2, half the objective's gradient, `(L, padded)`."""
    out[:n_stages] = 0.0
    for i in range(chain.arrival.size):
        out[0, i] = (z[0, i] - chain.arrival[i]) / chain.arrival_variance[i]
    add_slope(road, chain, n_stages, z, out)
    _add_slope_of_steps(road, chain, n_stages, z, out)


@kernel_part
def _add_slope_of_steps(
    road: RoadArrays, chain: Chain, n_stages: int, z: FloatArray, out: FloatArray
) -> None:
    """Add half the gradient of the process noise's part of the objective."""
    n, n_factors = 2 * road.jam.size, chain.by_factor.shape[1]
    gap = np.empty(chain.arrival.size)
    for t in range(n_stages - 1):
        K = chain.process_variance[t]
        for i in range(gap.size):
            gap[i] = z[t + 1, i] - chain.offsets[t, i]
        for e in range(n_factors):
            c, (by_rho, by_psi), factor = road.entries[e], chain.by_factor[t, e], z[t, n + e]
            gap[2 * c] -= by_rho * factor
            gap[2 * c + 1] -= by_psi * factor
            gap[n + e] -= factor
        for c in range(road.jam.size):
            first, second = gap[2 * c], gap[2 * c + 1]
            for slot in range(road.degree[c]):
                b, block = road.neighbours[c, slot], chain.blocks[t, c, slot]
                first -= block[0] * z[t, 2 * b] + block[1] * z[t, 2 * b + 1]
                second -= block[2] * z[t, 2 * b] + block[3] * z[t, 2 * b + 1]
            first /= K[2 * c]
            second /= K[2 * c + 1]
            out[t + 1, 2 * c] += first
            out[t + 1, 2 * c + 1] += second
            for slot in range(road.degree[c]):
                b, block = road.neighbours[c, slot], chain.blocks[t, c, slot]
                out[t, 2 * b] -= block[0] * first + block[2] * second
                out[t, 2 * b + 1] -= block[1] * first + block[3] * second
            gap[2 * c], gap[2 * c + 1] = first, second
        for e in range(n_factors):
            c, (by_rho, by_psi) = road.entries[e], chain.by_factor[t, e]
            weighed = gap[n + e] / K[n + e]
            out[t + 1, n + e] += weighed
            out[t, n + e] -= by_rho * gap[2 * c] + by_psi * gap[2 * c + 1] + weighed


@kernel_part
def natural_residual(
    n_stages: int,
    diagonal: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    slope: FloatArray,
    z: FloatArray,
) -> float:
    """Return the largest |z - clip(z - g / diag H, lower, upper)|, the diagonal `(L, >= n_x)`."""
    largest = 0.0
    for t in range(n_stages):
        for i in range(lower.size):
            target = z[t, i] - slope[t, i] / diagonal[t, i]
            gap = abs(z[t, i] - min(max(target, lower[i]), upper[i]))
            if not gap <= largest:  # also true for a NaN
                largest = gap
    return largest


@kernel_part(kept=True)
def solve(
    road: RoadArrays,
    chain: Chain,
    n_stages: int,
    first: int,
    scratch: WindowScratch,
    right: FloatArray,
    out: FloatArray,
) -> None:
    """Write H^-1 r `(L, padded)` of an r whose stages before `first` are zero.

    Forwards, m = A m_before + P (r - C'C/R A m_before), like a filter's mean; backwards, with the
    costate a = A' l of the next stage, d = m + P a and l = r - C'C/R d + a.
    """
    sweep = scratch.sweep  # taken apart one by one, so that numba knows the layout
    mean, change, costate, slope = sweep[0], sweep[1], sweep[2], sweep[3]
    width, nothing = mean.size, np.zeros(mean.size)
    has_factors = chain.by_factor.shape[1] > 0
    mean[:] = 0.0
    out[:first] = 0.0
    for t in range(first, n_stages):
        if t > first:
            _move(road, chain.blocks[t - 1], out[t - 1], mean)
            if has_factors:
                _move_factors(road, chain.by_factor[t - 1], out[t - 1], mean)
        weigh(scratch.information[t], mean, right[t], change)
        if scratch.n_wide[t] > 0:
            weigh_wide(road, chain, t, scratch, mean, change)
        copy_vector(mean, out[t])
        _add_product(scratch.factors[t], change, out[t])
    slope[:] = 0.0
    for t in range(n_stages - 1, -1, -1):
        if t < n_stages - 1:
            _move_back(road, chain.blocks[t], costate, slope)
            if has_factors:
                _move_factors_back(road, chain.by_factor[t], costate, slope)
            _add_product(scratch.factors[t], slope, out[t])
        # r is zero in the stages before `first`, whatever `right` is.
        weigh(scratch.information[t], out[t], right[t] if t >= first else nothing, costate)
        if scratch.n_wide[t] > 0:
            weigh_wide(road, chain, t, scratch, out[t], costate)
        for i in range(width):
            costate[i] += slope[i]


@kernel_part(fastmath={"contract"})
def _add_product(P: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Add P x to `out`, P symmetric."""
    n, width = P.shape
    if n % 2 == 1:
        a = x[n - 1]
        for j in range(width):
            out[j] += a * P[n - 1, j]
    for i in range(0, n - 1, 2):
        a, b, upper, lower = x[i], x[i + 1], P[i], P[i + 1]
        if a == 0.0 and b == 0.0:
            continue
        for j in range(width):
            out[j] += a * upper[j] + b * lower[j]


@kernel_part
def _move(road: RoadArrays, blocks: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Write the traffic's part of A x, without what demand factors contribute."""
    for c in range(road.jam.size):
        first, second = 0.0, 0.0
        for slot in range(road.degree[c]):
            b, block = road.neighbours[c, slot], blocks[c, slot]
            first += block[0] * x[2 * b] + block[1] * x[2 * b + 1]
            second += block[2] * x[2 * b] + block[3] * x[2 * b + 1]
        out[2 * c], out[2 * c + 1] = first, second


@kernel_part
def _move_factors(road: RoadArrays, by_factor: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Add to A x what demand factors contribute, and write their own part; they stay."""
    n = 2 * road.jam.size
    for e in range(by_factor.shape[0]):
        c, (by_rho, by_psi), factor = road.entries[e], by_factor[e], x[n + e]
        out[2 * c] += by_rho * factor
        out[2 * c + 1] += by_psi * factor
        out[n + e] = factor


@kernel_part
def _move_back(road: RoadArrays, blocks: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Write the traffic's part of A' x, and zeros for demand factors."""
    out[:] = 0.0
    for c in range(road.jam.size):
        first, second = x[2 * c], x[2 * c + 1]
        for slot in range(road.degree[c]):
            b, block = road.neighbours[c, slot], blocks[c, slot]
            out[2 * b] += block[0] * first + block[2] * second
            out[2 * b + 1] += block[1] * first + block[3] * second


@kernel_part
def _move_factors_back(
    road: RoadArrays, by_factor: FloatArray, x: FloatArray, out: FloatArray
) -> None:
    """Write the demand factors' part of A' x."""
    n = 2 * road.jam.size
    for e in range(by_factor.shape[0]):
        c, (by_rho, by_psi) = road.entries[e], by_factor[e]
        out[n + e] = x[n + e] + by_rho * x[2 * c] + by_psi * x[2 * c + 1]
