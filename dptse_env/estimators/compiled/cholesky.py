"""Compiled solution of linear equations with a small definite matrix and many right-hand sides."""

import numpy as np

from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel_part


@kernel_part(fastmath={"contract", "reassoc"})
def _factor(matrix: FloatArray) -> bool:
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


@kernel_part(fastmath={"contract"})
def _subtract(right: FloatArray, i: int, first: int, last: int, factors: FloatArray) -> None:
    """Subtract `factors` times rows first..last-1 from row i, four at a time."""
    row = right[i]
    four = first + (last - first) // 4 * 4
    for k in range(first, four, 4):
        x, y, z, w = factors[k], factors[k + 1], factors[k + 2], factors[k + 3]
        a, b, c, d = right[k], right[k + 1], right[k + 2], right[k + 3]
        for j in range(row.size):
            row[j] -= (x * a[j] + y * b[j]) + (z * c[j] + w * d[j])
    for k in range(four, last):
        x, a = factors[k], right[k]
        for j in range(row.size):
            row[j] -= x * a[j]


@kernel_part(kept=True, fastmath={"contract"})
def solve(matrix: FloatArray, right: FloatArray) -> bool:
    """Replace `right` by `matrix^-1 right`, the matrix by its factor; return whether it has one."""
    if not _factor(matrix):
        return False
    m = matrix.shape[0]
    for i in range(m):
        _subtract(right, i, 0, i, matrix[i])
        right[i] *= matrix[i, i]
    for i in range(m):
        for j in range(i):
            matrix[j, i] = matrix[i, j]
    for i in range(m - 1, -1, -1):
        _subtract(right, i, i + 1, m, matrix[i])
        right[i] *= matrix[i, i]
    return True
