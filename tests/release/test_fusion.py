"""Fusion: what answers of connected vehicles say of all vehicles."""

import numpy as np
import pytest

from dptse_env.estimators import Estimate, Measurement
from dptse_env.release import (
    CappedSettings,
    Corrected,
    Fusion,
    FusionSettings,
    Paced,
    PacedSettings,
    QueryOptions,
    Task,
)
from dptse_env.traffic import SHORT_HIGHWAY

LENGTH, LIMIT, SPREAD = 0.1, SHORT_HIGHWAY.speed_limit, 12.0
N_SEGMENTS, N = SHORT_HIGHWAY.n_segments, SHORT_HIGHWAY.n_mainline


def make(share=0.2, *, flow=True, **settings):
    """Of the short road, whose six mainline segments are queries; two ramps follow."""
    model, privacy = (Paced, PacedSettings()) if flow else (Corrected, CappedSettings())
    task = Task("own", model, privacy, SHORT_HIGHWAY, QueryOptions.make(N, 2), 240)
    return Fusion(task, FusionSettings(speed_spread=SPREAD, **settings), share)


def predicted(density, speed, n_episodes=1, density_std=5.0, speed_std=3.0):
    def of(value):
        return np.broadcast_to(np.float64(value), (n_episodes, N_SEGMENTS)).copy()

    return Estimate(of(density), of(speed), of(density_std), of(speed_std))


def measured(values, sigma=1.0, centre=50.0):
    values = np.asarray(values, dtype=np.float64)
    everywhere = np.ones(values.shape[:2], dtype=bool)
    deviations = np.full(values.shape, sigma)
    return Measurement(everywhere, values, deviations, np.full((len(values), N_SEGMENTS), centre))


@pytest.mark.parametrize("share", [0.05, 0.3, 0.9])
def test_the_error_of_a_scaled_count_and_flow_is_as_large_as_it_says(share):
    """Vehicles that are connected by chance, counted over the share, against all of them."""
    generator = np.random.default_rng(0)
    n, episodes, speed, centre = 20, 4_000, 70.0, 60.0
    connected = generator.random((episodes, N_SEGMENTS, n)) < share
    speeds = generator.normal(speed, SPREAD, connected.shape)
    counts, flows = connected.sum(axis=2), (connected * (speeds - centre)).sum(axis=2)
    truth = np.stack([np.full(counts.shape, n), (speeds - centre).sum(axis=2)], axis=-1) / LENGTH
    released = np.stack([counts, flows], axis=-1) / LENGTH
    fusion = make(share)
    found = fusion.read(measured(released, 1e-9, centre), predicted(n / LENGTH, speed, episodes))
    errors = ((found.values - truth) / found.sigma)[:, :N]
    np.testing.assert_allclose(errors.mean(axis=(0, 1)), 0.0, atol=0.03)
    np.testing.assert_allclose(errors.std(axis=(0, 1)), 1.0, atol=0.04)


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_the_error_of_a_mean_speed_is_as_large_as_it_says(share):
    generator = np.random.default_rng(0)
    n, episodes, speed = 60, 4_000, 70.0
    connected = generator.random((episodes, N_SEGMENTS, n)) < share
    speeds = generator.normal(speed, SPREAD, connected.shape)
    counts = connected.sum(axis=2)
    means = (connected * speeds).sum(axis=2) / np.maximum(counts, 1)
    released = np.stack([counts / LENGTH, np.where(counts > 0, means, LIMIT)], axis=-1)
    fusion = make(share, flow=False)
    found = fusion.read(measured(released, 1e-9, np.nan), predicted(n / LENGTH, speed, episodes))
    errors = ((found.values[..., 1] - speeds.mean(axis=2)) / found.sigma[..., 1])[:, :N]
    assert 0.9 < errors.std() < 1.15


def test_sampling_error_grows_as_the_share_falls():
    values, before = np.ones((1, N_SEGMENTS, 2)), np.zeros(2)
    for share in (0.9, 0.3, 0.1, 0.01):
        found = make(share).read(measured(values), predicted(50, 60))
        assert (found.sigma[0, :N] > before).all()
        before = found.sigma[0, 0]
        np.testing.assert_allclose(found.values[0, :N], 1.0 / share)
        # The last rows are fixed sensors.
        np.testing.assert_array_equal(found.values[0, N:], 1.0)
        np.testing.assert_array_equal(found.sigma[0, N:], 1.0)


@pytest.mark.parametrize("flow", [True, False])
def test_noise_of_the_release_adds_to_the_sampling_error_over_the_share(flow):
    values, read = np.ones((1, N_SEGMENTS, 2)), make(share=0.1, flow=flow).read
    with_noise, without = (
        read(measured(values, sigma), predicted(50, 60)).sigma[0, :N] for sigma in (3.0, 1e-9)
    )
    added = np.sqrt(with_noise**2 - without**2)
    np.testing.assert_allclose(added[:, 0], 30.0)
    np.testing.assert_allclose(added[:, 1], 30.0 if flow else 3.0)


@pytest.mark.parametrize("flow", [True, False])
def test_answers_count_as_one_while_a_vehicle_is_on_the_segment(flow):
    values = np.ones((1, N_SEGMENTS, 2))
    speed = 36.0  # a segment of 0.1 km in 10 s

    def read(factor, sigma=1e-9):
        fusion = make(share=0.2, flow=flow, dwell_factor=factor)
        return fusion.read(measured(values, sigma), predicted(50, speed))

    once, alike = read(0.0).sigma[0, :N], read(1.0).sigma[0, :N]
    np.testing.assert_allclose((alike / once) ** 2, 10.0, rtol=1e-6)
    np.testing.assert_allclose(read(0.05).sigma[0, :N], once)  # never less than a second


def test_deviations_of_noise_are_scaled_by_the_share():
    sigma = np.array([2.0, 3.0])
    np.testing.assert_allclose(make(share=0.1).scaled(sigma), [20.0, 30.0])
    np.testing.assert_allclose(make(share=0.1, flow=False).scaled(sigma), [20.0, 3.0])


def test_where_all_vehicles_are_connected_nothing_changes():
    values = np.random.default_rng(0).normal(50.0, 10.0, (2, N_SEGMENTS, 2))
    given = measured(values, 3.0)
    found = make(share=1.0).read(given, predicted(50, 60, 2))
    np.testing.assert_array_equal(found.values, given.values)
    np.testing.assert_allclose(found.sigma, given.sigma, rtol=1e-15)
