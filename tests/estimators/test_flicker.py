"""Flicker against simulated and recorded vehicles, and the noise of vehicles with their w."""

import numpy as np
import pytest

from dptse_env.estimators import Measurement
from dptse_env.estimators.flicker import SPREAD, Flicker
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY
from tests.helpers import make_channels

from .helpers import model_of

PARAMETERS = load_parameters("w99-3lane")
ONE = np.array([0])


def deviations(model, states, since=(), sigma=0.0, centre=None):
    """The deviations `(M, 2)` of a measurement of all channels, at one state.

    Args:
        model: The model.
        states: Of the segments, `(1, 2 S)`.
        since: Seconds between this measurement and earlier ones.
        sigma: Deviations of the noise.
        centre: Speeds that flows are centred on.
    """
    flicker, n_channels = Flicker(model, 1), model.channels.size
    nothing, every = np.zeros((1, n_channels), bool), np.ones((1, n_channels), bool)
    values, sigma = np.zeros((1, n_channels, 2)), np.full((1, n_channels, 2), sigma)
    around = None if centre is None else np.full(model.n_segments, centre)
    seen = [each for gap in since for each in (every, *[nothing] * (gap - 1))]
    for observed in (*seen, every):
        measured = Measurement.of(model, observed, values, sigma, around)
        found = flicker.deviations(ONE, states, observed, measured.centre, sigma)
        np.testing.assert_array_equal(found[~observed], sigma[~observed])
    return found[0]


def uniform(model, density, speed):
    """The states `(1, 2 S)` of a road that is alike everywhere."""
    shape = 1, model.n_segments
    return model.states(np.full(shape, density), np.full(shape, speed))


@pytest.mark.parametrize("since", [(), (1,), (2,), (60,)])
@pytest.mark.parametrize(("density", "speed"), [(22.0, 95.0), (150.0, 20.0), (380.0, 1.0)])
@pytest.mark.parametrize("release", ["flow", "speed"])
def test_deviations_have_the_equations_variances(release, density, speed, since):
    model, centre = model_of("w99-3lane", release), 60.0 if release == "flow" else None
    length, jam = 0.1, model.arz.jam[0]
    n = density * length
    alike = 1.0
    if since:
        alike = max(1.0, 3600.0 * length / max(speed, 5.0) / since[-1])
    count = alike * (1.0 / 12.0 + n * (1.0 - density / jam) ** 6)
    second = alike * SPREAD**2 / max(n, 1.0)
    if release == "flow":
        second = (count * (speed - centre) ** 2 + alike * n * SPREAD**2) / length**2
    expected = np.sqrt([2.5**2 + count / length**2, 2.5**2 + second])
    found = deviations(model, uniform(model, density, speed), since, 2.5, centre)
    np.testing.assert_allclose(found[0], expected, rtol=1e-9)


def test_a_channel_of_several_segments_has_the_flicker_of_its_length():
    channels = make_channels(np.array([0, 0]), np.array([1, 3]))
    model = ARZModel(PAPER_HIGHWAY.road, PARAMETERS, centre=80.0, channels=channels)
    one, three = deviations(model, uniform(model, 30.0, 90.0))[:, 0] ** 2
    rounding = 1.0 / 12.0 / 0.1**2
    assert three == pytest.approx((one - rounding) / 3.0 + rounding / 9.0)


def test_a_reset_forgets_when_channels_were_observed():
    model, everything = model_of("w99-3lane", "speed"), np.ones((2, 19), bool)
    flicker, states = Flicker(model, 2), np.repeat(uniform(model, 30.0, 60.0), 2, axis=0)
    measured = Measurement.of(model, everything, np.zeros((2, 19, 2)), np.zeros((2, 19, 2)))
    seen = np.arange(2), states, everything, measured.centre, measured.sigma
    first, later = (flicker.deviations(*seen) for _ in range(2))
    assert (later > 1.5 * first).all()
    flicker.reset(np.array([1]))
    last = flicker.deviations(*seen)
    np.testing.assert_array_equal(last, np.stack([later[0], first[1]]))
