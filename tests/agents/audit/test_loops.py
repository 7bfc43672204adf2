"""The audit beside loops: reports are replaced or left out, and both worlds have one reading."""

import dataclasses

import numpy as np
import pytest

from agents.audit.attack import make_overheard
from agents.audit.planner import Planner
from agents.audit.report import audit_environment, audit_one_run
from agents.audit.worlds import Trajectory, Worlds
from dptse_env.traffic import Loops, readings

from . import small

ROAD = small.ROAD.replaced(fixed_sensors=(), loops=Loops(positions=(0.3,), interval=10))


def beside_loops(setting):
    return dataclasses.replace(setting, corridor=ROAD)


def passing(record):
    """Worlds with and without a vehicle that passes the loop."""
    table = readings(record, ROAD.stations, ROAD.loops)
    for vehicle in range(record.n_vehicles):
        rest = record.without(vehicle)
        if not np.array_equal(readings(rest, ROAD.stations, ROAD.loops), table, equal_nan=True):
            pair = Trajectory.from_record(record, vehicle), Trajectory.absent()
            return Worlds.adjacent(rest, pair)
    raise AssertionError("nobody passes the loop")


def test_a_vehicle_that_is_left_out_changes_no_reading_nor_what_follows_of_it(record):
    worlds = passing(record)
    process, _ = make_overheard(beside_loops(small.paced("ekf")), worlds, 2)
    both = np.arange(2)
    streams = [np.random.default_rng(0) for _ in both]
    process.reset(both, streams, {"traffic_seed": both, "start": 0})
    for _ in range(small.HORIZON):
        process.step(both, np.zeros((2, 6), dtype=np.int8))
    zero, one = process.traffic.readings
    assert zero[..., 0].max() > 0
    np.testing.assert_array_equal(zero, one)
    np.testing.assert_array_equal(*process.estimate.speed)


@pytest.mark.parametrize("preset", ["capped", "paced"])
@pytest.mark.parametrize("kind", ["worst-case", "replaced", "deleted"])
def test_every_target_stays_below_mu(preset, kind, record):
    setting = small.paced("ekf") if preset == "paced" else small.config(epsilon=5.0)
    setting = beside_loops(setting)
    worlds = Planner(setting).choose(record, kind)
    assert (0.5 if kind == "deleted" else 0.8) < small.reached(setting, worlds) <= 1.0 + 1e-9


def test_the_finding_says_what_was_attacked(record):
    setting = small.config(epsilon=5.0)
    for made in (setting, beside_loops(setting)):
        findings = (
            audit_environment(made, record, "deleted", trials=50),
            audit_one_run(made, record),
        )
        for finding in findings:
            said = " ".join(line for line in finding.report("") if isinstance(line, str))
            assert ("only reports were replaced or left out" in said) == (made is not setting)
            assert finding.verdict == "not rejected"
        target = findings[0].attack.target
        assert target.startswith("the reports of vehicle ") == (made is not setting)


def test_the_distance_of_a_finding_is_the_largest_of_its_runs(record):
    setting = small.paced("ekf")
    distances = small.runs_of(setting, Planner(setting).choose(record, "deleted"), 20).distances
    assert distances.max() > distances.min()
    found = audit_environment(setting, record, "deleted", trials=20)
    assert found.attack.distance == pytest.approx(distances.max(), rel=1e-12)
