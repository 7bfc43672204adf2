"""Releases of a road whose segments differ in length and speed limit."""

import dataclasses

import numpy as np
import pytest

from dptse_env.estimators import Estimate
from dptse_env.release import (
    RELEASE_MODELS,
    CappedSettings,
    PacedSettings,
    PrivacySettings,
    ReleaseRequest,
    ReleaseSetup,
    TrafficTable,
)
from tests.model.roads import UNEVEN

from .worlds import Worlds, record

T = 12
ROAD = dataclasses.replace(UNEVEN, duration=T, fixed_sensors=tuple(range(7, 15)))
COLUMNS = ROAD.n_segments + ROAD.n_boundaries
LENGTHS = np.array(ROAD.with_boundaries(ROAD.segment_lengths))
LIMITS = np.array(ROAD.with_boundaries(ROAD.speed_limits))
ALMOST_WITHOUT_NOISE = {"epsilon": 9e3, "delta": 0.4}


def crowd(seed=0, n=60):
    """Vehicles anywhere on the road at any speed up to the limits."""
    rng = np.random.default_rng(seed)
    places = np.tile(rng.integers(0, COLUMNS, (n, 1)), T + 1)
    return record(places, rng.uniform(0.0, 80.0, places.shape), COLUMNS)


def one_vehicle(column, speed):
    places = np.full((1, T + 1), column)
    return record(places, np.full(places.shape, speed), COLUMNS)


def make(settings, *records):
    traffic = TrafficTable(ROAD, tuple(range(len(records))), Worlds(*records))
    settings = dataclasses.replace(settings, boundary_inputs="private")
    release = RELEASE_MODELS[settings.preset](
        ReleaseSetup(settings.preset, settings, traffic, 3, T, len(records))
    )
    for index, loaded in traffic.load(np.arange(len(records))):
        release.load(index, loaded)
    release.reset(np.arange(len(records)), np.random.default_rng(0).spawn(len(records)))
    return release


def release_all(release, times=None):
    n = release.setup.n_episodes
    speed = np.full((n, ROAD.n_segments), 60.0)
    prediction = Estimate(np.full_like(speed, 20.0), speed, speed, speed)
    observed = np.ones((n, COLUMNS), dtype=bool)
    times = np.full(n, 1) if times is None else times
    return release.release(
        ReleaseRequest(np.arange(n), np.arange(n), times, observed, lambda: prediction)
    )


def test_true_traffic_is_counts_over_lengths_and_an_empty_segment_has_its_own_limit():
    whole = crowd()
    table = TrafficTable(ROAD, (0,), Worlds(whole))
    table.load([0])
    traffic = table.complete(0)
    np.testing.assert_allclose(traffic[..., 0] * LENGTHS, whole.counts)
    empty = whole.counts == 0
    assert empty.any()
    np.testing.assert_array_equal(
        traffic[..., 1][empty], np.broadcast_to(LIMITS, empty.shape)[empty]
    )


@pytest.mark.parametrize(
    "settings",
    [
        PrivacySettings(preset="paper", **ALMOST_WITHOUT_NOISE),
        PrivacySettings(preset="corrected", **ALMOST_WITHOUT_NOISE),
        CappedSettings(preset="capped", **ALMOST_WITHOUT_NOISE),
        CappedSettings(preset="capped", speed_release="mean", **ALMOST_WITHOUT_NOISE),
        PacedSettings(preset="paced", **ALMOST_WITHOUT_NOISE),
    ],
    ids=lambda s: f"{s.preset}-{getattr(s, 'speed_release', '')}",
)
def test_what_is_released_is_the_truth_plus_noise_of_the_stated_deviation(settings):
    whole = crowd()
    release = make(settings, whole)
    released = release_all(release)
    sigma = np.broadcast_to(released.sigma, released.values.shape)[0]
    density = whole.counts[1] / LENGTHS
    assert np.all(np.abs(released.values[0, :, 0] - density) < 6.0 * sigma[:, 0] + 1e-9)
    sums, counts = whole.speed_sums[1], whole.counts[1]
    centre = released.centre
    if centre is not None:
        second = (sums - centre[0] * counts) / LENGTHS
        # Deviations are clipped to 25 km/h.
        second = np.where(np.abs(sums - centre[0] * counts) > 25.0 * counts, np.nan, second)
    elif settings.preset == "capped" and settings.speed_release == "flow":
        second = (sums - 60.0 * counts) / LENGTHS
    else:
        second = np.where(counts > 0, sums / np.maximum(counts, 1), LIMITS)
    close = np.abs(released.values[0, :, 1] - second) < 6.0 * sigma[:, 1] + 1e-9
    assert close[np.isfinite(second) & ((centre is None) | (counts <= 1))].all()


@pytest.mark.parametrize("preset", ["paper", "corrected", "capped", "paced"])
def test_a_vehicle_counts_alike_on_every_segment_in_units_of_the_noise(preset):
    settings = RELEASE_MODELS[preset].settings_type(preset=preset, epsilon=5.0)
    released = release_all(make(settings, crowd()))
    sigma = np.broadcast_to(released.sigma, released.values.shape)[0]
    moved = 1.0 / (LENGTHS * sigma[:, 0])
    if preset == "paced":  # prices differ by place, the noise of a count is theirs alone
        prices = make(settings, crowd())
        release_all(prices)
        np.testing.assert_allclose(moved**2, prices.prices[0])
    else:
        np.testing.assert_allclose(moved, moved[0])


def test_the_noise_has_the_deviations_that_are_stated():
    settings = CappedSettings(preset="capped", epsilon=5.0)
    release = make(settings, one_vehicle(COLUMNS - 1, 50.0))
    seen = [release_all(release, np.full(1, 1 + k % T)) for k in range(2000)]
    values = np.array([each.values[0, : ROAD.n_segments] for each in seen])
    stated = seen[0].sigma[0, : ROAD.n_segments]
    np.testing.assert_allclose(values.std(axis=0), stated, rtol=0.08)
    assert np.all(np.abs(values.mean(axis=0)) < 5.0 * stated / np.sqrt(len(seen)))


@pytest.mark.parametrize("speed_release", ["flow", "mean"])
def test_no_replaced_vehicle_moves_a_transcript_further_than_the_sensitivity(speed_release):
    """Wherever a vehicle is, replaced by one elsewhere, or at another speed in its place."""
    settings = CappedSettings(preset="capped", epsilon=5.0, cap=4, speed_release=speed_release)
    largest = 0.0
    for here in range(ROAD.n_segments):
        for there, speed in ((here, 120.0), ((here + 1) % ROAD.n_segments, 0.0)):
            release = make(settings, one_vehicle(here, 0.0), one_vehicle(there, speed))
            total = 0.0
            for t in range(1, T + 1):
                observed = np.ones((2, COLUMNS), dtype=bool)
                request = ReleaseRequest(np.arange(2), np.arange(2), np.full(2, t), observed)
                values = release.true_values(request) * LENGTHS[:, None] / LENGTHS.min()
                if speed_release == "mean":
                    # The sensitivity that the paper's relation gives to speeds does not hold.
                    values[..., 1] = 0.0
                total += float((((values[0] - values[1]) / release.sigma) ** 2).sum())
            bound = release.sensitivity.joint_mu(release.sigma.tolist())
            assert np.sqrt(total) <= bound * (1.0 + 1e-9)
            largest = max(largest, np.sqrt(total) / bound)
    if speed_release == "flow":
        assert largest == pytest.approx(1.0)


def test_prices_of_a_long_trip_are_lower():
    """The tracer's rest of a trip has the lengths of the segments ahead."""
    settings = PacedSettings(preset="paced", epsilon=5.0)
    release = make(settings, crowd())
    release_all(release)
    mainline = release.prices[0, : ROAD.n_mainline]
    assert np.all(np.diff(mainline) > 0.0)
    for segments in (*ROAD.on_ramp_segments, *ROAD.off_ramp_segments):
        assert np.all(np.diff(release.prices[0, list(segments)]) > 0.0)
    # A vehicle on an on-ramp has its part of the mainline still ahead.
    for face, segments in zip(ROAD.on_ramps, ROAD.on_ramp_segments, strict=True):
        assert release.prices[0, segments[-1]] < release.prices[0, face]
