"""Surroundings of vehicles, in traffic placed by hand."""

import numpy as np
import pytest

from dptse_env.traffic import SHORT_HIGHWAY, DetailedRecord, Penetration
from dptse_env.traffic.surroundings import road_by_neighbours, road_by_spacing

N = SHORT_HIGHWAY.n_mainline
UPSTREAM, DOWNSTREAM = SHORT_HIGHWAY.n_segments, SHORT_HIGHWAY.n_segments + 1
ON_RAMP, FACE = N, 0.1 * SHORT_HIGHWAY.on_ramps[0]
LANES = 2


def standing(*vehicles):
    """A record of one second; each vehicle has a column, a position [km] and a lane."""
    segment, position, lane = (np.array(column) for column in zip(*vehicles, strict=True))
    nothing = np.zeros(len(vehicles))
    n_columns = SHORT_HIGHWAY.n_segments + SHORT_HIGHWAY.n_boundaries
    return DetailedRecord(
        nothing, np.arange(len(vehicles)), segment, nothing, 1, n_columns,
        position, lane, nothing, ("car",),
    )  # fmt: skip


def road(*vehicles):
    return road_by_spacing(standing(*vehicles), SHORT_HIGHWAY)


def density(*vehicles, reach=0.05):
    return 1.0 / road_by_neighbours(standing(*vehicles), SHORT_HIGHWAY, reach)


def test_a_vehicle_has_the_way_to_the_one_ahead_in_its_lane_over_the_lanes():
    found = road((1, 0.15, 0), (1, 0.12, 0), (2, 0.24, 1), (1, 0.13, 1), (0, 0.02, 0))
    farthest = 1.0 / LANES
    expected = [farthest, 0.03 / LANES, farthest, 0.11 / LANES, 0.10 / LANES]
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_vehicles_ahead_are_seen_across_the_boundary_segments():
    found = road((UPSTREAM, -0.01, 0), (0, 0.01, 0), (N - 1, 0.59, 2), (DOWNSTREAM, 0.63, 2))
    lanes = np.array(SHORT_HIGHWAY.with_boundaries(SHORT_HIGHWAY.segment_lanes))
    ahead = np.array([0.02, 1.0, 0.04, 1.0])
    columns = [UPSTREAM, 0, N - 1, DOWNSTREAM]
    np.testing.assert_allclose(found, ahead / lanes[columns], rtol=1e-5)


def test_a_ramp_and_the_mainline_beside_it_do_not_see_each_other():
    beside = (1, FACE - 0.05, 0), (ON_RAMP, FACE - 0.04, 0), (ON_RAMP, FACE - 0.02, 0)
    np.testing.assert_allclose(road(*beside), [1.0 / LANES, 0.02, 1.0], rtol=1e-5)
    np.testing.assert_allclose(density(*beside), [10.0, 2 / 0.09, 2 / 0.07], rtol=1e-5)


def test_neighbours_are_those_within_reach_and_the_vehicle_itself():
    found = density((1, 0.10, 0), (1, 0.13, 2), (1, 0.149, 1), (2, 0.26, 0), (3, 0.35, 0))
    np.testing.assert_allclose(found, [30.0, 30.0, 30.0, 10.0, 10.0], rtol=1e-5)


@pytest.fixture(scope="module")
def evenly_spaced():
    """30 vehicles a kilometre and lane on the mainline."""
    positions = np.arange(0.0, 0.6, 1.0 / 30.0)
    vehicles = [(int(x / 0.1 + 1e-9), x, lane) for lane in range(LANES) for x in positions]
    return standing(*sorted(vehicles))


def test_neighbours_of_vehicles_at_random_give_the_density():
    """The vehicle itself is one of its neighbours, which the mean of the reciprocals allows for."""
    position = np.sort(np.random.default_rng(0).uniform(0.0, 0.6, (500, 36)), axis=1)
    step = np.repeat(np.arange(500), 36)
    zero = np.zeros(step.size)
    n_columns = SHORT_HIGHWAY.n_segments + SHORT_HIGHWAY.n_boundaries
    record = DetailedRecord(
        step, np.tile(np.arange(36), 500), (position / 0.1).ravel(), zero, 500, n_columns,
        position.ravel(), zero, zero, ("car",),
    )  # fmt: skip
    inner = (record.position > 0.05) & (record.position < 0.55)
    road = road_by_neighbours(record, SHORT_HIGHWAY, 0.05)[inner]
    assert 60.0 * road.mean() == pytest.approx(1.0, abs=0.02)
    assert (1.0 / road).mean() > 68.0


@pytest.mark.parametrize("source", ["spacing", "neighbours"])
def test_vehicles_report_those_that_are_not_connected_too(source, evenly_spaced):
    penetration = Penetration(0.3, density_from=source)
    reported = penetration.reports(0, evenly_spaced, SHORT_HIGHWAY)
    everyone = Penetration(density_from=source).reports(0, evenly_spaced, SHORT_HIGHWAY)
    connected = np.flatnonzero(penetration.connected(0, evenly_spaced))
    assert 0 < len(connected) < evenly_spaced.n_vehicles
    np.testing.assert_array_equal(reported.vehicle, connected)
    np.testing.assert_array_equal(reported.report, everyone.report[connected])
    assert everyone.n_rows == evenly_spaced.n_rows
