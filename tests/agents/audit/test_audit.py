import dataclasses

import numpy as np
import pytest

from agents.audit.attack import Adversary, attack
from agents.audit.distances import ReleaseDistances, plan_contributions
from agents.audit.planner import choose_target, make_policy
from agents.audit.releases import Terms
from agents.audit.statistics import Claim, audit
from agents.audit.strategies import (
    DECISION_THRESHOLD,
    AdaptiveQueries,
    FixedQueries,
    public_plan,
)
from agents.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.estimators import Measurement
from dptse_env.parts import make_release, privacy_report
from dptse_env.privacy import epsilon_of
from dptse_env.release import CappedSettings
from tests.agents.elsewhere import Elsewhere
from tests.helpers import fast_and_slow

from .small import HORIZON, ROAD, assert_runs_do_not_depend_on_the_batch, config


def distance_of(setting, worlds, plan):
    return attack(setting, worlds, FixedQueries(plan), 1, progress=False).distances.max()


def reached(setting, worlds, policy="hunter"):
    return distance_of(setting, worlds, make_policy(setting, policy, worlds).plan)


FEW = [
    {},
    {"adjacency": "add_remove", "unit": "event"},
    {"boundary_inputs": "private", "cap": 1},
]
MORE = [
    {"adjacency": "add_remove"},
    {"share": 0.2},
    {"share": 0.8},
    {"unit": "horizon"},
    {"unit": "event"},
    {"boundary_inputs": "private"},
    {"cap": 1},
    {"cap": 500},
]
ALL_PRIVACY = fast_and_slow([*FEW, *MORE], FEW)


def test_worlds_differ_in_one_vehicle(record):
    path = Trajectory.from_record(record, 3)
    rest = record.without(3)
    worlds = AdjacentWorlds(rest, (path, Trajectory.absent()))
    first, second = worlds.get(ROAD, 0), worlds.get(ROAD, 1)
    np.testing.assert_array_equal(first.counts, record.counts)
    np.testing.assert_allclose(first.speed_sums, record.speed_sums)
    np.testing.assert_array_equal(second.counts, rest.counts)
    again = first.without(rest.n_vehicles)
    for name in ("step", "vehicle", "segment", "speed"):
        np.testing.assert_array_equal(getattr(again, name), getattr(rest, name))
    added = Trajectory.from_record(first, rest.n_vehicles)
    np.testing.assert_array_equal(added.segment, path.segment)
    assert len(path.step) > 3


@pytest.mark.parametrize("preset", ["paper", "corrected", "capped"])
def test_the_closed_form_is_the_distance_of_a_second(preset, record):
    setting = config(preset=preset)
    distances = ReleaseDistances.from_config(setting)
    rows = np.linspace(0, record.n_rows - 1, 8).astype(int)
    squares = distances.by_row(record)
    for row in rows:
        step, segment, vehicle = (
            int(column[row]) for column in (record.step, record.segment, record.vehicle)
        )
        path = Trajectory.from_record(record, vehicle)
        keep, moved = path.only(path.step != step), path.only(path.step == step)
        rest = AdjacentWorlds(record.without(vehicle), (keep, keep)).get(ROAD, 0)
        worlds = AdjacentWorlds(rest, (moved, Trajectory.absent()))
        plan = np.zeros((HORIZON, ROAD.n_mainline), dtype=bool)
        plan[step - 1, segment] = True
        distance = distance_of(setting, worlds, plan)
        assert distance**2 == pytest.approx(squares[row], rel=1e-9)
        assert distance**2 == pytest.approx(distances.by_second(rest, moved)[0], rel=1e-9)


@pytest.mark.parametrize("preset", ["paper", "capped"])
def test_where_paths_meet_speeds_alone_tell(preset, record):
    setting = config(preset=preset)
    distances = ReleaseDistances.from_config(setting)
    paths = tuple(Trajectory.constant(np.array([20]), 2, speed) for speed in (5.0, 140.0))
    worlds = AdjacentWorlds(record, paths)
    plan = np.zeros((HORIZON, ROAD.n_mainline), dtype=bool)
    plan[19, 2] = True
    distance = distance_of(setting, worlds, plan)
    assert record.counts[20, 2] > 0
    assert distance**2 == pytest.approx(distances.where_equal(record, paths)[0], rel=1e-9)
    assert distance > 0.0


@pytest.mark.parametrize("policy", ["hunter", "static"])
@pytest.mark.parametrize("privacy", ALL_PRIVACY)
def test_the_worst_case_is_the_whole_of_mu(privacy, policy, record):
    setting = config(**privacy)
    worlds = choose_target(setting, record, "worst-case", policy)
    mu = privacy_report(setting).mu
    distance = reached(setting, worlds, policy)
    assert distance <= mu * (1.0 + 1e-9)
    if policy == "hunter":
        assert distance == pytest.approx(mu, rel=1e-9)


@pytest.mark.parametrize("policy", ["hunter", "round-robin"])
@pytest.mark.parametrize("privacy", ALL_PRIVACY)
@pytest.mark.parametrize("kind", ["deleted", pytest.param("replaced", marks=pytest.mark.slow)])
def test_no_vehicle_of_the_record_exceeds_mu(privacy, kind, policy, record):
    if kind == "replaced" and "adjacency" in privacy:
        pytest.skip("two vehicles are no neighbours there")
    setting = config(**privacy)
    worlds = choose_target(setting, record, kind, policy)
    distance = reached(setting, worlds, policy)
    assert 0.0 < distance <= privacy_report(setting).mu * (1.0 + 1e-9)


@pytest.mark.parametrize("policy", ["hunter", "static"])
@pytest.mark.parametrize("privacy", [{"preset": "corrected"}, {"cap": 2}])
def test_the_vehicle_that_is_deleted_tells_most(privacy, policy, record):
    setting = config(**privacy)
    chosen = reached(setting, choose_target(setting, record, "deleted", policy), policy)
    everyone = [
        reached(
            setting,
            AdjacentWorlds(
                record.without(v), (Trajectory.from_record(record, v), Trajectory.absent())
            ),
            policy,
        )
        for v in range(record.n_vehicles)
    ]
    assert chosen == pytest.approx(max(everyone), rel=1e-9)
    assert chosen > 1.05 * np.median(everyone)


def test_a_replaced_vehicle_tells_more_than_a_deleted_one(record):
    for preset in ("corrected", "capped"):
        setting = config(preset=preset)
        replaced, deleted = (
            reached(setting, choose_target(setting, record, kind, "hunter"))
            for kind in ("replaced", "deleted")
        )
        assert replaced > 1.2 * deleted


def test_an_event_is_one_second(record):
    setting = config(unit="event")
    for kind in ("worst-case", "replaced", "deleted"):
        paths = choose_target(setting, record, kind, "hunter").trajectories
        assert {len(path.step) for path in paths} <= {0, 1}
        assert len({int(step) for path in paths for step in path.step}) == 1


@pytest.mark.parametrize("bandwidth", [1, 2, 6])
def test_the_hunter_keeps_to_bandwidth_and_cap(bandwidth, record):
    setting = config(bandwidth, cap=7)
    seconds = np.arange(1, HORIZON + 1)
    worlds = AdjacentWorlds(
        record, (Trajectory.constant(seconds, 0, 0.0), Trajectory.constant(seconds, 1, 0.0))
    )
    plan = make_policy(setting, "hunter", worlds).plan
    assert plan.sum(axis=1).max() <= bandwidth
    assert plan.sum() == 14  # seven for each of the two paths
    assert reached(setting, worlds) == pytest.approx(privacy_report(setting).mu)


def test_the_hunter_queries_the_seconds_that_reveal_most(record):
    setting = config(cap=3)
    path = Trajectory.from_record(record, 0)
    worlds = AdjacentWorlds(record.without(0), (path, Trajectory.absent()))
    # The fixed sensor at the end of the road comes after them.
    free = path.only(path.segment < 5)
    best = free.step[np.argsort(-np.abs(np.clip(free.speed, 0, 102) - 51.0))[:3]]
    plan = make_policy(setting, "hunter", worlds).plan
    assert set(np.flatnonzero(plan.any(axis=1)) + 1) == set(best.tolist())
    assert plan.sum() == 3


def test_the_hunter_queries_where_the_two_trajectories_part(record):
    setting = config(bandwidth=2, cap=4)
    seconds = np.arange(1, 21)
    # Side by side at a standstill, then apart and a little slower to tell.
    together = np.where(seconds <= 10, 1, 2), np.where(seconds <= 10, 1, 3)
    speed = np.where(seconds <= 10, 0.0, 20.0)
    paths = tuple(Trajectory(seconds, segment, speed) for segment in together)
    plan = make_policy(setting, "hunter", AdjacentWorlds(record, paths)).plan
    assert plan[:10].sum() == 0
    assert plan[10:20, [2, 3]].sum() == plan.sum() == 8


def test_contributions_are_spent_where_they_tell_most():
    generator = np.random.default_rng(2)
    for cap in (1, 2, 3, 5, 8):
        for _ in range(20):
            gains, always = generator.random(7), generator.random(7) < 0.4
            plan = plan_contributions(gains, always, cap)
            # Every set of seconds to query; the first that are observed count.
            options = []
            for queried in range(2**7):
                observed = always | (queried >> np.arange(7) & 1).astype(bool)
                options.append(gains[np.flatnonzero(observed)[:cap]].sum())
            assert plan.reach == pytest.approx(max(options))
            best = np.flatnonzero(~always[: plan.stop])
            best = best[np.argsort(-gains[best])][: plan.n_queries]
            observed = always.copy()
            observed[best] = True
            assert gains[np.flatnonzero(observed)[:cap]].sum() == pytest.approx(max(options))


def test_public_schedules_are_those_of_the_environment():
    plan = public_plan(config(), "paper")
    # Two of six segments, shifted downstream every four seconds.
    assert [np.flatnonzero(row).tolist() for row in plan[[0, 3, 4, 8]]] == [
        [0, 3], [0, 3], [1, 4], [2, 5],
    ]  # fmt: skip
    assert plan.shape == (HORIZON, ROAD.n_mainline)


def test_the_adaptive_hunter_rests_where_it_is_decided():
    plan = np.ones((2, 3), dtype=bool)
    belief = np.array(
        [0.0, -DECISION_THRESHOLD - 0.1, DECISION_THRESHOLD + 0.1, 0.5 * DECISION_THRESHOLD]
    )
    queries = AdaptiveQueries(plan).queries(0, belief)
    assert queries.any(axis=1).tolist() == [True, False, False, True]
    assert FixedQueries(plan).queries(0, belief).all()


@pytest.mark.parametrize("preset", ["paper", "capped"])
def test_the_score_is_the_log_likelihood_ratio_of_the_transcript(preset, record):
    setting = config(preset=preset)
    worlds = choose_target(setting, record, "worst-case", "hunter")
    # A schedule that mostly looks elsewhere: what it does not see must not count.
    plan = make_policy(setting, "paper", worlds).plan
    task = make_release(setting).task
    sigma = np.tile(ReleaseDistances.from_config(setting).sigma, (2, task.n_columns, 1))
    terms = Terms(sigma, np.empty((2, 0)), np.empty((2, 0)))
    square = distance_of(setting, worlds, plan) ** 2
    answers, adversary = (Adversary(setting, worlds, 2) for _ in range(2))
    answers.reset(2)
    adversary.reset(2)
    noise = np.random.default_rng(0).standard_normal((HORIZON, task.n_columns, 2))
    expected = np.zeros(2)
    for step, queried in enumerate(plan):
        observed = task.observed(np.tile(queried, (2, 1)))
        midpoint, difference = answers.expect(step + 1, observed, terms)
        zero, first = (midpoint - 0.5 * difference)[0], (midpoint + 0.5 * difference)[0]
        # The transcript of world 1 without noise, and one of world 0 with it.
        released, watched = np.stack([first, zero + noise[step]]), observed[0]
        logs = [
            -0.5 * np.sum((released - mean)[:, watched] ** 2, axis=(1, 2)) for mean in (zero, first)
        ]
        expected += logs[1] - logs[0]
        # What is not observed must not matter.
        released[:, ~watched] = 1e6
        told = Measurement(observed, released * sigma, sigma, np.empty((2, 0)))
        adversary.update(step + 1, told, terms)
    np.testing.assert_allclose(adversary.score, expected, rtol=1e-9)
    assert adversary.score[0] == pytest.approx(0.5 * square)


def test_scores_have_the_law_of_their_distance(record):
    setting = config(epsilon=5.0)
    worlds = choose_target(setting, record, "worst-case", "hunter")
    policy = make_policy(setting, "hunter", worlds)
    runs = attack(setting, worlds, policy, 400, progress=False)
    mu = privacy_report(setting).mu
    np.testing.assert_allclose(runs.distances, mu)
    normal = (runs.scores - np.array([[-0.5], [0.5]]) * mu**2) / mu
    assert np.abs(normal.mean(axis=1)).max() < 4.0 / np.sqrt(400)
    assert np.abs(normal.var(axis=1) - 1.0).max() < 4.0 * np.sqrt(2.0 / 400)
    # Every run has separate noise, in either world.
    assert len(np.unique(runs.scores)) == runs.scores.size
    assert abs(np.corrcoef(runs.scores)[0, 1]) < 4.0 / np.sqrt(400)


def test_less_noise_puts_the_worlds_further_apart(record):
    setting = config()
    worlds = choose_target(setting, record, "worst-case", "hunter")
    policy = make_policy(setting, "hunter", worlds)
    runs = attack(setting, worlds, policy, 3, noise_factor=0.5, progress=False)
    np.testing.assert_allclose(runs.distances, 2.0 * privacy_report(setting).mu)


@pytest.mark.parametrize("privacy", [{}, {"preset": "paper"}, {"boundary_inputs": "private"}])
def test_runs_do_not_depend_on_the_batch(privacy, record):
    assert_runs_do_not_depend_on_the_batch(config(**privacy), record)


def test_runs_come_out_the_same_wherever_they_are_played(record):
    setting = config()
    worlds = choose_target(setting, record, "worst-case", "hunter")
    policy = make_policy(setting, "adaptive", worlds)
    here = attack(setting, worlds, policy, 5, batch=2, progress=False)
    there = attack(setting, worlds, policy, 5, batch=2, executor=Elsewhere(), progress=False)
    np.testing.assert_array_equal(here.scores, there.scores)
    np.testing.assert_array_equal(here.distances, there.distances)


def test_adapting_stays_below_mu_and_stops_early(record):
    setting = config(epsilon=10.0)
    worlds = choose_target(setting, record, "worst-case", "hunter")
    runs = attack(setting, worlds, make_policy(setting, "adaptive", worlds), 100, progress=False)
    mu = privacy_report(setting).mu
    assert runs.distances.max() <= mu * (1.0 + 1e-9)
    assert runs.distances.min() < 0.9 * mu


def test_a_road_needs_no_fixed_sensor(record):
    setting = dataclasses.replace(config(), corridor=dataclasses.replace(ROAD, fixed_sensors=()))
    worlds = choose_target(setting, record, "worst-case", "hunter")
    assert reached(setting, worlds) == pytest.approx(privacy_report(setting).mu)


def test_a_short_horizon_is_kept(record):
    setting = config(horizon=10, unit="horizon")
    worlds = choose_target(setting, record, "worst-case", "hunter")
    runs = attack(setting, worlds, make_policy(setting, "hunter", worlds), 2, progress=False)
    np.testing.assert_allclose(runs.distances, privacy_report(setting).mu)


def test_an_audit_sees_a_cap_that_is_not_held(record, monkeypatch):
    setting = config(epsilon=5.0, cap=6)
    report = privacy_report(setting)
    claim = Claim(report.mu, epsilon_of(report.mu, 0.05), 0.05)
    worlds = choose_target(setting, record, "worst-case", "static")
    policy = make_policy(setting, "static", worlds)
    held = attack(setting, worlds, policy, 400, progress=False)
    assert audit(*held.scores, claim).verdict == "not rejected"
    monkeypatch.setattr(CappedSettings, "contribution_cap", None)
    broken = attack(setting, worlds, policy, 400, progress=False)
    assert audit(*broken.scores, claim).verdict == "rejected"


@pytest.mark.parametrize(
    ("kind", "privacy", "message"),
    [
        (
            "replaced",
            {"adjacency": "add_remove"},
            r"target must be one of \['worst-case', 'deleted'\] with add_remove",
        ),
        ("jam", {}, r"target must be one of \[.*\] for preset 'capped', got 'jam'"),
        ("nobody", {}, "target must be one of"),
    ],
)
def test_targets_that_do_not_fit_are_named(kind, privacy, message, record):
    with pytest.raises(ValueError, match=message):
        choose_target(config(**privacy), record, kind, "hunter")


@pytest.mark.parametrize(("kind", "need"), [("deleted", 1), ("replaced", 2)])
def test_an_empty_road_has_no_target(kind, need, record):
    empty = record
    for vehicle in range(need - 1, record.n_vehicles):
        empty = empty.without(vehicle)
    with pytest.raises(ValueError, match=f"a record of {need} observable vehicles"):
        choose_target(config(), empty, kind, "hunter")
