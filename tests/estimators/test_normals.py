"""Streams of normal numbers: their distribution, independence and repeatability."""

import numpy as np
import pytest

from dptse_env.estimators.normals import STREAM_WIDTH, draw, draw_bits, make_stream
from tests.helpers import compiled

draw_bits = compiled(draw_bits)


def stream_of():
    return make_stream(np.random.default_rng(0))


def drawn(n):
    return draw(stream_of(), n).astype(float)


def test_bits_are_those_of_xoshiro256_plus_plus():
    """Against the recurrence in Python's integers, lane by lane."""
    stream = stream_of()
    states, out = stream.T.tolist(), np.empty(3 * STREAM_WIDTH, dtype=np.uint64)
    draw_bits(stream, out)

    def rotated(x, k):
        return ((x << k) | (x >> (64 - k))) % 2**64

    for lane in (0, 7, STREAM_WIDTH - 1):
        s = states[lane]
        for block in range(3):
            expected = (rotated((s[0] + s[3]) % 2**64, 23) + s[0]) % 2**64
            assert out[block * STREAM_WIDTH + lane] == expected
            t = (s[1] << 17) % 2**64
            s[2] ^= s[0]
            s[3] ^= s[1]
            s[1] ^= s[2]
            s[0] ^= s[3]
            s[2] ^= t
            s[3] = rotated(s[3], 45)


def test_numbers_are_the_transform_of_the_bits():
    """Box and Muller's in double precision: a radius of the upper half, an angle of the lower."""
    n = 64 * STREAM_WIDTH
    bits = np.empty(n, dtype=np.uint64)
    draw_bits(stream_of(), bits)
    single = np.float32
    u = (bits >> np.uint64(32)).astype(single) * single(2.0**-32) + single(2.0**-33)
    turn = (bits & np.uint64(2**32 - 1)).astype(float) / 2**32  # the circle from -pi / 2 on
    radius = np.sqrt(-2.0 * np.log(u.astype(float)))
    first = radius * np.cos(2.0 * np.pi * turn + 0.5 * np.pi)
    second = radius * np.sin(2.0 * np.pi * turn + 0.5 * np.pi)
    np.testing.assert_allclose(drawn(2 * n), np.concatenate([first, second]), atol=1e-5)


@pytest.mark.parametrize("n", [1, 63, 2801])
def test_any_number_is_drawn_and_what_follows_does_not_repeat_it(n):
    generator = np.random.default_rng(0)
    stream, another = make_stream(generator), make_stream(generator)
    first = draw(stream, n)
    np.testing.assert_array_equal(first, draw(stream_of(), n))
    for second in (draw(stream, n), draw(another, n)):
        assert first.shape == second.shape == (n,)
        assert np.isin(first, second).mean() < 0.01  # few are equal by chance
