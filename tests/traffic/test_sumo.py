import dataclasses

import numpy as np
import pytest

from dptse_env.traffic import (
    CORRIDORS,
    MAINLINE,
    PAPER_HIGHWAY,
    SHORT_HIGHWAY,
    Drivers,
    Record,
    RecordingError,
    SumoVersionError,
    average_dwell,
    draw_scenario,
    simulate,
)
from dptse_env.traffic.sumo import running, seconds

N = PAPER_HIGHWAY.n_mainline
INCIDENT = PAPER_HIGHWAY.incident.segment


def assert_same(first, second):
    for name in Record.COLUMNS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


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
