"""Fusion: what answers of connected vehicles say of all vehicles, beside simulated ones."""

import numpy as np
import pytest

from dptse_env.estimators import Estimate, Measurement
from dptse_env.measurement import Fusion, FusionSettings
from dptse_env.release import CappedSettings, Corrected, Paced, PacedSettings, Queries
from dptse_env.traffic import SHORT_HIGHWAY
from tests.release.worlds import task_of

LENGTH, LIMIT, SPREAD = 0.1, SHORT_HIGHWAY.geometry.speed_limit, 12.0
S, N = SHORT_HIGHWAY.geometry.n_segments, SHORT_HIGHWAY.geometry.n_mainline
SPEED, CENTRE = 70.0, 60.0


def read(values, share, sigma=1e-9, n=5, speed=60.0, *, flow=True, **settings):
    """Releases (k, S, 2) of the short road, as read where n vehicles are predicted at a speed.

    Its six mainline segments are queries; two ramps follow.
    """
    model, privacy = (Paced, PacedSettings()) if flow else (Corrected, CappedSettings())
    task = task_of(model, privacy, SHORT_HIGHWAY, Queries.make(N, 2))
    fusion = Fusion(task, FusionSettings(speed_spread=SPREAD, **settings), share)
    everywhere, k = np.ones(values.shape[:2], dtype=bool), len(values)
    given = Measurement(everywhere, values, np.full(values.shape, sigma), np.full((k, S), CENTRE))
    predicted = (np.full((k, S), each) for each in (n / LENGTH, speed, 5.0, 3.0))
    return fusion.read(given, Estimate(*predicted))


def simulated(share, n, flow):
    """Releases of vehicles that are connected by chance, and the same of all, (4000, S, 2)."""
    generator = np.random.default_rng(0)
    connected = generator.random((4_000, S, n)) < share
    speeds = generator.normal(SPEED, SPREAD, connected.shape)
    told = []
    for seen in (connected, np.ones_like(connected)):
        counts = seen.sum(axis=2)
        if flow:
            second = (seen * (speeds - CENTRE)).sum(axis=2) / LENGTH
        else:
            means = (seen * speeds).sum(axis=2) / np.maximum(counts, 1)
            second = np.where(counts > 0, means, LIMIT)
        told.append(np.stack([counts / LENGTH, second], axis=-1))
    return told


@pytest.mark.parametrize(
    ("share", "n", "flow"),
    [(0.05, 20, True), (0.3, 20, True), (0.9, 20, True), (0.1, 60, False), (0.5, 60, False)],
)
def test_the_error_of_what_is_read_is_as_large_as_it_says(share, n, flow):
    released, truth = simulated(share, n, flow)
    found = read(released, share, n=n, speed=SPEED, flow=flow)
    errors = ((found.values - truth) / found.sigma)[:, :N]
    np.testing.assert_allclose(errors.mean(axis=(0, 1))[: 1 + flow], 0.0, atol=0.03)
    density, second = errors.std(axis=(0, 1))
    assert density == pytest.approx(1.0, abs=0.04)
    assert second == pytest.approx(1.0, abs=0.04 if flow else 0.15)


@pytest.mark.parametrize("flow", [True, False])
def test_noise_of_the_release_adds_to_the_sampling_error_over_the_share(flow):
    values = np.ones((1, S, 2))
    with_noise, without = (read(values, 0.1, sigma, flow=flow) for sigma in (3.0, 1e-9))
    added = np.sqrt(with_noise.sigma[0, :N] ** 2 - without.sigma[0, :N] ** 2)
    np.testing.assert_allclose(added[:, 0], 30.0)
    np.testing.assert_allclose(added[:, 1], 30.0 if flow else 3.0)
    np.testing.assert_allclose(with_noise.values[0, :N, 0], 10.0)
    # The last rows are fixed sensors, which see all.
    np.testing.assert_array_equal(with_noise.values[0, N:], 1.0)
    np.testing.assert_array_equal(with_noise.sigma[0, N:], 3.0)


@pytest.mark.parametrize("flow", [True, False])
def test_answers_count_as_one_while_a_vehicle_is_on_the_segment(flow):
    """At 36 km/h a segment of 0.1 km takes 10 s; below 5 km/h it is the time at that."""
    values = np.ones((1, S, 2))
    for speed, factor, seconds in ((36.0, 1.0, 10.0), (36.0, 0.05, 1.0), (0.0, 1.0, 72.0)):
        once, alike = (
            read(values, 0.2, speed=speed, flow=flow, dwell_factor=each).sigma[0, :N]
            for each in (0.0, factor)
        )
        np.testing.assert_allclose((alike / once) ** 2, seconds, rtol=1e-6)


def test_less_than_a_vehicle_is_one_and_all_connected_vehicles_have_no_error():
    values = np.random.default_rng(0).normal(50.0, 10.0, (2, S, 2))
    none, one, more = (read(values, 0.2, n=n) for n in (0.2, 1.0, 1.1))
    np.testing.assert_array_equal(none.sigma, one.sigma)
    assert (more.sigma[:, :N] > one.sigma[:, :N]).all()
    found = read(values, 1.0, 3.0)
    np.testing.assert_array_equal(found.values, values)
    np.testing.assert_allclose(found.sigma, 3.0, rtol=1e-15)


def test_a_segment_where_none_is_connected_has_the_speed_limit():
    """One of 20 vehicles is, on average, so none with a probability of 1 / e."""
    found = read(np.ones((1, S, 2)), 0.05, n=20, speed=60.0, flow=False).sigma[0, :N, 1]
    np.testing.assert_allclose(found**2, 0.95 * SPREAD**2 + np.exp(-1.0) * (LIMIT - 60.0) ** 2)


def test_deviations_of_noise_are_scaled_by_the_share():
    for model, settings, expected in (
        (Paced, PacedSettings(), [20.0, 30.0]), (Corrected, CappedSettings(), [20.0, 3.0]),
    ):  # fmt: skip
        task = task_of(model, settings, SHORT_HIGHWAY, Queries.make(N, 2))
        scaled = Fusion(task, FusionSettings(), 0.1).scaled(np.array([2.0, 3.0]))
        np.testing.assert_allclose(scaled, expected)
