"""Normal random numbers for ensembles, nine times as fast as numpy's.

A stream is a set of parallel generators xoshiro256++ (Blackman and Vigna, 2021), a column each, so
that the loop over them compiles to vector instructions. Their states come from the
`numpy.random.Generator` of an episode. Pairs of normal numbers follow from pairs of uniform numbers
by the transform of Box and Muller (1958), in single precision, which is sufficient for ensembles;
the tails end at 6.8 standard deviations.
"""

import math
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from dptse_env.utils.kernels import kernel, kernel_part

Stream = NDArray[np.uint64]  # (4, STREAM_WIDTH)
Bits = NDArray[np.uint64]
Draws = NDArray[np.float32]

STREAM_WIDTH = 32  # generators in a stream
_ROOT_HALF = 0x3F3504F3  # bits of sqrt(1/2)
_MANTISSA = 23
# Single precision throughout: numba would convert products with a Python float to double.
_F = np.float32
_ONE, _FOUR, _LN4 = _F(1.0), _F(4.0), _F(math.log(4.0))
_UNIT, _HALF_UNIT = _F(2.0**-32), _F(2.0**-33)
_ANGLE, _QUARTER = _F(math.pi / 2**31), _F(math.pi / 2)
_L3, _L5, _L7, _L9 = (_F(1.0 / k) for k in (3, 5, 7, 9))
_S3, _S5, _S7, _S9, _S11 = (_F((-1) ** (k // 2) / math.factorial(k)) for k in (3, 5, 7, 9, 11))
_C2, _C4, _C6, _C8, _C10, _C12 = (
    _F((-1) ** (k // 2) / math.factorial(k)) for k in (2, 4, 6, 8, 10, 12)
)


def make_stream(generator: np.random.Generator) -> Stream:
    """Seed a stream with the next numbers of a generator."""
    return generator.integers(0, 2**64 - 1, size=(4, STREAM_WIDTH), dtype=np.uint64, endpoint=True)


def _split_of(context: Any, x: Any) -> Any:
    """Split a float32 `x = 2^k z` with z in [sqrt(1/2), sqrt(2)): (z, k)."""
    del context, x

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integer, single = ir.IntType(32), ir.FloatType()
        bits = builder.bitcast(arguments[0], integer)
        places = ir.Constant(integer, _MANTISSA)
        k = builder.ashr(builder.sub(bits, ir.Constant(integer, _ROOT_HALF)), places)
        z = builder.bitcast(builder.sub(bits, builder.shl(k, places)), single)
        return context.make_tuple(builder, signature.return_type, (z, builder.sitofp(k, single)))

    return _tuple_of(types.float32, 2)(types.float32), code


_tuple_of: Any = types.UniTuple  # untyped
# Not as a decorator: a type checker would see the arguments of the function that makes the code.
_split: Any = intrinsic(_split_of)


@kernel_part
def draw_bits(stream: Stream, out: Bits) -> None:
    """Fill `out`, in complete blocks of STREAM_WIDTH, by xoshiro256++."""
    first, second, third, fourth = stream[0], stream[1], stream[2], stream[3]
    for start in range(0, out.size, STREAM_WIDTH):
        block = out[start : start + STREAM_WIDTH]
        for i in range(STREAM_WIDTH):
            a, b, c, d = first[i], second[i], third[i], fourth[i]
            total = a + d
            block[i] = ((total << np.uint64(23)) | (total >> np.uint64(41))) + a
            c ^= a
            d ^= b
            first[i] = a ^ d
            third[i] = c ^ (b << np.uint64(17))
            second[i] = b ^ c
            fourth[i] = (d << np.uint64(45)) | (d >> np.uint64(19))


@kernel_part(fastmath={"contract"})
def _transform(bits: Bits, first: Draws, second: Draws) -> None:
    """Turn each number into two normals: its upper half gives the radius, the lower the angle."""
    for i in range(bits.size):
        upper = np.float32(np.int64(bits[i] >> np.uint64(32)))
        # -2 log u, by log z = 2 atanh((z - 1) / (z + 1)).
        z, k = _split(upper * _UNIT + _HALF_UNIT)
        s = (z - _ONE) / (z + _ONE)
        t = s * s
        series = ((_L9 * t + _L7) * t + _L5) * t + _L3
        radius = np.sqrt(-(k * _LN4 + _FOUR * (s + s * t * series)))
        lower = np.int64(bits[i] & np.uint64(0xFFFFFFFF)) - np.int64(2**31)
        radius = radius if lower >= 0 else -radius
        # From -pi/2 to pi/2; the sign extends it to the full circle.
        turned = lower if lower >= 0 else lower + np.int64(2**31)
        a = np.float32(turned) * _ANGLE - _QUARTER
        q = a * a
        sine = ((((_S11 * q + _S9) * q + _S7) * q + _S5) * q + _S3) * q
        cosine = (((((_C12 * q + _C10) * q + _C8) * q + _C6) * q + _C4) * q + _C2) * q
        first[i] = radius * (cosine + _ONE)
        second[i] = radius * (sine * a + a)


@kernel
def draw(stream: Stream, n: int) -> Draws:
    """Return standard normal numbers `(n,)` and advance the stream.

    Args:
        stream: From `make_stream`.
        n: How many; an odd number takes as much of the stream as the next even one.
    """
    half = (n + 1) // 2
    out = np.empty(2 * half, dtype=np.float32)
    bits = np.empty(-(-half // STREAM_WIDTH) * STREAM_WIDTH, dtype=np.uint64)
    draw_bits(stream, bits)
    _transform(bits[:half], out[:half], out[half:])
    return out[:n]
