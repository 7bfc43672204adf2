"""Linear algebra that the filters share: transitions by blocks, scalar updates, small solves.

Vectors and rows of matrices are padded with zeros to a multiple of eight numbers, so that inner
loops run over full vector registers. `contract` allows fused multiply-adds and keeps NaNs, by which
divergence is detected. Sums add one product at a time: `x + a b + c d` can be fused in one way, but
`x + (a b + c d)` in two, and the compiler's choice would differ from one kernel to another. All
quantities are normalised.
"""

import numpy as np

from dptse_env.road import Road
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import fill_vector, kernel_part

VECTOR_WIDTH = 8  # numbers in a register


@kernel_part
def padded(n: int) -> int:
    """Length of a padded row of n numbers."""
    return -(-n // VECTOR_WIDTH) * VECTOR_WIDTH


@kernel_part
def to_diagonal(i: int) -> int:
    """Length of row i of the lower half of a matrix, its last register whole."""
    return (i // VECTOR_WIDTH + 1) * VECTOR_WIDTH


@kernel_part(fastmath={"contract"})
def multiply(
    road: Road,
    blocks: FloatArray,
    by_factor: FloatArray,
    right: FloatArray,
    out: FloatArray,
    is_lower: bool,
) -> None:
    """Write A right to `out`; the last components are demand factors.

    Args:
        road: The road, for the cells of the blocks.
        blocks: `(S, K, 4)` 2x2 blocks of A, of each segment by its neighbours.
        by_factor: `(E, 3)` derivatives of the entries' segments, and of the factors themselves, by
            the demand factors.
        right: `(n_x, width)`.
        out: `(n_x, width)`, another matrix.
        is_lower: Whether to write only the lower half and the registers on the diagonal.
    """
    n, width = 2 * road.n_segments, right.shape[1]
    for c in range(road.n_segments):
        upper, lower = out[2 * c], out[2 * c + 1]
        if is_lower:
            width = to_diagonal(2 * c)
        for j in range(width):
            upper[j], lower[j] = 0.0, 0.0
        for slot in range(road.degree[c]):
            a, b = blocks[c, slot, 0], blocks[c, slot, 1]
            d, e = blocks[c, slot, 2], blocks[c, slot, 3]
            if a == 0.0 and b == 0.0 and d == 0.0 and e == 0.0:
                continue  # a flow depends on either demand or supply
            neighbour = road.neighbours[c, slot]
            first, second = right[2 * neighbour], right[2 * neighbour + 1]
            for j in range(width):
                upper[j] = upper[j] + a * first[j] + b * second[j]
                lower[j] = lower[j] + d * first[j] + e * second[j]
    for k in range(right.shape[0] - n):
        upper, lower, factor = out[2 * road.entries[k]], out[2 * road.entries[k] + 1], right[n + k]
        a, b, kept, later = by_factor[k, 0], by_factor[k, 1], by_factor[k, 2], out[n + k]
        if is_lower:
            width = to_diagonal(2 * road.entries[k])
        for j in range(width):
            upper[j] += a * factor[j]
            lower[j] += b * factor[j]
        for j in range(right.shape[1]):
            later[j] = kept * factor[j]


@kernel_part
def apply(
    road: Road,
    blocks: FloatArray,
    by_factor: FloatArray,
    n_factors: int,
    x: FloatArray,
    out: FloatArray,
) -> None:
    """Write A x `(>= n_x,)` to `out`, another vector; see `multiply`."""
    n = 2 * road.n_segments
    for c in range(road.n_segments):
        first, second = 0.0, 0.0
        for slot in range(road.degree[c]):
            b, block = road.neighbours[c, slot], blocks[c, slot]
            first += block[0] * x[2 * b] + block[1] * x[2 * b + 1]
            second += block[2] * x[2 * b] + block[3] * x[2 * b + 1]
        out[2 * c], out[2 * c + 1] = first, second
    for e in range(n_factors):
        c = road.entries[e]
        out[2 * c] += by_factor[e, 0] * x[n + e]
        out[2 * c + 1] += by_factor[e, 1] * x[n + e]
        out[n + e] = by_factor[e, 2] * x[n + e]


@kernel_part
def apply_transposed(
    road: Road,
    blocks: FloatArray,
    by_factor: FloatArray,
    n_factors: int,
    x: FloatArray,
    out: FloatArray,
) -> None:
    """Write A' x `(>= n_x,)` to `out`, another vector; see `multiply`."""
    n = 2 * road.n_segments
    fill_vector(out, 0.0)
    for c in range(road.n_segments):
        first, second = x[2 * c], x[2 * c + 1]
        for slot in range(road.degree[c]):
            b, block = road.neighbours[c, slot], blocks[c, slot]
            out[2 * b] += block[0] * first + block[2] * second
            out[2 * b + 1] += block[1] * first + block[3] * second
    for e in range(n_factors):
        c = road.entries[e]
        out[n + e] = by_factor[e, 2] * x[n + e]
        out[n + e] += by_factor[e, 0] * x[2 * c] + by_factor[e, 1] * x[2 * c + 1]


@kernel_part(fastmath={"contract"})
def propagate(
    road: Road,
    blocks: FloatArray,
    by_factor: FloatArray,
    noise: FloatArray,
    slopes: FloatArray,
    covariance: FloatArray,
    scratch: FloatArray,
    out: FloatArray,
) -> None:
    """Write the lower half of A P A' + Q to `out`, which may be P.

    Args:
        road: The road, for the cells of the blocks.
        blocks: `(S, K, 4)` blocks of A.
        by_factor: `(E, 3)` derivatives by the demand factors.
        noise: `(n_x,)` variances of Q; see `add_noise`.
        slopes: `(S,)` slopes of Q.
        covariance: `(n_x, padded)` P, of which both halves are read.
        scratch: `(2, n_x, padded)`.
        out: `(n_x, padded)`, its padding zero.
    """
    n, product, transposed = covariance.shape[0], scratch[0], scratch[1]
    multiply(road, blocks, by_factor, covariance, product, False)
    for i in range(n):
        for j in range(n):
            transposed[i, j] = product[j, i]
        for j in range(n, transposed.shape[1]):
            transposed[i, j] = 0.0
    multiply(road, blocks, by_factor, transposed, out, True)
    add_noise(noise, slopes, out)


@kernel_part
def add_noise(noise: FloatArray, slopes: FloatArray, covariance: FloatArray) -> None:
    """Add Q = L D L' to a covariance, in which segments are independent.

    Args:
        noise: `(n_x,)` D, the variances of rho's noise and of what psi's has beside it.
        slopes: `(S,)` of psi's noise by rho's: a segment has the block [[1, 0], [slope, 1]] of L.
        covariance: `(n_x, padded)`.
    """
    for i in range(covariance.shape[0]):
        covariance[i, i] += noise[i]
    for s in range(slopes.size):
        i, j = 2 * s, 2 * s + 1
        joint = slopes[s] * noise[i]
        covariance[j, i] += joint
        covariance[i, j] += joint
        covariance[j, j] += slopes[s] * joint


@kernel_part
def divide_by_noise(noise: FloatArray, slopes: FloatArray, x: FloatArray) -> None:
    """Replace a vector `(>= n_x,)` by Q^-1 x; see `add_noise`."""
    for s in range(slopes.size):
        x[2 * s + 1] -= slopes[s] * x[2 * s]
    for i in range(noise.size):
        x[i] /= noise[i]
    for s in range(slopes.size):
        x[2 * s] -= slopes[s] * x[2 * s + 1]


@kernel_part(fastmath={"contract"})
def scalar_update(
    covariance: FloatArray,
    first: int,
    row: FloatArray,
    noise: float,
    column: FloatArray,
    gain: FloatArray,
) -> float:
    """Update a covariance by one number h'x + e, in Joseph form; return the number's variance.

    With c = P h, s = h'c + r and K = c / s, `(I - K h') P (I - K h')' + K r K'` is
    `P - K c' - (c - s K) K'`; the last factor is the rounding error that Joseph's form corrects.
    A mean moves by K times the residual.

    Args:
        covariance: `(n_x, padded)` P, symmetric; not replaced where the variance is not sound.
        first: First component that the number depends on.
        row: Derivatives by that component and the following ones.
        noise: Variance r of e; 0 for a component that is known.
        column: `(padded,)`, written with c.
        gain: `(padded,)`, written with K.

    Returns:
        s, or NaN where it is not finite, not positive or less than r.
    """
    _project_row(covariance, first, row, column)
    total = _gain(first, row, noise, column, gain)
    if total > 0.0:
        for i in range(covariance.shape[0]):
            k, rest, line = gain[i], column[i] - total * gain[i], covariance[i]
            for j in range(column.size):
                line[j] = line[j] - k * column[j] - rest * gain[j]
    return total


@kernel_part(fastmath={"contract"})
def pair_update(
    covariance: FloatArray, first: int, rows: FloatArray, noise: FloatArray, work: FloatArray
) -> bool:
    """Update a covariance by both numbers of a row: two `scalar_update`, P traversed once.

    Only the lower half of P, and the rest of the registers on its diagonal, is read and replaced,
    which is half the work; `mirror` makes it whole.

    Args:
        covariance: `(n_x, padded)` P.
        first: First component that the numbers depend on.
        rows: `(2, size)` derivatives by that component and the following ones.
        noise: `(2,)` variances.
        work: `(4, padded)`, written with P h of both numbers, then with their gains; the second
            number's are those after the first update.

    Returns:
        Whether both variances are sound.
    """
    c, d, k, g = work[0], work[1], work[2], work[3]
    _project_pair(covariance, first, rows, c, d)
    first_total = _gain(first, rows[0], noise[0], c, k)
    by_column, by_gain = 0.0, 0.0
    for i in range(rows.shape[1]):
        by_column += rows[1, i] * c[first + i]
        by_gain += rows[1, i] * k[first + i]
    for j in range(d.size):
        d[j] = d[j] - by_column * k[j] - by_gain * (c[j] - first_total * k[j])
    second_total = _gain(first, rows[1], noise[1], d, g)
    if not (first_total > 0.0 and second_total > 0.0):
        return False
    for i in range(covariance.shape[0]):
        x, y, line = k[i], g[i], covariance[i]
        rest_x, rest_y = c[i] - first_total * x, d[i] - second_total * y
        for j in range(to_diagonal(i)):
            line[j] = line[j] - x * c[j] - rest_x * k[j] - y * d[j] - rest_y * g[j]
    return True


@kernel_part(fastmath={"contract"})
def _project_pair(
    covariance: FloatArray, first: int, rows: FloatArray, one: FloatArray, other: FloatArray
) -> None:
    """Write P h of two rows h, P by its lower half."""
    fill_vector(one, 0.0)
    fill_vector(other, 0.0)
    for i in range(rows.shape[1]):
        a, b, line, end = rows[0, i], rows[1, i], covariance[first + i], to_diagonal(first + i)
        for j in range(end):
            one[j] += a * line[j]
            other[j] += b * line[j]
        for j in range(end, covariance.shape[0]):
            x = covariance[j, first + i]
            one[j] += a * x
            other[j] += b * x


@kernel_part(fastmath={"contract"})
def downdate(covariance: FloatArray, rows: FloatArray) -> None:
    """Subtract V' V from a covariance, its lower half alone; see `pair_update`.

    Args:
        covariance: `(n_x, padded)`.
        rows: `(m, >= padded)` V, m even, its padding zero.
    """
    for i in range(covariance.shape[0]):
        line = covariance[i]
        for r in range(0, rows.shape[0], 2):
            one, other = rows[r], rows[r + 1]
            a, b = one[i], other[i]
            for j in range(to_diagonal(i)):
                line[j] = line[j] - a * one[j] - b * other[j]


@kernel_part
def mirror(matrix: FloatArray) -> None:
    """Copy the lower half of a square matrix, or of one with padded rows, to the upper one."""
    for i in range(matrix.shape[0]):
        for j in range(i):
            matrix[j, i] = matrix[i, j]


@kernel_part(fastmath={"contract"})
def _project_row(covariance: FloatArray, first: int, row: FloatArray, out: FloatArray) -> None:
    """Write P h."""
    fill_vector(out, 0.0)
    for i in range(row.size):
        h, line = row[i], covariance[first + i]
        if h != 0.0:
            for j in range(out.size):
                out[j] += h * line[j]


@kernel_part(fastmath={"contract"})
def _gain(first: int, row: FloatArray, noise: float, column: FloatArray, gain: FloatArray) -> float:
    """Write the gain and return the number's variance, NaN where it is not sound."""
    total = noise
    for i in range(row.size):
        total += row[i] * column[first + i]
    if not (0.0 < total < np.inf and total >= noise * (1.0 - 1e-9)):
        return np.nan
    inverse = 1.0 / total
    for j in range(column.size):
        gain[j] = column[j] * inverse
    return total


@kernel_part(fastmath={"contract"})
def is_covariance(matrix: FloatArray, variances: FloatArray) -> bool:
    """Return whether variances are finite and not negative and no correlation exceeds one.

    It is cheaper than a factorisation and detects a diverged filter: a matrix with a correlation
    above one is indefinite.

    Args:
        matrix: `(n_x, padded)`.
        variances: `(padded,)`, written with the diagonal.
    """
    n = matrix.shape[0]
    for i in range(n):
        variances[i] = matrix[i, i]
        if not 0.0 <= variances[i] < np.inf:
            return False
    possible = 0
    for i in range(n):
        allowed, line = (1.0 + 1e-9) * variances[i], matrix[i]
        for j in range(i + 1):
            # A NaN is not counted.
            if line[j] * line[j] <= allowed * variances[j] + 1e-24:
                possible += 1
    return bool(possible == n * (n + 1) // 2)


@kernel_part(fastmath={"contract"})
def add_product(matrix: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Add P x to `out` `(padded,)`, P `(n_x, padded)` symmetric."""
    n = matrix.shape[0]
    if n % 2 == 1:
        for j in range(out.size):
            out[j] += x[n - 1] * matrix[n - 1, j]
    for i in range(0, n - 1, 2):
        a, b, upper, lower = x[i], x[i + 1], matrix[i], matrix[i + 1]
        if a == 0.0 and b == 0.0:
            continue
        for j in range(out.size):
            out[j] = out[j] + a * upper[j] + b * lower[j]


@kernel_part(fastmath={"contract", "reassoc"})
def factor(matrix: FloatArray) -> bool:
    """Replace the lower half of a symmetric matrix by L, L L' = matrix, with its diagonal inverted.

    Returns whether all pivots were positive and finite.
    """
    for i in range(matrix.shape[0]):
        row = matrix[i]
        for j in range(i + 1):
            other, total = matrix[j], row[j]
            for k in range(j):
                total -= row[k] * other[k]
            if j < i:
                row[j] = total * other[j]
            elif 0.0 < total < np.inf:
                row[i] = 1.0 / np.sqrt(total)
            else:
                return False
    return True


@kernel_part(fastmath={"contract", "reassoc"})
def solve(lower: FloatArray, right: FloatArray) -> None:
    """Replace `right` `(n,)` by (L L')^-1 right, L from `factor`."""
    for i in range(right.size):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * right[k]
        right[i] = total * lower[i, i]
    for i in range(right.size - 1, -1, -1):
        right[i] *= lower[i, i]
        for k in range(i):
            right[k] -= lower[i, k] * right[i]


@kernel_part(fastmath={"contract"})
def forward(lower: FloatArray, right: FloatArray) -> None:
    """Replace `right` `(n, width)` by L^-1 right, L from `factor`."""
    for i in range(right.shape[0]):
        row = right[i]
        for k in range(i):
            weight, other = lower[i, k], right[k]
            for j in range(row.size):
                row[j] -= weight * other[j]
        for j in range(row.size):
            row[j] *= lower[i, i]


@kernel_part(fastmath={"contract"})
def solve_many(lower: FloatArray, right: FloatArray) -> None:
    """Replace `right` `(n, width)` by (L L')^-1 right, L from `factor`."""
    forward(lower, right)
    for i in range(right.shape[0] - 1, -1, -1):
        row = right[i]
        for j in range(row.size):
            row[j] *= lower[i, i]
        for k in range(i):
            weight, other = lower[i, k], right[k]
            for j in range(row.size):
                other[j] -= weight * row[j]


@kernel_part(fastmath={"contract", "reassoc"})
def products(left: FloatArray, right: FloatArray, is_lower: bool, out: FloatArray) -> None:
    """Write the inner products of rows, left right', two rows of each at a time.

    Args:
        left: `(n_left, width)`.
        right: `(n_right, width)`.
        is_lower: Whether to leave out those right of the diagonal, but for one.
        out: `(>= n_left, >= n_right)`.
    """
    n_left, n_right = left.shape[0], right.shape[0]
    for i in range(0, n_left, 2):
        a, b = left[i], left[min(i + 1, n_left - 1)]
        for j in range(0, min(i + 2, n_right) if is_lower else n_right, 2):
            c, d = right[j], right[min(j + 1, n_right - 1)]
            ac = ad = bc = bd = 0.0
            for k in range(left.shape[1]):
                ac += a[k] * c[k]
                ad += a[k] * d[k]
                bc += b[k] * c[k]
                bd += b[k] * d[k]
            out[i, j] = ac
            if j + 1 < n_right:
                out[i, j + 1] = ad
            if i + 1 < n_left:
                out[i + 1, j] = bc
                if j + 1 < n_right:
                    out[i + 1, j + 1] = bd
