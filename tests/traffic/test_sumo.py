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
from tests.model.roads import UNEVEN
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
















@pytest.mark.slow
@pytest.mark.parametrize("corridor", CORRIDORS.values(), ids=CORRIDORS)
def test_the_presets_dwell_is_that_of_seeds_0_to_15(corridor):
    records = [simulate(corridor, seed) for seed in range(16)]
    assert average_dwell(corridor, records) == pytest.approx(corridor.average_dwell, abs=0.005)






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












