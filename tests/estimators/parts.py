"""Compiled parts of kernels, for tests that call them one by one."""

from numba import njit


def compiled(part):
    """Return a kernel that does nothing but call a part."""

    @njit(error_model="numpy")
    def call(*args):
        return part(*args)

    return call
