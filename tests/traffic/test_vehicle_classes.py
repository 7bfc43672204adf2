"""Vehicle classes: in the scenario, in SUMO, and in what identifies a record."""

import dataclasses

import numpy as np
import pytest

from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY, Drivers, VehicleClass, draw_scenario
from dptse_env.traffic.sumo import running, seconds

CLASSES = (
    VehicleClass("car", 0.7),
    VehicleClass("truck", 0.3, length=12.0, largest_speed=60.0, drivers=Drivers("Krauss")),
)


def with_classes(corridor=SHORT_HIGHWAY, classes=CLASSES):
    return dataclasses.replace(corridor, vehicle_classes=classes)


def test_vehicles_have_classes_by_their_shares_and_else_move_alike():
    corridor = with_classes(PAPER_HIGHWAY)
    scenarios = [draw_scenario(corridor, seed) for seed in range(20)]
    classes = np.concatenate([each.classes for each in scenarios])
    assert classes.mean() == pytest.approx(0.3, abs=0.02)
    assert set(classes.tolist()) == {0, 1}
    plain = draw_scenario(PAPER_HIGHWAY, 3)
    assert not plain.classes.any()
    for name in ("departures", "origins", "exits"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(scenarios[3], name))
    assert plain.sumo_seed == scenarios[3].sumo_seed


def test_sumo_has_the_lengths_speeds_and_models_of_the_classes():
    corridor = with_classes()
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


def test_records_of_other_classes_are_other_records():
    digests = {
        SHORT_HIGHWAY.digest,
        with_classes().digest,
        with_classes(classes=(VehicleClass("car", 1.0),)).digest,
    }
    assert len(digests) == 3
    assert with_classes(classes=()).digest == SHORT_HIGHWAY.digest
