"""Simulated traffic: it flows, jams and recovers, and runs in SUMO are closed."""

import numpy as np
import pytest

from dptse_env.traffic import (
    CORRIDORS,
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

CLASSES = (
    VehicleClass("car", 0.7),
    VehicleClass("truck", 0.3, length=12.0, largest_speed=60.0, drivers=Drivers("Krauss")),
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


def test_traffic_flows_jams_and_recovers():
    n, incident = PAPER_HIGHWAY.geometry.n_mainline, PAPER_HIGHWAY.conditions.incident.segment
    record = simulate(PAPER_HIGHWAY, 0)
    assert 85 < mean_speed(record, slice(30, 200), slice(0, n)) < 105
    assert 85 < mean_speed(record, slice(30, 200), slice(n, n + 4)) < 105
    assert record.counts[:200, :n].max() <= 12
    assert 7 < mean_speed(record, slice(230, 400), incident) < 11
    assert 1_200 < outflow(record, incident, 230, 400) < 1_800
    # 150 veh/km is a jam; three lanes at standstill hold 400. The queue reaches the entry.
    jammed = record.counts[:, :n].max(axis=0) >= 15
    assert jammed[1 : incident + 1].all()
    assert not jammed[incident + 2 :].any()
    assert record.counts[:, :n].max() <= 40
    assert 3_900 < outflow(record, incident, 420, 500) < 5_500
    assert mean_speed(record, slice(660, 700), slice(0, n)) > 40
    # With internal links, pairs of vehicles lock a merge for the rest of half of the runs.
    assert min(outflow(record, ramp, 450, 700) for ramp in range(n, n + 4)) > 100


def test_the_limit_after_an_incident_is_that_of_its_segment():
    phases = (60.0, 120.0, 10.0), (120.0, 140.0, 40.0)
    record = simulate(UNEVEN.replaced(duration=240, incident=Incident(5, phases)), 0)
    assert mean_speed(record, slice(80, 120), 5) < 20.0
    assert 40.0 < mean_speed(record, slice(180, 240), 5) <= 1.2 * 80.0


def test_the_lowest_limit_holds_and_returns_to_normal_where_there_is_a_gap():
    touching = Incident(0, ((10, 20, 5), (20, 30, 50)))
    apart = Incident(0, ((10, 20, 5), (25, 30, 50)))
    assert limit_changes([touching], [100.0]) == [(10, 0, 5), (20, 0, 50), (30, 0, 100)]
    assert limit_changes([apart], [100.0]) == [
        (10, 0, 5), (20, 0, 100), (25, 0, 50), (30, 0, 100),
    ]  # fmt: skip
    first, second = Incident(1, ((10, 40, 20),)), Incident(1, ((20, 30, 5), (30, 50, 60)))
    elsewhere = Incident(0, ((15, 25, 8),))
    assert limit_changes([first, second, elsewhere], [100.0, 80.0]) == [
        (10, 1, 20), (15, 0, 8), (20, 1, 5), (25, 0, 100), (30, 1, 20), (40, 1, 60), (50, 1, 80),
    ]  # fmt: skip


def test_the_same_seed_gives_the_same_record_silently_and_other_drivers_another(
    short_record, capfd
):
    assert_same(simulate(SHORT_HIGHWAY, 0), short_record)
    assert capfd.readouterr() == ("", "")
    assert short_record.counts[0].sum() == 0
    record = simulate(SHORT_HIGHWAY.replaced(drivers=Drivers("IDM")), 0)
    assert len(record.speed) > 0
    assert not np.array_equal(record.speed_sums, short_record.speed_sums)


@pytest.mark.slow
@pytest.mark.parametrize("corridor", CORRIDORS.values(), ids=CORRIDORS)
def test_the_presets_dwell_is_that_of_seeds_0_to_15(corridor):
    records = [simulate(corridor, seed) for seed in range(16)]
    assert average_dwell(corridor, records) == pytest.approx(
        corridor.scales.average_dwell, abs=0.005
    )


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


@pytest.mark.parametrize(
    ("version", "refused"),
    [
        ("1.18.0", r"must be 1\.28 or newer, found 1\.18\.0"),
        ("1.100.0", r"reports version 1\.100\.0 but is installed as"),
    ],
)
def test_a_libsumo_that_another_package_overwrote_is_refused(version, refused, monkeypatch):
    import libsumo

    monkeypatch.setattr(libsumo, "getVersion", lambda: (22, f"SUMO {version}"))
    with pytest.raises(SumoVersionError, match=refused):
        simulate(SHORT_HIGHWAY, 0)


def test_sumo_has_the_lengths_speeds_and_models_of_the_classes():
    corridor = SHORT_HIGHWAY.replaced(vehicle_classes=CLASSES)
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
