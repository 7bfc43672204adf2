"""Corridors: what is refused, and what identifies their traffic."""

import json

import pytest

from dptse_env.traffic import (
    PAPER_HIGHWAY,
    Corridor,
    Demand,
    Drivers,
    Incident,
    Loops,
    SumoScenario,
    VehicleClass,
)


def changed(**fields):
    return PAPER_HIGHWAY.replaced(**fields)


IMPOSSIBLE = [
    ({"name": "Paper Highway"}, "name"),
    ({"duration": 0}, "duration"),
    ({"on_ramps": (0, 9)}, r"on_ramps\[0\]"),
    ({"off_ramps": (6, 15)}, r"off_ramps\[1\]"),
    ({"on_ramps": (3, 3)}, "on_ramps"),
    ({"off_ramps": (3, 12)}, "off_ramps"),
    ({"exit_shares": (0.1,)}, "exit_shares"),
    ({"exit_shares": (0.1, 1.0)}, r"exit_shares\[1\]"),
    ({"ramp_lanes": (1, 2, 2, 4)}, "ramp_lanes"),
    ({"ramp_lanes": (1, 1)}, "ramp_lanes"),
    ({"lanes": (3, 3)}, "lanes"),
    ({"segment_length": (0.1,) * 14 + (0.01,)}, r"segment_length\[14\]"),
    ({"fixed_sensors": (14, 19)}, r"fixed_sensors\[1\]"),
    ({"fixed_sensors": (14, 14)}, "fixed_sensors"),
    ({"demand": Demand(((0, 1.0),), (1.0,))}, r"demand\.on_ramps"),
    ({"demand": Demand(((0, 1.0),), (1.0, 1.0), (((0, 0.1),),))}, r"demand\.exit_shares"),
    ({"demand": 2000}, "demand"),
    ({"incident": Incident(15, ((0, 1, 1),))}, r"incident\.segment"),
    ({"incident": Incident(3, ((700, 800, 1),))}, r"incident\.start"),
    ({"vehicle_classes": (VehicleClass("car", 0.5),)}, "vehicle_classes"),
    ({"vehicle_classes": (VehicleClass("car", 0.5),) * 2}, "vehicle_classes"),
]


def test_impossible_corridors_are_refused_by_path():
    for fields, path in IMPOSSIBLE:
        with pytest.raises(ValueError, match=rf"corridor\.{path} must be"):
            changed(**fields)


def test_the_digest_covers_what_shapes_the_traffic_and_nothing_else():
    changes = {
        "n_mainline": 16,
        "on_ramps": (4, 9),
        "off_ramps": (7, 12),
        "exit_shares": (0.1, 0.2),
        "demand": PAPER_HIGHWAY.conditions.demand.scaled(1.01),
        "incident": None,
        "duration": 701,
        "lanes": 4,
        "ramp_lanes": 2,
        "segment_length": 0.2,
        "speed_limit": 100.0,
        "drivers": Drivers("IDM"),
        "ramp_segments": 2,
        "ramp_length": 0.2,
        "ramp_speed_limit": 60.0,
        "sumo": SumoScenario(
            net="a.net.xml",
            routes=("a.rou.xml",),
            sha256=("0", "1"),
            columns=tuple(((f"edge {i}", 0.0, 100.0),) for i in range(25)),
            folder=".",
        ),
        "vehicle_classes": (VehicleClass("car", 0.9), VehicleClass("truck", 0.1, length=12.0)),
    }
    observed = {
        "name": "other",
        "fixed_sensors": (14,),
        "loops": Loops((0.0, 0.5)),
        "density_scale": 1.0,
        "speed_scale": 1.0,
        "average_dwell": 1.0,
        "measured": ("demand",),
    }
    assert {*PAPER_HIGHWAY.fields()} == {"recordings", *changes, *observed}, (
        "say here whether a new field shapes the traffic"
    )
    digests = [changed(**{field: value}).digest for field, value in changes.items()]
    assert len({PAPER_HIGHWAY.digest, *digests}) == 1 + len(changes)
    for field, value in observed.items():
        assert changed(**{field: value}).digest == PAPER_HIGHWAY.digest
    assert PAPER_HIGHWAY.digest.startswith("302bed7ba1a96429"), "recorded libraries are lost"


def test_values_from_json_and_one_for_each_segment_make_an_equal_road():
    fields = json.loads(json.dumps(PAPER_HIGHWAY.fields()))
    fields |= {"lanes": [3] * 15, "segment_length": [0.1] * 15, "ramp_segments": [1] * 4}
    rebuilt = Corridor.from_fields(fields)
    assert rebuilt == PAPER_HIGHWAY
    assert hash(rebuilt) == hash(PAPER_HIGHWAY)
    assert rebuilt.digest == PAPER_HIGHWAY.digest
