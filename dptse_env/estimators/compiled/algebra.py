"""Compiled linear algebra of a Kalman filter: sparse propagation, scalar Joseph updates.

Covariances are stored with rows padded to a multiple of eight numbers, the padding zero, so that
every inner loop runs over full vector registers of contiguous memory. `contract` allows fused
multiply-adds and, unlike other options, keeps NaNs, by which divergence is detected.
"""

import numpy as np
from numba import njit

from dptse_env.model.road_arrays import RoadArrays
from dptse_env.utils.arrays import FloatArray

VECTOR_WIDTH = 8  # numbers in a register


def padded(n: int) -> int:
    """Length of a padded row of n numbers."""
    return -(-n // VECTOR_WIDTH) * VECTOR_WIDTH


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _multiply(road: RoadArrays, blocks: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write F right to `out`, with F given by its 2x2 blocks."""
    width = right.shape[1]
    for c in range(road.jam.size):
        upper, lower = out[2 * c], out[2 * c + 1]
        for slot in range(road.degree[c]):
            a, b = blocks[c, slot, 0], blocks[c, slot, 1]
            d, e = blocks[c, slot, 2], blocks[c, slot, 3]
            if slot > 0 and a == 0.0 and b == 0.0 and d == 0.0 and e == 0.0:
                continue  # a flow depends on either demand or supply
            neighbour = road.neighbours[c, slot]
            first, second = right[2 * neighbour], right[2 * neighbour + 1]
            if slot == 0:
                for j in range(width):
                    upper[j] = a * first[j] + b * second[j]
                    lower[j] = d * first[j] + e * second[j]
            else:
                for j in range(width):
                    upper[j] += a * first[j] + b * second[j]
                    lower[j] += d * first[j] + e * second[j]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def propagate(
    road: RoadArrays,
    blocks: FloatArray,
    noise: FloatArray,
    covariance: FloatArray,
    product: FloatArray,
    transposed: FloatArray,
) -> None:
    """Replace the covariance by F P F' + Q.

    Args:
        road: The road, for the cells of the blocks.
        blocks: `(S, K, 4)` blocks of F, as written by `dptse_env.model.kernels.advance`.
        noise: `(2,)` variances that Q adds to every rho and every psi.
        covariance: `(2 S, padded)`, replaced.
        product: `(2 S, padded)` scratch.
        transposed: `(2 S, padded)` scratch.
    """
    n = covariance.shape[0]
    _multiply(road, blocks, covariance, product)
    for i in range(n):
        for j in range(n):
            transposed[i, j] = product[j, i]
        transposed[i, n:] = 0.0
    _multiply(road, blocks, transposed, covariance)
    mirror(covariance)
    for i in range(n):
        covariance[i, i] += noise[i % 2]


@njit(cache=True, error_model="numpy")
def mirror(covariance: FloatArray) -> None:
    """Copy the lower half to the upper one."""
    for i in range(covariance.shape[0]):
        for j in range(i):
            covariance[j, i] = covariance[i, j]


@njit(cache=True, error_model="numpy")
def scratch_vectors(width: int) -> tuple[FloatArray, ...]:
    """Allocate the working space of `segment_update`."""
    work = np.zeros((6, width))
    return work[0], work[1], work[2], work[3], work[4], work[5]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def segment_update(
    covariance: FloatArray,
    segment: int,
    row: FloatArray,
    noise: FloatArray,
    shift: FloatArray,
    work: tuple[FloatArray, ...],
) -> bool:
    """Update by two scalar measurements of a segment, density and speed or flow, in Joseph form.

    With c = P h, s = h' c + r and K = c / s, `(I - K h') P (I - K h')' + K r K'` is
    `P - K c' - (c - s K) K'`; the last factor is the rounding error that Joseph's form corrects.
    The second measurement's c follows from the first one's vectors, so that P is traversed once.
    Only the lower half of P is read and written; call `mirror` after the last segment.

    Args:
        covariance: `(n, padded)`, its lower half replaced.
        segment: Index of the segment.
        row: Residuals of both at the point of linearisation, then the derivatives of the
            second by the segment's two components.
        noise: `(2,)` variances of the measurements.
        shift: `(padded,)` change of the mean by earlier measurements; updated.
        work: Six scratch vectors `(padded,)`, their padding zero.

    Returns:
        Whether both predicted variances are finite, positive and no less than the noise.
    """
    n, width = covariance.shape
    first, second = 2 * segment, 2 * segment + 1
    c1, k1, rest1, c2, k2, rest2 = work
    _read_rows(covariance, first, c1, c2)

    total = c1[first] + noise[0]
    if not _is_variance(total, noise[0]):
        return False
    inverse, step = 1.0 / total, row[0] - shift[first]
    for j in range(width):
        k1[j] = c1[j] * inverse
        rest1[j] = c1[j] - total * k1[j]
        shift[j] += k1[j] * step

    a, b = row[2], row[3]
    c1_h, k1_h = a * c1[first] + b * c1[second], a * k1[first] + b * k1[second]
    for j in range(width):
        c2[j] = a * c1[j] + b * c2[j] - c1_h * k1[j] - k1_h * rest1[j]
    total = a * c2[first] + b * c2[second] + noise[1]
    if not _is_variance(total, noise[1]):
        return False
    inverse, step = 1.0 / total, row[1] - (a * shift[first] + b * shift[second])
    for j in range(width):
        k2[j] = c2[j] * inverse
        rest2[j] = c2[j] - total * k2[j]
        shift[j] += k2[j] * step

    for i in range(n):
        x1, y1, x2, y2 = k1[i], rest1[i], k2[i], rest2[i]
        # Up to the diagonal, in full registers.
        for j in range((i // VECTOR_WIDTH + 1) * VECTOR_WIDTH):
            covariance[i, j] -= x1 * c1[j] + y1 * k1[j] + (x2 * c2[j] + y2 * k2[j])
    return True


@njit(cache=True, error_model="numpy")
def _read_rows(covariance: FloatArray, row: int, first: FloatArray, second: FloatArray) -> None:
    """Write two adjacent rows of a symmetric matrix whose lower half alone is valid."""
    for j in range(row + 1):
        first[j] = covariance[row, j]
        second[j] = covariance[row + 1, j]
    first[row + 1] = covariance[row + 1, row]
    second[row + 1] = covariance[row + 1, row + 1]
    for j in range(row + 2, covariance.shape[0]):
        first[j] = covariance[j, row]
        second[j] = covariance[j, row + 1]


@njit(cache=True, error_model="numpy")
def _is_variance(total: float, noise: float) -> bool:
    return 0.0 < total < np.inf and total >= noise * (1.0 - 1e-9)


@njit(cache=True, error_model="numpy")
def is_covariance(covariance: FloatArray, variances: FloatArray) -> bool:
    """Return whether variances are finite and not negative and no correlation exceeds one.

    It is cheaper than a factorisation and detects a diverged filter: a matrix with a correlation
    above one is indefinite.

    Args:
        covariance: `(n, padded)`.
        variances: `(padded,)` scratch, left with the diagonal.
    """
    n = covariance.shape[0]
    for i in range(n):
        variances[i] = covariance[i, i]
        if not 0.0 <= variances[i] < np.inf:
            return False
    possible = 0
    for i in range(n):
        allowed = (1.0 + 1e-9) * variances[i]
        for j in range(i + 1):
            # A NaN is not counted.
            if covariance[i, j] * covariance[i, j] <= allowed * variances[j] + 1e-24:
                possible += 1
    return bool(possible == n * (n + 1) // 2)
