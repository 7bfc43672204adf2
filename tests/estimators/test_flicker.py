"""Flicker against simulated and recorded vehicles, and the noise of vehicles with their w."""

import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings, Measurement, make_estimator
from dptse_env.estimators.flicker import SPREAD, Flicker
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY, RecordLibrary
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


@pytest.mark.slow
@pytest.mark.parametrize("corridor", [PAPER_HIGHWAY, SHORT_HIGHWAY], ids=lambda road: road.name)
def test_recorded_counts_flicker_as_much(corridor):
    """Counts against their means over 41 s, in free and in congested traffic."""
    counts = np.stack([RecordLibrary().get(corridor, seed).counts for seed in range(8)])
    counts = counts[:, 60:, : corridor.geometry.n_mainline].astype(float)
    window = np.lib.stride_tricks.sliding_window_view(counts, 41, axis=1)
    mean, square = window.mean(axis=-1), (window[..., 20] - window.mean(axis=-1)) ** 2 * 41 / 40
    share = mean / 0.1 / (corridor.road.lanes[0] * 400.0 / 3.0)
    for low, high in ((0.03, 0.1), (0.1, 0.2), (0.2, 0.4)):
        inside = (share >= low) & (share < high)
        if inside.sum() < 2000:
            continue
        expected = (1.0 / 12.0 + mean[inside] * (1.0 - share[inside]) ** 6).mean()
        assert 0.5 < square[inside].mean() / expected < 1.6


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


@pytest.mark.parametrize("estimator", ["ekf", "ukf", "mhe"])
def test_noise_of_vehicles_does_not_move_w(estimator):
    """psi = w rho: a covariance [[1, w], [w, w^2]] times that of rho leaves w as it is."""
    settings = EstimatorSettings(
        process_noise=(1e-9, 1e-9), vehicle_noise=(0.05, 0.0), initial_variance=1e-18
    )
    model = model_of("w99-3lane", "speed")
    made = make_estimator(estimator, "compiled", model, 1, settings)
    start = uniform(model, 40.0, 80.0)
    made.reset(ONE, start, [np.random.default_rng(0)])
    inputs = model.boundary_inputs(
        np.full((1, model.n_boundaries), 40.0), np.full((1, model.n_boundaries), 80.0)
    )
    nothing = np.zeros((1, model.channels.size), bool)
    values = np.zeros((1, model.channels.size, 2))
    made.predict(ONE, inputs)
    made.update(ONE, Measurement.of(model, nothing, values, values))
    covariance = made.covariances[0].reshape(19, 2, 19, 2)
    w = start[0, 1] / start[0, 0] / model.parameters.free_flow_speed
    for s in range(15):  # on a ramp the density is out of bounds
        block = covariance[s, :, s]
        expected = 0.05**2 * 40.0 / 400.0 * np.outer([1.0, w], [1.0, w])
        np.testing.assert_allclose(block, expected, rtol=1e-6, atol=1e-12)
