"""Targets and queries of an attack, and the distances that they reach."""

import dataclasses

import numpy as np
import pytest

from agents.audit.planner import Planner, plan_contributions, public_plan
from agents.audit.worlds import Trajectory, Worlds
from dptse_env.parts import privacy_report
from dptse_env.release import Paced

from .small import HORIZON, ROAD, HalfTheLimit, config, paced, reached, staying

# --- what a vehicle tells -------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["printed", "corrected", "capped"])
def test_moves_are_the_distance_of_a_second(preset, record):
    setting = config(preset=preset)
    planner, mu = Planner(setting), privacy_report(setting).mu
    rows = np.linspace(0, record.n_rows - 1, 8).astype(int)
    columns = (record.step, record.segment, record.speed)
    everyone = Trajectory(*(column[rows].astype(np.int64) for column in columns[:2]),
                          record.speed[rows].astype(np.float64))  # fmt: skip
    inside = planner.moves(record, everyone, is_in_record=True)
    for row, moves in zip(rows, inside, strict=True):
        step, vehicle = int(record.step[row]), int(record.vehicle[row])
        path = Trajectory.from_record(record, vehicle)
        keep, moved = path.only(path.step != step), path.only(path.step == step)
        rest = Worlds.adjacent(record.without(vehicle), (keep, keep)).get(ROAD, 0)
        plan = np.zeros((HORIZON, ROAD.geometry.n_mainline), dtype=bool)
        plan[step - 1, int(record.segment[row])] = True
        worlds = Worlds.adjacent(rest, (moved, Trajectory.absent()))
        distance = mu * reached(setting, worlds, plan, 1)
        # Deviations of speeds are rounded to the grid of the noise.
        assert distance**2 == pytest.approx(np.sum(moves**2), rel=1e-2)
        outside = planner.moves(rest, moved)
        assert distance**2 == pytest.approx(np.sum(outside**2), rel=1e-2)


def test_a_vehicle_tells_by_how_far_it_deviates_to_either_side(record):
    planner = Planner(config())
    slow, fast = (planner.moves(record, staying(2, speed))[:, 1] for speed in (0.0, 102.0))
    np.testing.assert_allclose(slow, -fast)
    for vehicle in range(record.n_vehicles):
        record = record.without(vehicle)
    for path in (staying(2, 60.0), staying(2, 0.0)):
        record = Worlds.adjacent(record, (path, Trajectory.absent())).get(ROAD, 0)
    assert planner.rank(record).tolist() == [record.n_vehicles - 1, record.n_vehicles - 2]


@pytest.mark.parametrize(("inputs", "seen"), [("nominal", False), ("private", True)])
def test_boundaries_are_observed_where_their_inputs_are_private(inputs, seen, record):
    path = staying(ROAD.geometry.n_segments)
    assert Planner(config(boundary_inputs=inputs)).moves(record, path).any() == seen


# --- targets --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "setting",
    [
        config(cap=20, horizon=10),
        config(adjacency="add_remove", unit="event"),
        config(boundary_inputs="private", cap=1),
        dataclasses.replace(config(), corridor=ROAD.replaced(fixed_sensors=())),
    ],
)
def test_the_worst_case_is_the_whole_of_mu(setting, record):
    worlds = Planner(setting).choose(record, "worst-case")
    assert reached(setting, worlds) == pytest.approx(1.0, rel=1e-9)
    assert reached(setting, worlds, public_plan(setting, "static")) <= 1.0 + 1e-9


@pytest.mark.parametrize(
    "setting",
    [
        paced("ekf", clip=25.0),
        paced("open_loop", clip=51.0),
        paced("ekf", unit="event"),
        paced("open_loop", adjacency="add_remove"),
    ],
)
def test_the_worst_case_is_nearly_the_whole_of_mu(setting, record):
    assert 0.94 < reached(setting, Planner(setting).choose(record, "worst-case")) <= 1.0


class RatioOfTwo(Paced):
    """Charges too little where two vehicles on one segment deviate in opposite directions."""

    def __init__(self, task, traffic):
        object.__setattr__(task.settings, "ratio", 2.0)
        super().__init__(task, traffic)


def test_a_fault_that_two_vehicles_on_one_segment_show_is_found(record):
    mutant = paced(HalfTheLimit, preset=RatioOfTwo, clip=51.0)
    assert reached(mutant, Planner(mutant).choose(record, "worst-case")) > 1.05


@pytest.mark.parametrize("spans", [(1, 2), (2,)])
def test_options_of_several_segments_reach_mu_and_no_more(spans, record):
    setting = dataclasses.replace(paced("ekf", bandwidth=3), query_spans=spans)
    planner = Planner(setting)
    for kind, least in (("worst-case", 0.95), ("replaced", 0.5)):
        worlds = planner.choose(record, kind)
        plan = planner.plan(worlds)
        assert (plan @ setting.queries.cost).max() <= 3
        assert least < reached(setting, worlds, plan) <= 1.0 + 1e-9


@pytest.mark.parametrize(
    ("kind", "setting"),
    [
        ("replaced", config(boundary_inputs="private")),
        ("worst-case", paced("random_walk", adjacency="add_remove", ratio=20.0)),
        ("deleted", paced("random_walk", unit="event")),
    ],
)
def test_no_target_exceeds_mu(kind, setting, record):
    worlds = Planner(setting).choose(record, kind)
    for plan in (None, public_plan(setting, "round-robin")):
        assert reached(setting, worlds, plan) <= 1.0 + 1e-9
    if setting.privacy.unit == "event":
        assert {len(path.step) for path in worlds.pair} <= {0, 1}
        assert len({int(step) for path in worlds.pair for step in path.step}) == 1


@pytest.mark.parametrize("setting", [config(cap=2), paced(horizon=10)])
def test_the_vehicle_that_is_deleted_tells_most(setting, record):
    chosen = reached(setting, Planner(setting).choose(record, "deleted"))
    everyone = []
    for vehicle in range(record.n_vehicles):
        pair = Trajectory.from_record(record, vehicle), Trajectory.absent()
        everyone.append(reached(setting, Worlds.adjacent(record.without(vehicle), pair)))
    # Prices are those of a typical episode, so that it is not always the best.
    least = 0.95 if setting.privacy.preset == "paced" else 1.0 - 1e-9
    assert chosen >= least * max(everyone)
    assert chosen > 1.02 * np.median(everyone)


def test_a_target_that_does_not_fit_is_named(record):
    with pytest.raises(ValueError, match=r"target must be one of \[.*\].* got 'replaced'"):
        Planner(config(adjacency="add_remove")).choose(record, "replaced")
    for vehicle in range(1, record.n_vehicles):
        record = record.without(vehicle)
    for n, kind in ((2, "replaced"), (1, "deleted")):
        with pytest.raises(ValueError, match=f"traffic must be a record of {n}"):
            Planner(config()).choose(record, kind)
        record = record.without(0)


# --- queries --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bandwidth", [1, 2, 6])
def test_the_hunter_keeps_to_bandwidth_and_cap(bandwidth, record):
    setting = config(bandwidth, cap=7)
    worlds = Worlds.adjacent(record, (staying(0), staying(1)))
    plan = Planner(setting).plan(worlds)
    assert plan.sum(axis=1).max() <= bandwidth
    # Seven for each of the two paths tell the whole of mu; then a ledger has to refuse.
    n_spent = 7 if bandwidth > 1 else 14
    assert plan[:n_spent, :2].sum() == 14
    assert plan[n_spent:].any(axis=1).all()
    assert reached(setting, worlds) == pytest.approx(1.0)


def test_the_hunter_queries_the_seconds_that_reveal_most(record):
    path = Trajectory.from_record(record, 0)
    worlds = Worlds.adjacent(record.without(0), (path, Trajectory.absent()))
    # The fixed sensor at the end of the road comes after them.
    free = path.only(path.segment < 5)
    best = free.step[np.argsort(-np.abs(np.clip(free.speed, 0, 102) - 51.0))[:3]]
    plan = Planner(config(cap=3)).plan(worlds)
    later = free.step[free.step > best.max()]
    assert set(np.flatnonzero(plan.any(axis=1)) + 1) == {*best.tolist(), *later.tolist()}
    assert plan.sum() == 3 + later.size > 3


def test_contributions_are_spent_where_they_tell_most():
    generator = np.random.default_rng(2)
    for cap in (1, 2, 3, 5, 8):
        for _ in range(20):
            gains, always = generator.random(7), generator.random(7) < 0.4
            reach, n_queries, stop = plan_contributions(gains, always, cap)
            # Every set of seconds to query; the first that are observed count.
            options = []
            for queried in range(2**7):
                observed = always | (queried >> np.arange(7) & 1).astype(bool)
                options.append(gains[np.flatnonzero(observed)[:cap]].sum())
            assert reach == pytest.approx(max(options))
            best = np.flatnonzero(~always[:stop])
            best = best[np.argsort(-gains[best])][:n_queries]
            observed = always.copy()
            observed[best] = True
            assert gains[np.flatnonzero(observed)[:cap]].sum() == pytest.approx(max(options))


def test_public_schedules_are_those_of_the_environment():
    plan = public_plan(config(), "shift-ahead")
    # Two of six segments, shifted downstream every four seconds.
    assert [np.flatnonzero(row).tolist() for row in plan[[0, 3, 4, 8]]] == [
        [0, 3], [0, 3], [1, 4], [2, 5],
    ]  # fmt: skip
    assert plan.shape == (HORIZON, ROAD.geometry.n_mainline)
