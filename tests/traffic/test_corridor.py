import dataclasses
import json
import pickle
import subprocess
import sys

import pytest

from agents.environments import make_config
from dptse_env.traffic import (
    PAPER_HIGHWAY,
    SHORT_HIGHWAY,
    Demand,
    Drivers,
    Incident,
    IncidentDistribution,
    SumoScenario,
    VehicleClass,
)


def changed(**fields):
    return dataclasses.replace(PAPER_HIGHWAY, **fields)


def test_paper_highway_has_the_papers_dimensions():
    assert PAPER_HIGHWAY.n_segments == 19
    assert PAPER_HIGHWAY.n_boundaries == 6
    assert PAPER_HIGHWAY.segment_lanes == (3,) * 15 + (1,) * 4
    assert PAPER_HIGHWAY.segment_names[14] == "mainline 15"
    assert PAPER_HIGHWAY.segment_names[15:] == (
        "on-ramp 1",
        "on-ramp 2",
        "off-ramp 1",
        "off-ramp 2",
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"name": "Paper Highway"}, r"corridor\.name must be lower-case"),
        ({"n_mainline": 1}, r"corridor\.n_mainline must be an integer in 2\.\.1000, got 1"),
        ({"n_mainline": 15.0}, r"corridor\.n_mainline must be an integer"),
        ({"duration": 0}, r"corridor\.duration must be an integer in 1\.\.100000, got 0"),
        ({"lanes": True}, r"corridor\.lanes must be an integer"),
        ({"ramp_lanes": 4}, r"corridor\.ramp_lanes must be <= 3 lanes at face 3, got 4"),
        ({"segment_length": 0.01}, r"corridor\.segment_length must be .*, got 0\.01"),
        ({"speed_limit": float("nan")}, r"corridor\.speed_limit must be .*, got nan"),
        ({"average_dwell": 0.0}, r"corridor\.average_dwell must be .*, got 0\.0"),
        ({"on_ramps": (0, 9)}, r"corridor\.on_ramps\[0\] must be an integer in 1\.\.999, got 0"),
        ({"off_ramps": (6, 15)}, r"corridor\.off_ramps\[1\] must be an integer in 1\.\.14"),
        ({"on_ramps": (9, 3)}, r"corridor\.on_ramps must be increasing, got \(9, 3\)"),
        ({"on_ramps": (3, 3)}, r"corridor\.on_ramps must be increasing"),
        ({"off_ramps": (3, 12)}, r"corridor\.off_ramps must be at other faces"),
        (
            {"exit_shares": (0.1,)},
            r"corridor\.exit_shares must be one share for each of the 2 off-ramps, got \(0\.1,\)",
        ),
        ({"exit_shares": (0.1, 1.0)}, r"corridor\.exit_shares\[1\] must be .*, got 1\.0"),
        ({"exit_shares": (0.0, 0.1)}, r"corridor\.exit_shares\[0\] must be .*, got 0\.0"),
        ({"fixed_sensors": (14, 19)}, r"corridor\.fixed_sensors\[1\] must be .* 0\.\.18, got 19"),
        ({"fixed_sensors": (14, 14)}, r"corridor\.fixed_sensors must be free of duplicates"),
        ({"demand": Demand(((0, 1.0),), (1.0,))}, r"corridor\.demand\.on_ramps must be one rate"),
        (
            {"demand": 2000},
            r"corridor\.demand must be a mapping or Demand or DemandDistribution, got 2000",
        ),
        ({"incident": Incident(15, ((0, 1, 1),))}, r"incident\.segment must be .* 0\.\.14, got 15"),
        ({"incident": Incident(3, ((700, 800, 1),))}, r"incident\.start must be < 700 s, got 700"),
        ({"incident": IncidentDistribution((0, 15))}, r"incident\.segment must be .*got 15"),
        (
            {"incident": "random"},
            r"corridor\.incident must be a mapping or Incident or .* or None, got 'random'",
        ),
    ],
)
def test_impossible_corridors_are_refused_by_path(fields, message):
    with pytest.raises(ValueError, match=message):
        changed(**fields)


def test_lists_become_tuples_so_that_a_corridor_from_json_is_equal_and_hashable():
    fields = json.loads(json.dumps(dataclasses.asdict(PAPER_HIGHWAY)))
    fields["demand"] = Demand(**fields["demand"])
    fields["incident"] = Incident(**fields["incident"])
    rebuilt = type(PAPER_HIGHWAY)(**fields)
    assert rebuilt == PAPER_HIGHWAY
    assert hash(rebuilt) == hash(PAPER_HIGHWAY)
    assert rebuilt.digest == PAPER_HIGHWAY.digest


def test_the_digest_covers_what_shapes_the_traffic_and_nothing_else():
    changes = {
        "n_mainline": 16,
        "on_ramps": (4, 9),
        "off_ramps": (7, 12),
        "exit_shares": (0.1, 0.2),
        "demand": PAPER_HIGHWAY.demand.scaled(1.01),
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
        "network": SumoScenario(
            net="a.net.xml",
            routes=("a.rou.xml",),
            sha256=("0", "1"),
            columns=tuple(((f"edge {i}", 0.0, 100.0),) for i in range(25)),
            folder=".",
        ),
        "vehicle_classes": (VehicleClass("car", 0.9), VehicleClass("truck", 0.1, length=12.0)),
        "detailed": True,
    }
    observed = {
        "name": "other",
        "fixed_sensors": (14,),
        "density_scale": 1.0,
        "speed_scale": 1.0,
        "average_dwell": 1.0,
    }
    names = {field.name for field in dataclasses.fields(PAPER_HIGHWAY)}
    assert names == {"recordings", *changes, *observed}, (
        "say here whether a new field shapes the traffic"
    )
    digests = [changed(**{field: value}).digest for field, value in changes.items()]
    assert len({PAPER_HIGHWAY.digest, *digests}) == 1 + len(changes)
    for field, value in observed.items():
        assert changed(**{field: value}).digest == PAPER_HIGHWAY.digest


def test_integers_and_floats_of_one_value_give_one_digest():
    assert changed(speed_limit=102).digest == PAPER_HIGHWAY.digest


def test_the_digest_is_the_same_in_another_process():
    code = "from dptse_env.traffic import SHORT_HIGHWAY; print(SHORT_HIGHWAY.digest)"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == SHORT_HIGHWAY.digest
    assert pickle.loads(pickle.dumps(SHORT_HIGHWAY)).digest == SHORT_HIGHWAY.digest


def test_records_from_before_drivers_could_be_chosen_keep_their_digests():
    assert PAPER_HIGHWAY.digest.startswith("2324ff6dffb73fb3")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"model": "Gipps"}, r"corridor\.drivers\.model must be"),
        ({"headway": 0.0}, r"corridor\.drivers\.headway must be"),
    ],
)
def test_bad_drivers_are_named(fields, message):
    with pytest.raises(ValueError, match=message):
        make_config("dptse_env:dptse/PaperHighway-v0", {"corridor": {"drivers": fields}})
