"""Compiled algebra of symmetric positive definite matrices whose entries lie near the diagonal.

A matrix has its upper half as rows that begin at the diagonal: entry (i, j), j >= i, is at
`[i, j - i]`. `first[j]` is the first row with an entry in column j, `last[i]` the last column with
one in row i; neither ever decreases. In the factorisation H = U' U no entry appears above the first
one of a column, so the cost follows the entries that there are (the envelope method of Jennings,
1966). All loops run over contiguous memory.

Scratch rows are four numbers longer than the widest row, since four rows are read at a time; what
lies beyond `last` is zero.
"""

import numpy as np

from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernels import kernel_part

SPARE = 4  # numbers at the end of a row that hold no entry
# Relative change below which a row of a factor counts as unchanged: a few roundings.
UNCHANGED = 1e-12


@kernel_part
def close_envelope(first: IntArray, last: IntArray) -> None:
    """Write the last column of every row of the factor, and lower `first` to never decrease."""
    for j in range(first.size - 2, -1, -1):
        first[j] = min(first[j], first[j + 1])
    i = 0
    for j in range(first.size):
        # Row i ends before the first column that begins below it.
        while i < first[j]:
            last[i] = j - 1
            i += 1
    last[i : first.size] = first.size - 1


@kernel_part(fastmath={"contract"})
def _eliminate(
    factor: FloatArray, first: IntArray, last: IntArray, i: int, row: FloatArray
) -> bool:
    """Replace row i of a matrix by that of its factor, given those above; False if it has none."""
    k = first[i]
    while k + 4 <= i:
        r0, r1 = factor[k, i - k :], factor[k + 1, i - k - 1 :]
        r2, r3 = factor[k + 2, i - k - 2 :], factor[k + 3, i - k - 3 :]
        a, b, c, d = r0[0], r1[0], r2[0], r3[0]
        for j in range(last[k + 3] - i + 1):
            row[j] -= (a * r0[j] + b * r1[j]) + (c * r2[j] + d * r3[j])
        k += 4
    while k < i:
        r0 = factor[k, i - k :]
        a = r0[0]
        for j in range(last[k] - i + 1):
            row[j] -= a * r0[j]
        k += 1
    pivot = row[0]
    if not 0.0 < pivot < np.inf:
        return False
    inverse = 1.0 / np.sqrt(pivot)
    for j in range(last[i] - i + 1):
        row[j] *= inverse
    return True


@kernel_part
def factorise(matrix: FloatArray, first: IntArray, last: IntArray, factor: FloatArray) -> bool:
    """Write the factor U of a matrix `(N, width)`; return whether all pivots are sound."""
    for i in range(first.size):
        for j in range(last[i] - i + 1):
            factor[i, j] = matrix[i, j]
        factor[i, last[i] - i + 1 :] = 0.0
        if not _eliminate(factor, first, last, i, factor[i]):
            return False
    return True


@kernel_part
def refactorise(
    matrix: FloatArray,
    first: IntArray,
    last: IntArray,
    diagonal: FloatArray,
    free: FloatArray,
    changed: IntArray,
    n_changed: int,
    factor: FloatArray,
    row: FloatArray,
) -> int:
    """Bring a factor up to date after some variables were fixed or freed.

    The row and the column of a fixed variable are those of the identity. Only rows that differ are
    computed anew: what a variable changes fades with the distance, mostly long before the end.

    Args:
        matrix: `(N, width)`.
        first: `(N,)`.
        last: `(N,)`.
        diagonal: `(N,)` of the matrix.
        free: `(N,)` 1, or 0 for the variables that are fixed now.
        changed: The variables that were fixed or freed since then, in increasing order.
        n_changed: Number of them.
        factor: `(N, width)` from before, replaced.
        row: `(width,)` scratch.

    Returns:
        The number of rows computed, -1 where a pivot is unsound.
    """
    n_rows, i, reach, c = 0, 0, -1, 0
    while True:
        if i > reach:  # nothing above has changed this row
            if c == n_changed:
                return n_rows
            i = max(i, first[changed[c]])
        while c < n_changed and first[changed[c]] <= i:
            reach = max(reach, changed[c])
            c += 1
        n_rows += 1
        _read_row(matrix, last, free, i, row)
        if not _eliminate(factor, first, last, i, row):
            return -1
        if _replace(row, factor[i], diagonal[i : last[i] + 1]):
            reach = max(reach, last[i])
        i += 1


@kernel_part(fastmath={"contract"})
def _read_row(
    matrix: FloatArray, last: IntArray, free: FloatArray, i: int, row: FloatArray
) -> None:
    """Write row i of a matrix with fixed variables."""
    n, given, mask = last[i] - i + 1, matrix[i], free[i:]
    row[n:] = 0.0
    if free[i] == 0.0:
        row[:n] = 0.0
        row[0] = 1.0
        return
    for j in range(n):
        row[j] = mask[j] * given[j]


@kernel_part(fastmath={"contract", "reassoc"})
def _replace(row: FloatArray, old: FloatArray, diagonal: FloatArray) -> bool:
    """Replace a row of a factor; return whether it changed by more than roundings."""
    excess = 0
    for j in range(diagonal.size):
        # |U_ij| is at most the root of the column's diagonal entry.
        gap = row[j] - old[j]
        excess += 1 if gap * gap > UNCHANGED * UNCHANGED * diagonal[j] else 0
        old[j] = row[j]
    return excess > 0


@kernel_part(fastmath={"contract", "reassoc"})
def solve(factor: FloatArray, last: IntArray, x: FloatArray) -> None:
    """Replace x `(N,)` by `(U' U)^-1 x`."""
    n = x.size
    for i in range(n):
        row, rest = factor[i], x[i:]
        a = rest[0] / row[0]
        rest[0] = a
        if a != 0.0:
            for j in range(1, last[i] - i + 1):
                rest[j] -= a * row[j]
    for i in range(n - 1, -1, -1):
        row, rest = factor[i], x[i:]
        total = rest[0]
        for j in range(1, last[i] - i + 1):
            total -= rest[j] * row[j]
        rest[0] = total / row[0]


@kernel_part(fastmath={"contract", "reassoc"})
def multiply(matrix: FloatArray, last: IntArray, x: FloatArray, out: FloatArray) -> None:
    """Write the product of a matrix `(N, width)` and x `(N,)`."""
    out[:] = 0.0
    for i in range(x.size):
        row, rest, total, a = matrix[i], x[i:], 0.0, x[i]
        below = out[i:]
        for j in range(1, last[i] - i + 1):
            total += row[j] * rest[j]
            below[j] += row[j] * a
        out[i] += total + row[0] * a


@kernel_part(fastmath={"contract"})
def solve_many(factor: FloatArray, last: IntArray, x: FloatArray) -> None:
    """Replace each column of x `(N, m)` by `(U' U)^-1` times it."""
    n, m = x.shape
    for i in range(n):
        here, inverse = x[i], 1.0 / factor[i, 0]
        for k in range(m):
            here[k] *= inverse
        for j in range(1, last[i] - i + 1):
            a, there = factor[i, j], x[i + j]
            if a != 0.0:
                for k in range(m):
                    there[k] -= a * here[k]
    for i in range(n - 1, -1, -1):
        here, inverse = x[i], 1.0 / factor[i, 0]
        for j in range(1, last[i] - i + 1):
            a, there = factor[i, j], x[i + j]
            if a != 0.0:
                for k in range(m):
                    here[k] -= a * there[k]
        for k in range(m):
            here[k] *= inverse


@kernel_part(fastmath={"contract", "reassoc"})
def invert(factor: FloatArray, last: IntArray, inverse: FloatArray, work: FloatArray) -> None:
    """Write the entries of `(U' U)^-1` where the factor has entries (Takahashi et al., 1973).

    From U Z = U'^-1, a lower triangle, row i of Z follows from the rows below it. What lies beyond
    `last` is left as it is.
    """
    for i in range(last.size - 1, -1, -1):
        m, u, head = last[i] - i, factor[i, 1:], 1.0 / factor[i, 0]
        work[:m] = 0.0
        k = 0
        while k + 2 <= m:
            # Two rows at a time, each used as a row and as a column.
            z0, z1, y, v = inverse[i + 1 + k], inverse[i + 2 + k], work[k:], u[k:]
            a, b = v[0], v[1]
            y[0] += z0[0] * a + z0[1] * b
            y[1] += z0[1] * a + z1[0] * b
            z0, z1, y, v = z0[2:], z1[1:], y[2:], v[2:]
            s0 = s1 = 0.0
            for j in range(m - k - 2):
                y[j] += a * z0[j] + b * z1[j]
                s0 += z0[j] * v[j]
                s1 += z1[j] * v[j]
            work[k] += s0
            work[k + 1] += s1
            k += 2
        if k < m:
            work[k] += inverse[i + 1 + k, 0] * u[k]
        total, row = head, inverse[i]
        for j in range(m):
            z = -head * work[j]
            row[j + 1] = z
            total -= u[j] * z
        row[0] = head * total
