"""Compiled linear algebra of a Kalman filter: sparse propagation, scalar Joseph updates.

Covariances are stored with rows padded to a multiple of eight numbers, the padding zero, so that
every inner loop runs over full vector registers of contiguous memory. `contract` allows fused
multiply-adds and, unlike other options, keeps NaNs, by which divergence is detected.
"""

import numpy as np

from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel_part

VECTOR_WIDTH = 8  # numbers in a register


def padded(n: int) -> int:
    """Length of a padded row of n numbers."""
    return -(-n // VECTOR_WIDTH) * VECTOR_WIDTH


@kernel_part(fastmath={"contract"})
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


@kernel_part(fastmath={"contract"})
def _multiply_factors(
    road: RoadArrays, by_factor: FloatArray, right: FloatArray, out: FloatArray
) -> None:
    """Add to `out` = F right what demand factors, the last rows, contribute; they stay."""
    n, width = 2 * road.jam.size, right.shape[1]
    for e in range(right.shape[0] - n):
        c, factor, kept = road.entries[e], right[n + e], out[n + e]
        upper, lower = out[2 * c], out[2 * c + 1]
        a, b = by_factor[e, 0], by_factor[e, 1]
        for j in range(width):
            upper[j] += a * factor[j]
            lower[j] += b * factor[j]
            kept[j] = factor[j]


@kernel_part(fastmath={"contract"})
def propagate(
    road: RoadArrays,
    blocks: FloatArray,
    by_factor: FloatArray,
    noise: FloatArray,
    covariance: FloatArray,
    product: FloatArray,
    transposed: FloatArray,
) -> None:
    """Replace the covariance by F P F' + Q.

    Args:
        road: The road, for the cells of the blocks.
        blocks: `(S, K, 4)` blocks of F, as written by `dptse_env.model.step.advance`.
        by_factor: `(1 + I, 2)` derivatives of the entries' cells by the demand factors, if the
            states have them.
        noise: `(n_x,)` variances that Q adds.
        covariance: `(n_x, padded)`, replaced.
        product: `(n_x, padded)` scratch.
        transposed: `(n_x, padded)` scratch.
    """
    n = covariance.shape[0]
    has_factors = n > 2 * road.jam.size
    _multiply(road, blocks, covariance, product)
    if has_factors:
        _multiply_factors(road, by_factor, covariance, product)
    for i in range(n):
        for j in range(n):
            transposed[i, j] = product[j, i]
        transposed[i, n:] = 0.0
    _multiply(road, blocks, transposed, covariance)
    if has_factors:
        _multiply_factors(road, by_factor, transposed, covariance)
    mirror(covariance)
    for i in range(n):
        covariance[i, i] += noise[i]


@kernel_part
def mirror(covariance: FloatArray) -> None:
    """Copy the lower half to the upper one."""
    for i in range(covariance.shape[0]):
        for j in range(i):
            covariance[j, i] = covariance[i, j]


@kernel_part
def scratch_vectors(width: int) -> tuple[FloatArray, ...]:
    """Allocate the working space of `segment_update` and `sum_update`."""
    work = np.zeros((8, width))
    return work[0], work[1], work[2], work[3], work[4], work[5], work[6], work[7]


@kernel_part(fastmath={"contract"})
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
        work: Scratch vectors `(padded,)`, their padding zero.

    Returns:
        Whether both predicted variances are finite, positive and no less than the noise.
    """
    width = covariance.shape[1]
    first, second = 2 * segment, 2 * segment + 1
    c1, k1, rest1, c2, k2, rest2, _, _ = work
    _read_rows(covariance, first, c1, c2)

    total = c1[first] + noise[0]
    if not _is_variance(total, noise[0]):
        return False
    _gain(c1, total, row[0] - shift[first], k1, rest1, shift)

    a, b = row[2], row[3]
    c1_h, k1_h = a * c1[first] + b * c1[second], a * k1[first] + b * k1[second]
    for j in range(width):
        c2[j] = a * c1[j] + b * c2[j] - c1_h * k1[j] - k1_h * rest1[j]
    total = a * c2[first] + b * c2[second] + noise[1]
    if not _is_variance(total, noise[1]):
        return False
    step = row[1] - (a * shift[first] + b * shift[second])
    _gain(c2, total, step, k2, rest2, shift)

    _downdate(covariance, c1, k1, rest1, c2, k2, rest2)
    return True


@kernel_part(fastmath={"contract"})
def sum_update(
    covariance: FloatArray,
    first: int,
    span: int,
    residuals: FloatArray,
    slopes: FloatArray,
    noise: FloatArray,
    shift: FloatArray,
    work: tuple[FloatArray, ...],
) -> bool:
    """Update by the average density and flow of neighbouring segments, as `segment_update`.

    Args:
        covariance: `(n, padded)`, its lower half replaced.
        first: The first segment.
        span: The number of segments.
        residuals: `(2,)` of both at the point of linearisation.
        slopes: `(S, 2)` derivatives of each segment's flow by its two components.
        noise: `(2,)` variances of the measurements.
        shift: `(padded,)` change of the mean by earlier measurements; updated.
        work: Scratch vectors `(padded,)`, their padding zero.

    Returns:
        Whether both predicted variances are finite, positive and no less than the noise.
    """
    n, width = covariance.shape
    c1, k1, rest1, c2, k2, rest2, upper, lower = work
    part = 1.0 / span
    c1[:], c2[:] = 0.0, 0.0
    for s in range(first, first + span):
        _read_rows(covariance, 2 * s, upper, lower)
        a, b = part * slopes[s, 0], part * slopes[s, 1]
        for j in range(n):
            c1[j] += part * upper[j]
            c2[j] += a * upper[j] + b * lower[j]

    total, step = noise[0], residuals[0]
    for s in range(first, first + span):
        total += part * c1[2 * s]
        step -= part * shift[2 * s]
    if not _is_variance(total, noise[0]):
        return False
    _gain(c1, total, step, k1, rest1, shift)

    c1_h, k1_h = 0.0, 0.0
    for s in range(first, first + span):
        a, b = part * slopes[s, 0], part * slopes[s, 1]
        c1_h += a * c1[2 * s] + b * c1[2 * s + 1]
        k1_h += a * k1[2 * s] + b * k1[2 * s + 1]
    for j in range(width):
        c2[j] -= c1_h * k1[j] + k1_h * rest1[j]
    total, step = noise[1], residuals[1]
    for s in range(first, first + span):
        a, b = part * slopes[s, 0], part * slopes[s, 1]
        total += a * c2[2 * s] + b * c2[2 * s + 1]
        step -= a * shift[2 * s] + b * shift[2 * s + 1]
    if not _is_variance(total, noise[1]):
        return False
    _gain(c2, total, step, k2, rest2, shift)

    _downdate(covariance, c1, k1, rest1, c2, k2, rest2)
    return True


@kernel_part(fastmath={"contract"})
def _gain(
    c: FloatArray,
    total: float,
    step: float,
    k: FloatArray,
    rest: FloatArray,
    shift: FloatArray,
) -> None:
    """Write the gain of a scalar update and its rounding error, and move the mean along it."""
    inverse = 1.0 / total
    for j in range(c.size):
        k[j] = c[j] * inverse
        rest[j] = c[j] - total * k[j]
        shift[j] += k[j] * step


@kernel_part(fastmath={"contract"})
def _downdate(
    covariance: FloatArray,
    c1: FloatArray,
    k1: FloatArray,
    rest1: FloatArray,
    c2: FloatArray,
    k2: FloatArray,
    rest2: FloatArray,
) -> None:
    """Subtract what two scalar updates in Joseph form take from the lower half of P."""
    for i in range(covariance.shape[0]):
        x1, y1, x2, y2 = k1[i], rest1[i], k2[i], rest2[i]
        # Up to the diagonal, in full registers.
        for j in range((i // VECTOR_WIDTH + 1) * VECTOR_WIDTH):
            covariance[i, j] -= x1 * c1[j] + y1 * k1[j] + (x2 * c2[j] + y2 * k2[j])


@kernel_part
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


@kernel_part
def _is_variance(total: float, noise: float) -> bool:
    return 0.0 < total < np.inf and total >= noise * (1.0 - 1e-9)


@kernel_part
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
