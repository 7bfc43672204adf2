"""Loops in place of array expressions, which take numba longer to compile than a whole kernel."""

import math

from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray
from dptse_env.utils.kernels import kernel_part


@kernel_part
def copy_vector(source: AnyArray, target: AnyArray) -> None:
    """Write a vector into another of its length."""
    for i in range(source.size):
        target[i] = source[i]


@kernel_part
def fill_vector(target: AnyArray, value: float) -> None:
    """Write a number into all of a vector."""
    for i in range(target.size):
        target[i] = value


@kernel_part
def copy_matrix(source: AnyArray, target: AnyArray) -> None:
    """Write a matrix into another of its shape."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@kernel_part
def any_of(flags: BoolArray) -> bool:
    """Return whether any flag of a vector is set."""
    for i in range(flags.size):  # noqa: SIM110, a generator takes longer to compile
        if flags[i]:
            return True
    return False


@kernel_part
def all_finite(vector: FloatArray) -> bool:
    """Return whether all numbers of a vector are finite."""
    for i in range(vector.size):  # noqa: SIM110
        if not math.isfinite(vector[i]):
            return False
    return True
