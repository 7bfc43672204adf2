"""The arithmetic that no implementation of an estimator's step gets around, measured.

Each floor carries out, on data made beforehand and with nothing checked, kept or handed over,
what the algorithm says: symmetric matrices by one half, sparse ones by their blocks, densities
as the states that they are. Projections, divergence checks, innovations, weights and the calls
from Python are what a floor leaves out.

Model steps, normal numbers and the dense algebra of the UKF and the EnKF are the package's own
kernels, the quickest known here: these parts of a floor move when the package does. The MHE's
band goes to LAPACK. Floors are compiled anew at every run: numba's cache does not notice edits in
the files that they call.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numba import njit
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse.csgraph import reverse_cuthill_mckee

from dptse_env.estimators.compiled.dense import eliminate, products
from dptse_env.estimators.compiled.normals import fill
from dptse_env.estimators.compiled.swarm import advance_swarm, flock_of, measured_speeds
from dptse_env.model.kernels import advance, scratch_of
from dptse_env.model.road_arrays import Road
from dptse_env.utils.arrays import FloatArray, IntArray

_compiled = njit(error_model="numpy", fastmath={"contract"})


@_compiled
def _multiply(road: Road, blocks: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """F right, F by its blocks."""
    for c in range(road.jam.size):
        upper, lower = out[2 * c], out[2 * c + 1]
        upper[:] = 0.0
        lower[:] = 0.0
        for slot in range(road.degree[c]):
            a, b, d, e = blocks[c, slot]
            if slot > 0 and a == 0.0 and b == 0.0 and d == 0.0 and e == 0.0:
                continue
            i = 2 * road.neighbours[c, slot]
            first, second = right[i], right[i + 1]
            for j in range(out.shape[1]):
                upper[j] += a * first[j] + b * second[j]
                lower[j] += d * first[j] + e * second[j]


@_compiled
def ekf(
    repeats: int,
    road_: tuple,
    state: FloatArray,
    inputs: FloatArray,
    covariance: FloatArray,
    segments: IntArray,
    rows: FloatArray,
) -> float:
    """One model step with its Jacobian, F P F' by blocks, 28 rank-1 updates of half of P.

    A row of H has one entry for a density and two for a speed.

    Args:
        repeats: How many times.
        road_: The `Road`.
        state: `(2 S,)`.
        inputs: `(n_u,)`.
        covariance: `(2 S, padded)`, normalised.
        segments: `(m,)` measured.
        rows: `(2 m, 3)` derivatives by the segment's rho and psi, and the noise variance.
    """
    road = Road(*road_)
    scratch, after = scratch_of(road), np.empty(state.size)
    blocks = np.empty((*road.neighbours.shape, 4))
    n, width = covariance.shape
    P, product, turned = np.zeros((n, width)), np.zeros((n, width)), np.zeros((n, width))
    c, k, shift = np.zeros(width), np.zeros(width), np.zeros(width)
    for _ in range(repeats):
        advance(road, state, inputs, after, blocks, scratch)
        _multiply(road, blocks, covariance, product)
        turned[:, :n] = product[:, :n].T
        _multiply(road, blocks, turned, P)
        shift[:] = 0.0
        for output in range(2 * segments.size):
            i = 2 * segments[output // 2]
            a, b, r = rows[output]
            if b == 0.0:
                c[:] = a * P[i]
            else:
                for j in range(width):
                    c[j] = a * P[i, j] + b * P[i + 1, j]
            inverse = 1.0 / (a * c[i] + b * c[i + 1] + r)
            step = inverse * (r - a * shift[i] - b * shift[i + 1])
            for j in range(width):
                k[j] = inverse * c[j]
                shift[j] += step * c[j]
            # Whole registers up to the diagonal; rows to come are read from the lower half.
            for row in range(n):
                x = k[row]
                for j in range((row // 8 + 1) * 8):
                    P[row, j] -= x * c[j]
    return float(shift[0] + P[n - 1, 0])


@_compiled
def ukf(
    repeats: int,
    road_: tuple,
    state: FloatArray,
    inputs: FloatArray,
    covariance: FloatArray,
    segments: IntArray,
    points: FloatArray,
    joint: FloatArray,
) -> float:
    """A Cholesky factor of P, 77 points, their model steps and speeds, P, S, C and one solve.

    P is one product of the points with themselves, 14 speeds another one with the points and with
    themselves; S and C of the densities are entries of P. The solve is the elimination of
    `[S, C, y]`, and V' V its product that P is reduced by.

    Args:
        repeats: How many times.
        road_: The `Road`.
        state: `(2 S,)` [veh/km, veh/h].
        inputs: `(n_u,)`.
        covariance: `(2 S, padded)` in the units of `state`.
        segments: `(m,)` measured.
        points: `(2 S, padded)` working space, a point a column.
        joint: `(2 m, padded)` a positive definite `[S, C, y]`.
    """
    road = Road(*road_)
    n, width = points.shape
    m = segments.size
    flock, root, work = flock_of(road, width), np.empty(covariance.shape), np.empty(joint.shape)
    speeds, P, cross, S = np.empty((m, width)), np.empty((n, n)), np.empty((m, n)), np.empty((m, m))
    for _ in range(repeats):
        root[:] = covariance
        eliminate(root, n, root.shape[1])
        for i in range(n):
            row = points[i]
            row[:] = state[i]
            for j in range(i + 1):
                row[1 + j] += root[j, i]
                row[1 + n + j] -= root[j, i]
        advance_swarm(road, points, inputs, flock)
        for i in range(m):
            s = 2 * segments[i]
            measured_speeds(
                points[s], points[s + 1], road.jam[s // 2], road.free_flow_speed, road.gamma,
                speeds[i],
            )  # fmt: skip
        products(points, n, points, n, True, P)
        products(speeds, m, points, n, False, cross)
        products(speeds, m, speeds, m, True, S)
        work[:] = joint
        eliminate(work, 2 * m, work.shape[1])
        for r in range(0, 2 * m, 2):
            first, second = work[r, 2 * m :], work[r + 1, 2 * m :]
            for i in range(n):
                x, y = first[i], second[i]
                for j in range(i + 1):
                    P[i, j] -= x * first[j] + y * second[j]
    return float(P[0, 0] + S[0, 0] + cross[0, 0])


@_compiled
def enkf(
    repeats: int,
    road_: tuple,
    members: FloatArray,
    inputs: FloatArray,
    segments: IntArray,
    joint: FloatArray,
    stream: np.ndarray,
    draws: np.ndarray,
    bits: np.ndarray,
) -> float:
    """100 model steps, normals for states and outputs, S, C, one solve and the members' shift.

    C is a product of outputs and states. The densities' part of S is part of it.

    Args:
        repeats: How many times.
        road_: The `Road`.
        members: `(2 S, padded)` a member a column [veh/km, veh/h].
        inputs: `(n_u,)`.
        segments: `(m,)` measured.
        joint: `(2 m, padded)` a positive definite `[S, C]`.
        stream: Of the normal numbers.
        draws: `((2 S + 2 m) M,)` where they go.
        bits: Working space of the stream.
    """
    road = Road(*road_)
    n, width = members.shape
    m, count = segments.size, draws.size // (n + 2 * segments.size)
    flock, swarm, work = flock_of(road, width), np.empty(members.shape), np.empty(joint.shape)
    outputs, residuals = np.zeros((2 * m, width)), np.zeros((2 * m, width))
    S, C, gain = np.empty((m, m)), np.empty((2 * m, n)), np.empty((2 * m, n))
    shift = np.empty((n, width))
    for _ in range(repeats):
        swarm[:] = members
        advance_swarm(road, swarm, inputs, flock)
        fill(stream, draws, bits)
        for i in range(n):
            row, mean = swarm[i], 0.0
            for j in range(count):
                row[j] += 1e-3 * draws[i * count + j]
                mean += row[j]
            mean /= count
            for j in range(count):
                row[j] -= mean
        for i in range(m):
            s = 2 * segments[i]
            outputs[i] = swarm[s]
            measured_speeds(
                swarm[s], swarm[s + 1], road.jam[s // 2], road.free_flow_speed, road.gamma,
                outputs[m + i],
            )  # fmt: skip
        products(outputs, 2 * m, swarm, n, False, C)
        products(outputs[m:], m, outputs[m:], m, True, S)
        work[:] = joint
        eliminate(work, 2 * m, work.shape[1])
        gain[:] = work[:, 2 * m : 2 * m + n]
        for i in range(2 * m - 1, -1, -1):  # U gain = V
            row = gain[i]
            for k in range(i + 1, 2 * m):
                head, below = work[i, k], gain[k]
                for j in range(n):
                    row[j] -= head * below[j]
            row /= work[i, i]
        for i in range(2 * m):
            row, output = residuals[i], outputs[i]
            for j in range(count):
                row[j] = 1e-3 * draws[(n + i) * count + j] - output[j]
        np.dot(gain.T, residuals, shift)
        for i in range(n):
            for j in range(width):
                swarm[i, j] += shift[i, j]
    return float(swarm[0, 0] + S[0, 0] + C[0, 0])


def banded(H: FloatArray) -> FloatArray:
    """H `(n, n)` in the order and form that make LAPACK's lower band narrow, `(band + 1, n)`."""
    order = reverse_cuthill_mckee(sp.csr_matrix(H), symmetric_mode=True)
    H = H[np.ix_(order, order)]
    rows, columns = np.nonzero(H)
    width = int(np.max(rows - columns)) + 1
    band = np.zeros((width, len(H)))
    for d in range(width):
        band[d, : len(H) - d] = np.diagonal(H, -d)
    return np.asfortranarray(band)


def mhe(repeats: int, band: FloatArray, right: FloatArray) -> float:
    """One Cholesky factor of the window's H, 11 blocks in its narrowest order, and one solve.

    No bound, no assembly and no linearisation; called from Python, which is 2 us of it.

    Args:
        repeats: How many times.
        band: `(band + 1, n)` of H.
        right: `(n,)`.
    """
    for _ in range(repeats):
        factor, failed = dpbtrf(band, lower=1)
        if failed:
            raise RuntimeError("H is not positive definite")
        z, _ = dpbtrs(factor, right, lower=1)
    return float(z[0])
