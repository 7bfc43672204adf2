"""Powers that compile to vector instructions, unlike loops around the C library's `pow`."""

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from dptse_env.utils.kernels import inline_part

_ROOT_HALF = 0x3FE6A09E667F3BCD  # bits of sqrt(1/2)
_SHIFT = 6755399441055744.0  # 1.5 * 2^52: adding it rounds, and leaves the integer in the low bits
_SHIFT_BITS = 0x4338000000000000
_LN2 = 0.6931471805599453
LEAST_BASE, LARGEST_BASE = 1e-30, 1e30


def _bits_of(context: Any, x: Any) -> Any:
    """Reinterpret a float64 as int64."""
    del context, x

    def code(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(64))

    return types.int64(types.float64), code


def _float_of(context: Any, x: Any) -> Any:
    """Reinterpret an int64 as float64."""
    del context, x

    def code(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.int64), code


# Not as decorators: a type checker would see the arguments of the function that makes the code.
_bits: Any = intrinsic(_bits_of)
_float: Any = intrinsic(_float_of)


@inline_part
def power(base: float, exponent: float) -> float:
    """Return `base ** exponent` to a few units in the last place, for exponents from 0.05 to 10.

    A base outside [1e-30, 1e30], such as zero, infinity and NaN, is returned unchanged.
    """
    x = base if LEAST_BASE < base < LARGEST_BASE else 1.0
    # x = 2^k z with z in [sqrt(1/2), sqrt(2)); log z = 2 atanh((z - 1) / (z + 1)).
    shifted = _bits(x) - np.int64(_ROOT_HALF) + (np.int64(1024) << np.int64(52))
    k_bits = (shifted >> np.int64(52)) - np.int64(1024)
    z = _float(_bits(x) - (k_bits << np.int64(52)))
    k = _float(k_bits + np.int64(_SHIFT_BITS)) - _SHIFT
    s = (z - 1.0) / (z + 1.0)
    t = s * s
    series = 1.0 / 21.0
    series = series * t + 1.0 / 19.0
    series = series * t + 1.0 / 17.0
    series = series * t + 1.0 / 15.0
    series = series * t + 1.0 / 13.0
    series = series * t + 1.0 / 11.0
    series = series * t + 1.0 / 9.0
    series = series * t + 1.0 / 7.0
    series = series * t + 1.0 / 5.0
    series = series * t + 1.0 / 3.0
    y = exponent * (k + (2.0 / _LN2) * (s + s * t * series))
    # 2^y = 2^n exp(r) with |r| <= ln(2) / 2.
    rounded = y + _SHIFT
    r = (y - (rounded - _SHIFT)) * _LN2
    e = 1.0 / 6227020800.0
    e = e * r + 1.0 / 479001600.0
    e = e * r + 1.0 / 39916800.0
    e = e * r + 1.0 / 3628800.0
    e = e * r + 1.0 / 362880.0
    e = e * r + 1.0 / 40320.0
    e = e * r + 1.0 / 5040.0
    e = e * r + 1.0 / 720.0
    e = e * r + 1.0 / 120.0
    e = e * r + 1.0 / 24.0
    e = e * r + 1.0 / 6.0
    e = e * r + 0.5
    e = e * r + 1.0
    e = e * r + 1.0
    n = _bits(rounded) - np.int64(_SHIFT_BITS)
    result = _float(_bits(e) + (n << np.int64(52)))
    return result if LEAST_BASE < base < LARGEST_BASE else base
