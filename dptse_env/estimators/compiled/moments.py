"""Statistics of the members of an ensemble, whose numbers lie in rows; compiled."""

import numpy as np

from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel_part


@kernel_part(fastmath={"contract", "reassoc"})
def mean_of(row: FloatArray, n: int) -> float:
    """Return the mean of the first n relative to the first, exact for equal numbers."""
    first, total = row[0], 0.0
    for j in range(n):
        total += row[j] - first
    return float(first + total / n)


@kernel_part(fastmath={"contract", "reassoc"})
def moments_of(row: FloatArray, n: int) -> tuple[float, float]:
    """Return mean and standard deviation of the first n."""
    mean, total = mean_of(row, n), 0.0
    for j in range(n):
        total += (row[j] - mean) ** 2
    return mean, np.sqrt(total / (n - 1))


@kernel_part
def centre_row(row: FloatArray, n: int, unit: float, out: FloatArray) -> float:
    """Write distances from the mean, zero beyond n, and return the mean, both over `unit`."""
    mean, inverse = mean_of(row, n), 1.0 / unit
    for j in range(n):
        out[j] = (row[j] - mean) * inverse
    out[n:] = 0.0
    return mean * inverse


@kernel_part(fastmath={"contract", "reassoc"})
def is_finite(matrix: FloatArray) -> bool:
    """Return whether all numbers of a matrix are finite."""
    total = 0.0
    for i in range(matrix.shape[0]):
        row = matrix[i]
        for j in range(row.size):
            total += 0.0 * row[j]
    return total == 0.0
