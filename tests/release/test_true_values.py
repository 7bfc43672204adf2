import numpy as np
import pytest

from dptse_env.release import (
    RELEASE_MODELS,
    CappedSettings,
    PrivacySettings,
    ReleaseRequest,
    ReleaseSetup,
    TrafficTable,
)
from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary

from .worlds import AWAY, Worlds, record


@pytest.fixture(scope="module")
def traffic():
    traffic = TrafficTable(SHORT_HIGHWAY, (4, 7), RecordLibrary())
    traffic.load(0)
    return traffic


def test_aggregates_are_counts_and_means_over_vehicles(traffic):
    record = traffic.library.get(SHORT_HIGHWAY, 4)
    rows = record.rows(120)
    segments, speeds = record.segment[rows], record.speed[rows].astype(float)
    (answer,) = traffic.aggregates(np.array([0]), np.array([120]))
    occupied = 0
    for segment in range(SHORT_HIGHWAY.n_segments):
        here = speeds[segments == segment]
        assert answer[segment, 0] == pytest.approx(len(here) / 0.1)
        if len(here):
            occupied += 1
            assert answer[segment, 1] == pytest.approx(here.mean())
    assert occupied > 3


def test_an_empty_segment_answers_with_the_speed_limit(traffic):
    whole = traffic.complete(0)
    empty = whole[..., 0] == 0
    assert empty[0].all()  # the road is empty at second 0
    assert 0 < empty[100:].sum() < empty[100:].size
    assert (whole[..., 1][empty] == SHORT_HIGHWAY.speed_limit).all()


def test_traffic_is_loaded_once(traffic):
    assert traffic.load(0) == []
    fresh = TrafficTable(SHORT_HIGHWAY, (4,), traffic.library)
    ((index, loaded),) = fresh.load(np.array([0, 0]))
    assert index == 0
    assert loaded is traffic.record(0)
    assert fresh.load(0) == []


def test_missing_records_are_made_together(tmp_path, monkeypatch):
    library = RecordLibrary(tmp_path)
    ensured = []
    monkeypatch.setattr(library, "ensure", lambda corridor, seeds: ensured.append(list(seeds)))
    traffic = TrafficTable(SHORT_HIGHWAY, (4, 7, 9), RecordLibrary())
    traffic.load(0)
    monkeypatch.setattr(library, "get", traffic.library.get)
    traffic.library = library
    assert [index for index, _ in traffic.load(np.array([2, 0, 1, 2]))] == [1, 2]
    assert ensured == [[7, 9]]


def test_boundary_segments_come_last(traffic):
    whole = traffic.complete(0)
    assert whole.shape == (241, SHORT_HIGHWAY.n_segments + SHORT_HIGHWAY.n_boundaries, 2)
    segments = traffic.aggregates(np.zeros(241, dtype=np.int64), np.arange(241))
    np.testing.assert_array_equal(whole[:, : SHORT_HIGHWAY.n_segments], segments)


# --- values with bounded contributions -----------------------------------------------------------


def bounded(speed, cap=None):
    places = np.array([[AWAY, 1, 1], [AWAY, 1, 2], [AWAY, AWAY, 5]])
    speeds = np.array([[0, 20, 150], [0, 60, 40], [0, 0, 102]])
    unit = "horizon" if cap is None else "trip"
    settings = CappedSettings(unit=unit, cap=cap or 64, speed_release=speed)
    return Worlds(record(places, speeds, 12)).release(settings)


def true_values(release, time, *queried):
    observed = np.zeros((1, 12), dtype=bool)
    observed[0, list(queried)] = True
    first = np.zeros(1, dtype=np.int64)
    return release.true_values(ReleaseRequest(first, first, np.array([time]), observed))[0]


def test_a_flow_is_a_sum_of_centred_and_clipped_speeds():
    release = bounded("flow")
    np.testing.assert_allclose(true_values(release, 1, 1)[1], [20.0, ((20 - 51) + (60 - 51)) / 0.1])
    now = true_values(release, 2, 1, 2, 3)
    np.testing.assert_allclose(now[1], [10.0, 510.0])  # 150 km/h is clipped to 102
    np.testing.assert_allclose(now[2], [10.0, (40 - 51) / 0.1])
    np.testing.assert_array_equal(now[3], [0.0, 0.0])  # nobody there
    np.testing.assert_array_equal(now[5], [0.0, 0.0])  # not queried


def test_a_mean_is_over_those_that_count():
    release = bounded("mean", cap=1)
    np.testing.assert_allclose(true_values(release, 1, 1)[1], [20.0, 40.0])
    now = true_values(release, 2, 1, 2, 5)
    np.testing.assert_allclose(now[[1, 2]], [[0.0, 102.0]] * 2)  # both have counted before
    np.testing.assert_allclose(now[5], [10.0, 102.0])


def make(settings, traffic):
    setup = ReleaseSetup(settings.preset, settings, traffic, 2, 240, 1)
    release = RELEASE_MODELS[settings.preset](setup)
    release.load(0, traffic.record(0))
    return release


@pytest.mark.parametrize(
    "settings", [PrivacySettings("paper"), PrivacySettings("corrected")], ids=str
)
def test_the_paper_s_models_release_aggregates_of_all_vehicles(traffic, settings):
    release, first = make(settings, traffic), np.zeros(1, dtype=np.int64)
    for t in (1, 120, 240):
        observed = np.zeros((1, 8), dtype=bool)
        found = release.true_values(ReleaseRequest(first, first, np.array([t]), observed))
        np.testing.assert_array_equal(found, traffic.aggregates(first, np.array([t])))


def test_without_a_cap_the_values_are_the_aggregates(traffic):
    """Density of all vehicles, and the flow that follows from it and the mean speed."""
    bounded = make(CappedSettings(unit="horizon"), traffic)
    plain = make(PrivacySettings("paper"), traffic)
    first, everywhere = np.zeros(1, dtype=np.int64), np.ones((1, 8), dtype=bool)
    occupied = 0
    for t in range(1, 241):
        request = ReleaseRequest(first, first, np.array([t]), everywhere)
        density, flow = bounded.true_values(request)[0].T
        true_density, mean = plain.true_values(request)[0].T
        np.testing.assert_allclose(density, true_density)
        limit = SHORT_HIGHWAY.speed_limit
        # Some drivers are faster than the limit, and are clipped.
        assert (flow <= true_density * (mean - 0.5 * limit) + 1e-3).all()
        slow = mean < 0.6 * limit
        np.testing.assert_allclose(
            flow[slow], (true_density * (mean - 0.5 * limit))[slow], atol=1e-2, rtol=0.05
        )
        occupied += slow.sum()
    assert occupied > 10


@pytest.mark.parametrize(("unit", "most"), [("trip", 3), ("horizon", 240), ("event", 240)])
def test_the_cap_belongs_to_trips(traffic, unit, most):
    release = make(CappedSettings(unit=unit, cap=3), traffic)
    first, everywhere = np.zeros(1, dtype=np.int64), np.ones((1, 8), dtype=bool)
    for t in range(1, 241):
        release.true_values(ReleaseRequest(first, first, np.array([t]), everywhere))
    record = traffic.record(0)
    seconds = np.bincount(record.vehicle[record.segment < 8], minlength=record.n_vehicles)
    (counted,) = release.private_info(first, first)["exposures"]
    np.testing.assert_array_equal(counted, np.minimum(seconds, most))
