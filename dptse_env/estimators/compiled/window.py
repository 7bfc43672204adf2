"""Compiled algebra of a window: gradient, factor and inverse of its block-tridiagonal H.

H is the inverse covariance of a chain of states, so its block factorisation in the order of time
is a Kalman filter's forward pass: the filtered covariances are the inverses of the pivots. With
them H d = r takes a forward and a backward sweep (the smoother of Bryson and Frazier, 1963) without
further inverses. All quantities are normalised; vectors and rows are padded as in `algebra`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from dptse_env.estimators.compiled.algebra import mirror, propagate, scratch_vectors, segment_update
from dptse_env.model.road_arrays import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray


class Chain(NamedTuple):
    """A linearised window of L stages."""

    arrival: FloatArray  # (2 S,) mean of the first state
    arrival_variance: FloatArray  # (2,)
    process_variance: FloatArray  # (2,)
    blocks: FloatArray  # (>= L - 1, S, K, 4) of the transitions
    offsets: FloatArray  # (>= L - 1, 2 S)
    observed: BoolArray  # (>= L, S)
    # (>= L, S, 2) derivatives of the second release, speed or flow, by the segment's rho and
    # psi
    rows: FloatArray
    constants: FloatArray  # (>= L, S) constant of the linearised second release
    values: FloatArray  # (>= L, S, 2) density, and speed or flow
    noise: FloatArray  # (>= L, 2) variances


class WindowScratch(NamedTuple):
    """Scratch space for windows of up to L stages."""

    factors: FloatArray  # (L, 2 S, padded) filtered covariances
    before: FloatArray  # (2 S, padded) the last covariance before its stage's measurements
    information: FloatArray  # (L, S, 3) C' C / R: rho rho, rho psi, psi psi
    diagonal: FloatArray  # (L, padded) of H
    product: FloatArray  # (2, 2 S, padded) scratch
    sweep: FloatArray  # (4, padded) scratch


@njit(cache=True, error_model="numpy")
def make_window_scratch(n_stages: int, n_segments: int, width: int) -> WindowScratch:
    """Allocate the scratch space."""
    n = 2 * n_segments
    return WindowScratch(
        np.zeros((n_stages, n, width)),
        np.zeros((n, width)),
        np.zeros((n_stages, n_segments, 3)),
        np.ones((n_stages, width)),
        np.zeros((2, n, width)),
        np.zeros((4, width)),
    )


@njit(cache=True, error_model="numpy")
def factorise(road: RoadArrays, chain: Chain, n_stages: int, scratch: WindowScratch) -> bool:
    """Filter covariances through the window; return whether all variances are sound."""
    n, width = scratch.before.shape
    row, shift, work = np.zeros(4), np.zeros(width), scratch_vectors(width)
    for t in range(n_stages):
        P = scratch.factors[t]
        if t == 0:
            P[:] = 0.0
            for i in range(n):
                P[i, i] = chain.arrival_variance[i % 2]
        else:
            P[:] = scratch.factors[t - 1]
            propagate(
                road,
                chain.blocks[t - 1],
                chain.process_variance,
                P,
                scratch.product[0],
                scratch.product[1],
            )
        if t == n_stages - 1:
            scratch.before[:] = P
        for s in range(n // 2):
            if chain.observed[t, s]:
                row[2], row[3] = chain.rows[t, s, 0], chain.rows[t, s, 1]
                if not segment_update(P, s, row, chain.noise[t], shift, work):
                    return False
        mirror(P)
    _inform(road, chain, n_stages, scratch)
    return True


@njit(cache=True, error_model="numpy")
def _inform(road: RoadArrays, chain: Chain, n_stages: int, scratch: WindowScratch) -> None:
    """Write the blocks of H from measurements, and its diagonal."""
    w = 1.0 / chain.process_variance
    for t in range(n_stages):
        diagonal = scratch.diagonal[t]
        for s in range(road.jam.size):
            by_rho, by_psi = chain.rows[t, s, 0], chain.rows[t, s, 1]
            seen = 1.0 if chain.observed[t, s] else 0.0
            w_density, w_second = seen / chain.noise[t, 0], seen / chain.noise[t, 1]
            scratch.information[t, s, 0] = w_density + w_second * by_rho * by_rho
            scratch.information[t, s, 1] = w_second * by_rho * by_psi
            scratch.information[t, s, 2] = w_second * by_psi * by_psi
            for i in range(2):
                before = w[i] if t > 0 else 1.0 / chain.arrival_variance[i]
                diagonal[2 * s + i] = before + scratch.information[t, s, 2 * i]
        if t == n_stages - 1:
            continue
        for c in range(road.jam.size):
            for slot in range(road.degree[c]):
                b, block = road.neighbours[c, slot], chain.blocks[t, c, slot]
                diagonal[2 * b] += w[0] * block[0] ** 2 + w[1] * block[2] ** 2
                diagonal[2 * b + 1] += w[0] * block[1] ** 2 + w[1] * block[3] ** 2


@njit(cache=True, error_model="numpy")
def gradient(road: RoadArrays, chain: Chain, n_stages: int, z: FloatArray, out: FloatArray) -> None:
    """Write H z + q / 2, half the objective's gradient, `(L, padded)`."""
    n_segments, K = road.jam.size, chain.process_variance
    out[:n_stages] = 0.0
    for i in range(2 * n_segments):
        out[0, i] = (z[0, i] - chain.arrival[i]) / chain.arrival_variance[i % 2]
    for t in range(n_stages):
        for s in range(n_segments):
            if not chain.observed[t, s]:
                continue
            rho, psi = z[t, 2 * s], z[t, 2 * s + 1]
            by_rho, by_psi = chain.rows[t, s, 0], chain.rows[t, s, 1]
            excess = by_rho * rho + by_psi * psi + chain.constants[t, s] - chain.values[t, s, 1]
            excess /= chain.noise[t, 1]
            out[t, 2 * s] += (rho - chain.values[t, s, 0]) / chain.noise[t, 0] + by_rho * excess
            out[t, 2 * s + 1] += by_psi * excess
    for t in range(n_stages - 1):
        for c in range(n_segments):
            first = z[t + 1, 2 * c] - chain.offsets[t, 2 * c]
            second = z[t + 1, 2 * c + 1] - chain.offsets[t, 2 * c + 1]
            for slot in range(road.degree[c]):
                b, block = road.neighbours[c, slot], chain.blocks[t, c, slot]
                first -= block[0] * z[t, 2 * b] + block[1] * z[t, 2 * b + 1]
                second -= block[2] * z[t, 2 * b] + block[3] * z[t, 2 * b + 1]
            first /= K[0]
            second /= K[1]
            out[t + 1, 2 * c] += first
            out[t + 1, 2 * c + 1] += second
            for slot in range(road.degree[c]):
                b, block = road.neighbours[c, slot], chain.blocks[t, c, slot]
                out[t, 2 * b] -= block[0] * first + block[2] * second
                out[t, 2 * b + 1] -= block[1] * first + block[3] * second


@njit(cache=True, error_model="numpy")
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
    mean, change, costate, slope = scratch.sweep
    width = mean.size
    mean[:] = 0.0
    out[:first] = 0.0
    for t in range(first, n_stages):
        if t > first:
            _move(road, chain.blocks[t - 1], out[t - 1], mean)
        _weigh(scratch.information[t], mean, right[t], change)
        out[t] = mean
        _add_product(scratch.factors[t], change, out[t])
    last = n_stages - 1
    _weigh(scratch.information[last], out[last], right[last], costate)
    for t in range(last - 1, -1, -1):
        _move_back(road, chain.blocks[t], costate, slope)
        _add_product(scratch.factors[t], slope, out[t])
        _weigh(scratch.information[t], out[t], right[t], costate)
        if t < first:  # r is zero there, whatever `right` is
            _weigh(scratch.information[t], out[t], np.zeros(width), costate)
        for i in range(width):
            costate[i] += slope[i]


@njit(cache=True, error_model="numpy")
def _weigh(information: FloatArray, x: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write right - C'C/R x."""
    out[:] = right
    for s in range(information.shape[0]):
        a, b, c = information[s]
        out[2 * s] -= a * x[2 * s] + b * x[2 * s + 1]
        out[2 * s + 1] -= b * x[2 * s] + c * x[2 * s + 1]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _add_product(P: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Add P x to `out`, P symmetric."""
    width = out.size
    for i in range(0, P.shape[0], 2):
        a, b, upper, lower = x[i], x[i + 1], P[i], P[i + 1]
        if a == 0.0 and b == 0.0:
            continue
        for j in range(width):
            out[j] += a * upper[j] + b * lower[j]


@njit(cache=True, error_model="numpy")
def _move(road: RoadArrays, blocks: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Write A x."""
    for c in range(road.jam.size):
        first, second = 0.0, 0.0
        for slot in range(road.degree[c]):
            b, block = road.neighbours[c, slot], blocks[c, slot]
            first += block[0] * x[2 * b] + block[1] * x[2 * b + 1]
            second += block[2] * x[2 * b] + block[3] * x[2 * b + 1]
        out[2 * c], out[2 * c + 1] = first, second


@njit(cache=True, error_model="numpy")
def _move_back(road: RoadArrays, blocks: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Write A' x."""
    out[:] = 0.0
    for c in range(road.jam.size):
        first, second = x[2 * c], x[2 * c + 1]
        for slot in range(road.degree[c]):
            b, block = road.neighbours[c, slot], blocks[c, slot]
            out[2 * b] += block[0] * first + block[2] * second
            out[2 * b + 1] += block[1] * first + block[3] * second
