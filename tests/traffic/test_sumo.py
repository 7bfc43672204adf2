"""Simulated traffic: it flows, jams and recovers, and runs in SUMO are closed."""

import dataclasses
import itertools

import numpy as np
import pytest

from dptse_env.traffic import (
    CORRIDORS,
    MAINLINE,
    PAPER_HIGHWAY,
    SHORT_HIGHWAY,
    Drivers,
    Incident,
    RecordingError,
    SumoVersionError,
    VehicleClass,
    average_dwell,
    draw_scenario,
    simulate,
)
from dptse_env.traffic.sumo import limit_changes, running, seconds
from tests.helpers import UNEVEN
from tests.traffic.test_record import assert_same

N = PAPER_HIGHWAY.n_mainline
INCIDENT = PAPER_HIGHWAY.incident.segment
CLASSES = (
    VehicleClass("car", 0.7),
    VehicleClass("truck", 0.3, length=12.0, largest_speed=60.0, drivers=Drivers("Krauss")),
)
ROAD = dataclasses.replace(
    UNEVEN, duration=240, incident=Incident(5, ((60.0, 120.0, 10.0), (120.0, 140.0, 40.0)))
)


def mean_speed(record, steps, columns):
    """Mean speed over vehicles [km/h]."""
    return record.speed_sums[steps, columns].sum() / record.counts[steps, columns].sum()


def outflow(record, column, start, end):
    """Flow [veh/h] out of a record column between two steps."""
    here = record.segment == column
    seen = record.vehicle[here & (record.step >= start) & (record.step < end)]
    left = len(np.unique(seen)) - record.counts[end - 1, column]
    return 3600.0 * left / (end - start)


def test_the_table_is_ordered_by_step_then_segment_and_starts_empty(short_record):
    order = short_record.step.astype(int) * short_record.n_columns + short_record.segment
    assert np.all(np.diff(order) >= 0)
    assert short_record.n_steps == SHORT_HIGHWAY.duration + 1
    assert short_record.n_columns == SHORT_HIGHWAY.n_segments + SHORT_HIGHWAY.n_boundaries
    assert short_record.counts[0].sum() == 0
    assert short_record.counts[-1].sum() > 0


@pytest.mark.parametrize("name", ["paper-highway", "short-highway"])
def test_vehicles_follow_their_routes_without_a_gap(name, short_record, paper_records):
    """No vehicle vanishes, reappears, turns back, or is somewhere off its route."""
    corridor = CORRIDORS[name]
    record = short_record if name == "short-highway" else paper_records[0]
    scenario = draw_scenario(corridor, 0)
    n, s = corridor.n_mainline, corridor.n_segments
    for vehicle in range(0, record.n_vehicles, 5):
        rows = record.vehicle == vehicle
        if not rows.any():
            continue
        assert np.all(np.diff(record.step[rows]) == 1)
        origin, end = scenario.origins[vehicle], scenario.exits[vehicle]
        first = 0 if origin == MAINLINE else corridor.on_ramps[origin]
        last = n if end == MAINLINE else corridor.off_ramps[end]
        entry = [s] if origin == MAINLINE else [s + 2 + origin, n + origin]
        off = n + corridor.n_on_ramps + end
        leave = [s + 1] if end == MAINLINE else [off, s + 2 + corridor.n_on_ramps + end]
        route = [*entry, *range(first, last), *leave]
        places = [route.index(column) for column in record.segment[rows]]
        assert np.all(np.diff(places) >= 0)
        assert np.all(np.diff(places) <= 1)


def test_traffic_is_free_before_the_incident_on_road_and_ramps(paper_records):
    for record in paper_records:
        assert 85 < mean_speed(record, slice(30, 200), slice(0, N)) < 105
        assert 85 < mean_speed(record, slice(30, 200), slice(N, N + 4)) < 105
        assert record.counts[:200, :N].max() <= 12


def test_the_incident_jams_its_segment_and_the_queue_reaches_the_entry(paper_records):
    for record in paper_records:
        assert 7 < mean_speed(record, slice(230, 400), INCIDENT) < 11
        assert 1_200 < outflow(record, INCIDENT, 230, 400) < 1_800
        # 150 veh/km is a jam; three lanes at standstill hold 400.
        jammed = record.counts[:, :N].max(axis=0) >= 15
        assert jammed[1 : INCIDENT + 1].all()
        assert not jammed[INCIDENT + 2 :].any()
        assert record.counts[:, :N].max() <= 40


def test_the_road_recovers_after_the_incident(paper_records):
    for record in paper_records:
        assert 3_900 < outflow(record, INCIDENT, 420, 500) < 5_500
        assert mean_speed(record, slice(660, 700), slice(0, N)) > 40
        assert mean_speed(record, slice(600, 700), INCIDENT) > 40


def test_ramps_flow_and_no_merge_locks(paper_records):
    """With internal links, pairs of vehicles lock a merge for the rest of half of the runs."""
    for record in paper_records:
        for on_ramp in (N, N + 1):
            assert outflow(record, on_ramp, 450, 700) > 100
        for off_ramp in (N + 2, N + 3):
            assert outflow(record, off_ramp, 450, 700) > 100
        order = np.lexsort((record.step, record.vehicle))
        standing = record.speed[order] < 0.5
        changes = np.flatnonzero(np.diff(standing.astype(int)) | np.diff(record.vehicle[order]))
        runs = np.diff([0, *(changes + 1), len(standing)])
        longest = runs[standing[[0, *(changes + 1)]]].max()
        assert longest < 150


def test_a_vehicle_dwells_as_long_as_the_preset_says(paper_records):
    """The preset's value is the mean over seeds 0..15; these four come close to it."""
    measured = average_dwell(PAPER_HIGHWAY, paper_records)
    assert measured == pytest.approx(PAPER_HIGHWAY.average_dwell, rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("corridor", CORRIDORS.values(), ids=CORRIDORS)
def test_the_presets_dwell_is_that_of_seeds_0_to_15(corridor):
    records = [simulate(corridor, seed) for seed in range(16)]
    assert average_dwell(corridor, records) == pytest.approx(corridor.average_dwell, abs=0.005)


def test_the_same_seed_gives_the_same_record_silently_and_another_seed_another(short_record, capfd):
    assert_same(simulate(SHORT_HIGHWAY, 0), short_record)
    assert capfd.readouterr() == ("", "")
    other = simulate(SHORT_HIGHWAY, 1)
    assert not np.array_equal(other.counts, short_record.counts)


def test_a_bare_run_is_the_run_that_is_recorded(short_record):
    scenario = draw_scenario(SHORT_HIGHWAY, 0)
    with running(SHORT_HIGHWAY, scenario) as libsumo:
        counts = [libsumo.vehicle.getIDCount() for _ in seconds(libsumo, SHORT_HIGHWAY, scenario)]
        assert libsumo.simulation.getTime() == SHORT_HIGHWAY.duration
    np.testing.assert_array_equal(counts, short_record.counts.sum(axis=1))


def test_a_run_is_closed_however_it_ends():
    import libsumo

    scenario = draw_scenario(SHORT_HIGHWAY, 3)

    def interrupted():
        assert libsumo.isLoaded()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), running(SHORT_HIGHWAY, scenario):
        interrupted()
    assert not libsumo.isLoaded()
    with (
        pytest.raises(RecordingError, match=r"traffic seed 3 failed: .*nowhere"),
        running(SHORT_HIGHWAY, scenario),
    ):
        libsumo.edge.getLastStepVehicleIDs("nowhere")
    assert not libsumo.isLoaded()


def test_another_release_series_is_refused(monkeypatch):
    import libsumo

    monkeypatch.setattr(libsumo, "getVersion", lambda: (22, "SUMO 1.29.0"))
    with pytest.raises(SumoVersionError, match=r"series 1\.28, found 1\.29\.0"):
        simulate(SHORT_HIGHWAY, 0)


def test_drivers_shape_the_traffic(short_record):
    """The same departures, driven otherwise."""
    record = simulate(dataclasses.replace(SHORT_HIGHWAY, drivers=Drivers("IDM")), 0)
    assert record.n_steps == short_record.n_steps
    assert len(record.speed) > 0
    assert not np.array_equal(record.speed_sums, short_record.speed_sums)


def test_sumo_has_the_lengths_speeds_and_models_of_the_classes():
    corridor = dataclasses.replace(SHORT_HIGHWAY, vehicle_classes=CLASSES)
    scenario = draw_scenario(corridor, 0)
    seen, fastest = set(), np.zeros(2)
    with running(corridor, scenario) as libsumo:
        for _ in seconds(libsumo, corridor, scenario):
            for name in libsumo.vehicle.getIDList():
                kind = int(scenario.classes[int(name)])
                length = libsumo.vehicle.getLength(name)
                seen.add((kind, length))
                fastest[kind] = max(fastest[kind], 3.6 * libsumo.vehicle.getSpeed(name))
    assert seen == {(0, 5.0), (1, 12.0)}
    assert fastest[1] == pytest.approx(60.0, abs=0.001)
    assert fastest[0] > 80.0


def test_limits_return_to_normal_between_phases_only_where_there_is_a_gap():
    touching = Incident(0, ((10, 20, 5), (20, 30, 50)))
    apart = Incident(0, ((10, 20, 5), (25, 30, 50)))
    assert limit_changes([touching], [100.0]) == [(10, 0, 5), (20, 0, 50), (30, 0, 100)]
    assert limit_changes([apart], [100.0]) == [
        (10, 0, 5), (20, 0, 100), (25, 0, 50), (30, 0, 100),
    ]  # fmt: skip


def test_the_lowest_limit_holds_where_incidents_overlap():
    first, second = Incident(1, ((10, 40, 20),)), Incident(1, ((20, 30, 5), (30, 50, 60)))
    elsewhere = Incident(0, ((15, 25, 8),))
    assert limit_changes([first, second, elsewhere], [100.0, 80.0]) == [
        (10, 1, 20), (15, 0, 8), (20, 1, 5), (25, 0, 100), (30, 1, 20), (40, 1, 60), (50, 1, 80),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def uneven():
    return simulate(ROAD, 0)


def successors(corridor):
    """Columns into which a vehicle may pass from each column."""
    n, s = corridor.n_mainline, corridor.n_segments
    following = {i: {i + 1} for i in range(n - 1)} | {n - 1: {s + 1}, s: {0}}
    boundary = s + 2
    for face, segments in zip(corridor.on_ramps, corridor.on_ramp_segments, strict=True):
        chain = [boundary, *segments, face]
        following |= {a: {b} for a, b in itertools.pairwise(chain)}
        boundary += 1
    for face, segments in zip(corridor.off_ramps, corridor.off_ramp_segments, strict=True):
        chain = [*segments, boundary]
        following |= {a: {b} for a, b in itertools.pairwise(chain)}
        following[face - 1].add(segments[0])
        boundary += 1
    return following


def test_vehicles_pass_from_segment_to_segment_along_the_road(uneven):
    following = successors(ROAD)
    passed = set()
    for vehicle in range(uneven.n_vehicles):
        mine = uneven.vehicle == vehicle
        places, steps = uneven.segment[mine].tolist(), uneven.step[mine]
        assert np.all(np.diff(steps) == 1), "a vehicle vanished for a while"
        for a, b in itertools.pairwise(places):
            if a != b:
                # A second may take a fast vehicle over the whole of a short segment.
                reached, two = following[a], set()
                for between in reached:
                    two |= following.get(between, set())
                assert b in reached | two, (a, b)
                passed.add((a, b))
    for a, reached in following.items():
        assert any((a, b) in passed for b in reached), f"nobody ever left column {a}"


def test_the_limit_after_an_incident_is_that_of_its_segment(uneven):
    slow, after = slice(80, 120), slice(180, 240)
    speeds = uneven.speed_sums[:, 5] / np.maximum(uneven.counts[:, 5], 1)
    seen = uneven.counts[:, 5] > 0
    assert speeds[slow][seen[slow]].mean() < 20.0
    assert 40.0 < speeds[after][seen[after]].mean() <= 1.2 * 80.0
