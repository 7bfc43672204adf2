"""Compiled linear algebra on dense, padded matrices that several filters share."""

import numpy as np

from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel_part


@kernel_part(fastmath={"contract"})
def eliminate(matrix: FloatArray, n: int, width: int) -> bool:
    """Replace rows [S, C] by [U, V] with U' U = S and V' V = C' S^-1 C.

    Args:
        matrix: `(n or more, width or more)`; S is the first n columns, of which the upper half is
            read.
        n: Number of rows.
        width: Number of columns, a multiple of 8.

    Returns:
        Whether all pivots are positive.
    """
    for i in range(n):
        row, start = matrix[i], i // 8 * 8
        # Four rows at a time: a row is loaded and stored once for four multiplications.
        last = i // 4 * 4
        for k in range(0, last, 4):
            a, b, c, d = matrix[k, i], matrix[k + 1, i], matrix[k + 2, i], matrix[k + 3, i]
            r0, r1, r2, r3 = matrix[k], matrix[k + 1], matrix[k + 2], matrix[k + 3]
            for j in range(start, width):
                row[j] -= (a * r0[j] + b * r1[j]) + (c * r2[j] + d * r3[j])
        for k in range(last, i):
            head, above = matrix[k, i], matrix[k]
            for j in range(start, width):
                row[j] -= head * above[j]
        pivot = row[i]
        if not 0.0 < pivot < np.inf:
            return False
        inverse = 1.0 / np.sqrt(pivot)
        for j in range(start, width):
            row[j] *= inverse
    return True


@kernel_part(fastmath={"contract", "reassoc"})
def products(
    left: FloatArray, n_left: int, right: FloatArray, n_right: int, is_lower: bool, out: FloatArray
) -> None:
    """Write inner products of rows; if `is_lower`, those up to the diagonal and a few more."""
    width = left.shape[1]
    for i in range(0, n_left, 2):
        a0, a1 = left[i], left[min(i + 1, n_left - 1)]
        last = min(i + 2, n_right) if is_lower else n_right
        for j in range(0, last, 2):
            b0, b1 = right[j], right[min(j + 1, n_right - 1)]
            s00 = s01 = s10 = s11 = 0.0
            for k in range(width):
                s00 += a0[k] * b0[k]
                s01 += a0[k] * b1[k]
                s10 += a1[k] * b0[k]
                s11 += a1[k] * b1[k]
            out[i, j] = s00
            if j + 1 < n_right:
                out[i, j + 1] = s01
            if i + 1 < n_left:
                out[i + 1, j] = s10
                if j + 1 < n_right:
                    out[i + 1, j + 1] = s11
