import json

import numpy as np
import pytest

from agents.studies.audit.attack import attack
from agents.studies.audit.gaussian_planner import planned_distance
from agents.studies.audit.pairs import replay_pairs, study_pairs
from agents.studies.audit.series import play_series
from agents.studies.audit.strategies import FixedQueries, public_plan
from agents.studies.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.parts import privacy_report

from .small import config, paced

PAIRS = np.array([[0, 3], [3, 0], [5, 11], [2, 7], [7, 8]])


def worlds_of(record, first, other):
    path = Trajectory.from_record(record, first)
    if other is None:
        return AdjacentWorlds(record.without(first), (path, Trajectory.absent()))
    rest = record.without(first).without(other)
    return AdjacentWorlds(rest, (path, Trajectory.from_record(record, other)))


@pytest.mark.parametrize(
    "privacy", [{}, {"boundary_inputs": "private"}, {"epsilon": 0.5, "clip": 20.0, "ratio": 0.5}]
)
def test_a_replay_is_what_an_attack_on_the_pair_finds(privacy, record):
    """Prices under the open loop do not depend on the traffic."""
    setting = paced(**privacy)
    plan = public_plan(setting, "round-robin")
    squares = replay_pairs(setting, record, play_series(setting, record, plan), PAIRS)
    for (first, other), square in zip(PAIRS, squares, strict=True):
        worlds = worlds_of(record, first, other)
        runs = attack(setting, worlds, FixedQueries(plan), 1, progress=False)
        assert runs.distances[0, 0] ** 2 == pytest.approx(square, rel=1e-9)
    assert squares[0] == pytest.approx(squares[1], rel=1e-12)
    assert len(np.unique(np.round(squares, 9))) == 4


def test_a_vehicle_is_held_against_none_under_add_remove(record):
    setting = paced(adjacency="add_remove")
    plan = public_plan(setting, "round-robin")
    squares = replay_pairs(setting, record, play_series(setting, record, plan), PAIRS)
    for first, square in zip(PAIRS[:, 0], squares, strict=True):
        worlds = worlds_of(record, first, None)
        runs = attack(setting, worlds, FixedQueries(plan), 1, progress=False)
        assert runs.distances[0, 0] ** 2 == pytest.approx(square, rel=1e-9)


def test_a_second_counts_alone_for_the_unit_event(record):
    trip, event = paced(), paced(unit="event")
    plan = public_plan(trip, "round-robin")
    squares = replay_pairs(event, record, play_series(event, record, plan), PAIRS)
    parts = squares / privacy_report(event).mu ** 2
    assert ((parts > 0.499) & (parts <= 1.0)).all()


def test_caps_are_replayed_as_well(record):
    setting = config()
    plan = public_plan(setting, "paper")
    squares = replay_pairs(setting, record, play_series(setting, record, plan), PAIRS)
    for (first, other), square in zip(PAIRS, squares, strict=True):
        found = planned_distance(setting, worlds_of(record, first, other), plan)
        assert found**2 == pytest.approx(square, rel=1e-9)


def test_a_study_pools_the_pairs_of_its_records(record, tmp_path, capsys):
    setting, records = paced("ekf"), [record, record.without(4)]
    found, again = (study_pairs(setting, records, 30, progress=False) for _ in range(2))
    np.testing.assert_array_equal(found.parts, again.parts)
    other = study_pairs(setting, records, 30, seed=1, progress=False)
    assert not np.array_equal(found.parts, other.parts)
    assert found.parts.shape == (60,)
    assert (found.parts > 0.0).all()
    assert found.parts.max() <= 1.0
    assert found.quantiles["1"] == found.parts.max()
    assert found.quantiles["0.5"] == np.median(found.parts)
    found.print()
    assert f"{found.parts.max():.4f}" in capsys.readouterr().out
    found.write(tmp_path / "some" / "pairs.json", {"seed": 0})
    content = json.loads((tmp_path / "some" / "pairs.json").read_text())
    assert (content["n_pairs"], content["n_records"]) == (60, 2)
    assert content["quantiles"]["0.5"] == found.quantiles["0.5"]


def test_pairs_need_two_vehicles(record):
    lonely = record
    for vehicle in range(1, record.n_vehicles):
        lonely = lonely.without(vehicle)
    with pytest.raises(ValueError, match="traffic must be records of 2 vehicles or more, got 1"):
        study_pairs(paced(), [lonely], 3, progress=False)
