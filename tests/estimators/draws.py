"""The same random numbers for both backends of the ensemble Kalman filter."""

from types import SimpleNamespace

import numpy as np

from dptse_env.estimators.compiled.normals import fill, make_bits
from tests.estimators.parts import compiled

fill = compiled(fill)
make_bits = compiled(make_bits)


class Replay:
    """Draws what a compiled stream is about to draw, a member a row."""

    def __init__(self, stream):
        self.stream = stream.copy()

    def standard_normal(self, shape):
        size = shape[0] * shape[1]
        out = np.empty(size + size % 2, dtype=np.float32)  # a stream draws pairs
        fill(self.stream, out, make_bits(out.size))
        return out[:size].reshape(shape[1], shape[0]).T.astype(float)


def draw_alike(compiled, reference) -> None:
    """Give a reference filter the members of a compiled one and the numbers that it will draw."""
    reference.members[:] = compiled.members
    for e, streams in enumerate(compiled._ensembles.streams):
        process, measurement = (Replay(stream) for stream in streams)
        reference._streams[e] = SimpleNamespace(process=process, measurement=measurement)
