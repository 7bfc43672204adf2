"""The same random numbers for both backends of the ensemble Kalman filter."""

from types import SimpleNamespace

from dptse_env.estimators.normals import draw


class Replay:
    """Draws what a compiled stream is about to draw, a member a row."""

    def __init__(self, stream):
        self.stream = stream.copy()

    def standard_normal(self, shape):
        drawn = draw(self.stream, shape[0] * shape[1])
        return drawn.reshape(shape[1], shape[0]).T.astype(float)


def draw_alike(compiled, reference) -> None:
    """Give a reference filter the members of a compiled one and the numbers that it will draw."""
    reference.members[:] = compiled.members
    for e, streams in enumerate(compiled._ensembles.streams):
        process, measurement = (Replay(stream) for stream in streams)
        reference._streams[e] = SimpleNamespace(process=process, measurement=measurement)
