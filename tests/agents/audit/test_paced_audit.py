"""The audit of the paced ledger: its targets, its hunter, and the law of its scores."""

import dataclasses

import numpy as np
import pytest

from agents.audit.attack import Adversary, attack, attacked_form, public_terms
from agents.audit.planner import (
    JAM_SPEED,
    TARGET_KINDS,
    choose_target,
    make_planner,
    make_policy,
)
from agents.audit.releases import Terms, attacked
from agents.audit.statistics import Claim, audit
from agents.audit.strategies import public_plan
from agents.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.config import resolve
from dptse_env.estimators import Measurement
from dptse_env.parts import make_release, make_traffic, privacy_report
from dptse_env.release import ReleaseModel, Request
from tests.helpers import fast_and_slow

from .small import (
    HORIZON,
    N_COLUMNS,
    ROAD,
    HalfTheLimit,
    assert_runs_do_not_depend_on_the_batch,
    config,
    paced,
)

SECONDS = np.arange(1, HORIZON + 1)


def reached(setting, worlds, policy="hunter", n_runs=2):
    """The largest distance of some runs over mu."""
    runs = attack(setting, worlds, make_policy(setting, policy, worlds), n_runs, progress=False)
    return runs.distances.max() / privacy_report(setting).mu


# --- targets ---------------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", ["ekf", "open_loop"])
@pytest.mark.parametrize("clip", [25.0, 51.0])
def test_the_worst_case_is_nearly_the_whole_of_mu(estimator, clip, record):
    setting = paced(estimator, clip=clip)
    assert 0.97 < reached(setting, choose_target(setting, record, "worst-case", "hunter")) <= 1.0


def test_opposite_deviations_on_one_segment_are_a_worst_case(record):
    """Two vehicles and one query, where the centre leaves room for the clip on both sides."""
    setting = paced(HalfTheLimit, clip=51.0)
    worlds = choose_target(setting, record, "opposite", "hunter")
    slow, fast = worlds.trajectories
    np.testing.assert_array_equal(slow.segment, fast.segment)
    assert set(slow.speed.tolist()) == {0.0}
    assert set(fast.speed.tolist()) == {ROAD.speed_limit}
    assert 0.97 < reached(setting, worlds) <= 1.0
    # All that is told is the speed: nobody can tell the counts apart.
    assert np.array_equal(*(worlds.get(ROAD, seed).counts for seed in (0, 1)))


def test_a_lone_vehicle_is_the_worst_case_of_add_remove(record):
    setting = paced(adjacency="add_remove")
    worlds = choose_target(setting, record, "worst-case", "hunter")
    assert [len(path.step) for path in worlds.trajectories] == [HORIZON, 0]
    assert 0.95 < reached(setting, worlds) <= 1.0


ALL_PRIVACY = [
    {},
    {"adjacency": "add_remove"},
    {"adjacency": "add_remove", "ratio": 20.0},
    {"unit": "event"},
    {"unit": "event", "adjacency": "add_remove"},
    {"boundary_inputs": "private"},
    {"clip": 5.0, "ratio": 0.1},
    {"pace": 0.05},
    {"epsilon": 0.1},
]
FEW = [
    ("worst-case", {"adjacency": "add_remove", "ratio": 20.0}, "hunter"),
    ("opposite", {"clip": 5.0, "ratio": 0.1}, "hunter"),
    ("replaced", {}, "static"),
    ("deleted", {"boundary_inputs": "private"}, "hunter"),
    ("runs-out", {"pace": 0.05}, "round-robin"),
    ("jam", {"unit": "event"}, "hunter"),
]
ALL = [
    (kind, privacy, "hunter")
    for kind in TARGET_KINDS
    for privacy in ALL_PRIVACY
    if (kind, privacy, "hunter") not in FEW
    if "adjacency" not in privacy or kind not in ("replaced", "opposite")
]


@pytest.mark.parametrize(("kind", "privacy", "policy"), fast_and_slow([*FEW, *ALL], FEW))
def test_no_target_exceeds_mu(kind, privacy, policy, record):
    setting = paced("random_walk", **privacy)
    worlds = choose_target(setting, record, kind, policy)
    assert 0.0 < reached(setting, worlds, policy) <= 1.0


@pytest.mark.parametrize("policy", ["hunter", "round-robin"])
def test_the_vehicle_that_is_deleted_tells_much(policy, record):
    """Prices are those of a typical episode, so that it is not always the best."""
    setting = paced(pace=0.05)
    chosen = reached(setting, choose_target(setting, record, "deleted", policy), policy)
    everyone = []
    for vehicle in range(record.n_vehicles):
        pair = Trajectory.from_record(record, vehicle), Trajectory.absent()
        everyone.append(reached(setting, AdjacentWorlds(record.without(vehicle), pair), policy))
    assert chosen > 0.95 * max(everyone)
    assert chosen > 1.02 * np.median(everyone)


def test_targets_of_the_record_are_what_they_are_called(record):
    planner = make_planner(paced(), "hunter")
    whole = {kind: planner.rank(record, kind).tolist() for kind in planner.kinds}
    jammed = [np.sum(record.speed[record.vehicle == v] < JAM_SPEED) for v in whole["jam"]]
    assert jammed == sorted(jammed, reverse=True)
    first = [record.step[record.vehicle == v].min() for v in range(record.n_vehicles)]
    late = [v for v in whole["late"] if first[v] > HORIZON / 2]
    assert whole["late"][: len(late)] == late != []
    # With the largest unpaid demand: it would pay on if its ledger held more.
    worlds = choose_target(paced(), record, "runs-out", "hunter")
    rich = paced(epsilon=1e4)
    assert reached(rich, worlds) * privacy_report(rich).mu > 1.2 * privacy_report(paced()).mu


def test_an_event_is_one_second(record):
    setting = paced(unit="event")
    for kind in TARGET_KINDS:
        paths = choose_target(setting, record, kind, "hunter").trajectories
        assert {len(path.step) for path in paths} <= {0, 1}
        assert len({int(step) for path in paths for step in path.step}) == 1
    worlds = choose_target(setting, record, "worst-case", "hunter")
    assert 0.99 < reached(setting, worlds) <= 1.0


@pytest.mark.parametrize(
    ("kind", "privacy", "allowed"),
    [
        ("replaced", {"adjacency": "add_remove"}, "add_remove"),
        ("opposite", {"adjacency": "add_remove"}, "add_remove"),
        ("nobody", {}, "for preset 'paced'"),
    ],
)
def test_targets_that_do_not_fit_are_named(kind, privacy, allowed, record):
    with pytest.raises(ValueError, match=rf"target must be one of \[.*\] .*{allowed}"):
        choose_target(paced(**privacy), record, kind, "hunter")


def test_a_release_model_without_known_noise_is_no_target():
    class Silent(ReleaseModel):
        sigma = np.zeros(2)

        def reset(self, episodes, generators):
            """Nothing to do."""

        def release(self, request):
            raise NotImplementedError

    release = make_release(dataclasses.replace(paced(), privacy=config(preset="paper").privacy))
    assert not attacked(release).follows_estimates
    with pytest.raises(ValueError, match="the audit needs a release model with Gaussian noise"):
        attacked(Silent(release.task, release.traffic))


# --- queries ---------------------------------------------------------------------------------


@pytest.mark.parametrize("bandwidth", [1, 2, 5])
def test_the_hunter_follows_both_vehicles_every_second(bandwidth, record):
    setting = paced(bandwidth=bandwidth)
    places = SECONDS // 7 % 5, (SECONDS // 5 + 2) % 5
    paths = tuple(Trajectory(SECONDS, place, np.full(HORIZON, 30.0)) for place in places)
    plan = make_policy(setting, "hunter", AdjacentWorlds(record, paths)).plan
    followed = np.stack([plan[np.arange(HORIZON), place] for place in places])
    if bandwidth == 1:
        assert (followed[0] | followed[1]).all()
        assert followed[0][::2].all()
        assert followed[1][1::2].all()
    else:
        assert followed.all()
    # What is left goes round.
    assert (plan.sum(axis=1) == bandwidth).all()
    assert bandwidth < 5 or (plan.sum(axis=0) > 0).all()


def test_the_hunter_needs_no_query_where_a_sensor_stands(record):
    sensor = ROAD.fixed_sensors[0]
    paths = (Trajectory.constant(SECONDS, sensor, 0.0), Trajectory.absent())
    plan = make_policy(paced(bandwidth=2), "hunter", AdjacentWorlds(record, paths)).plan
    np.testing.assert_array_equal(plan, public_plan(paced(bandwidth=2), "round-robin"))


def test_the_estimator_that_prices_follow_is_kept():
    assert attacked_form(paced("ekf")).estimator == "ekf"
    assert attacked_form(paced("random_walk")).estimator == "random_walk"
    assert attacked_form(config()).estimator == "open_loop"


def test_public_numbers_of_an_episode_are_as_long_as_it(record):
    setting = paced("ekf", boundary_inputs="private")
    plan = public_plan(setting, "round-robin")
    terms = public_terms(setting, record, plan)
    assert terms.prices.shape == (HORIZON, N_COLUMNS)
    np.testing.assert_allclose(terms.sigma[..., 0] * ROAD.segment_length, terms.prices**-0.5)
    assert terms.centre.std() > 0.0
    other = public_terms(setting, record, plan, seed=1)
    assert not np.array_equal(terms.prices, other.prices)


# --- scores ----------------------------------------------------------------------------------


def normal_scores(runs):
    squares = runs.distances**2
    return (runs.scores - np.array([[-0.5], [0.5]]) * squares) / runs.distances


@pytest.mark.parametrize("estimator", ["ekf", "open_loop"])
@pytest.mark.parametrize("factor", [1.0, 0.6])
def test_scores_have_the_law_of_their_distance(estimator, factor, record):
    setting = paced(estimator)
    worlds = choose_target(setting, record, "worst-case", "hunter")
    policy = make_policy(setting, "hunter", worlds)
    runs = attack(setting, worlds, policy, 400, noise_factor=factor, progress=False)
    mu = privacy_report(setting).mu
    assert runs.distances.min() > 0.95 * mu / factor
    assert runs.distances.max() <= mu / factor
    assert (np.ptp(runs.distances) > 0.0) == (estimator == "ekf")
    normal = normal_scores(runs)
    assert np.abs(normal.mean(axis=1)).max() < 4.0 / np.sqrt(400)
    assert np.abs(normal.var(axis=1) - 1.0).max() < 4.0 * np.sqrt(2.0 / 400)
    assert len(np.unique(runs.scores)) == runs.scores.size
    assert abs(np.corrcoef(runs.scores)[0, 1]) < 4.0 / np.sqrt(400)


def test_the_score_is_the_log_likelihood_ratio_of_the_transcript(record):
    """Against sums of two release models of one episode each, world by world."""
    setting = attacked_form(paced(boundary_inputs="private"))
    worlds = choose_target(setting, record, "replaced", "hunter")
    plan = public_plan(setting, "paper")
    observed = make_release(setting).task.observed(plan)
    public = public_terms(setting, record, plan)
    steps = [Terms(*(array[[step]] for array in public)) for step in range(len(plan))]
    apart = sums_by_world(setting, worlds, observed, steps)
    adversary, noise = Adversary(setting, worlds, 1), np.random.default_rng(0)
    adversary.reset(1)
    expected = 0.0
    for step, terms in enumerate(steps):
        seen = observed[step]
        sigma, (zero, first) = terms.sigma[0], apart[step]
        released = zero + sigma * noise.standard_normal(sigma.shape)
        logs = [-0.5 * np.sum(((released - mean) / sigma)[seen] ** 2) for mean in (zero, first)]
        expected += logs[1] - logs[0]
        released[~seen] = 1e6
        told = Measurement(seen[None], released[None], terms.sigma, terms.centre)
        adversary.update(step + 1, told, terms)
        assert adversary.score[0] == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert adversary.square[0] > 0.1


def sums_by_world(setting, worlds, observed, public):
    one, traffic = np.array([0]), make_traffic(setting, worlds)
    traffic.load([0, 1])
    releases = [make_release(setting, 1, traffic) for _ in range(2)]
    for release in releases:
        release.reset(one, [np.random.default_rng(0)])
    steps = []
    for step, terms in enumerate(public):
        asked = [Request(one, one + w, np.array([step + 1]), observed[[step]]) for w in (0, 1)]
        sums = [
            release.collect(second, terms.prices, terms.centre)[0][0]
            for release, second in zip(releases, asked, strict=True)
        ]
        steps.append([each / ROAD.segment_length for each in sums])
    return steps


@pytest.mark.parametrize(
    "setting", [paced("ekf"), paced("random_walk", boundary_inputs="private", unit="event")]
)
def test_runs_do_not_depend_on_the_batch(setting, record):
    assert_runs_do_not_depend_on_the_batch(setting, record)


def test_adapting_stays_below_mu_and_stops_early(record):
    setting = paced(epsilon=10.0)
    worlds = choose_target(setting, record, "worst-case", "hunter")
    runs = attack(setting, worlds, make_policy(setting, "adaptive", worlds), 100, progress=False)
    mu = privacy_report(setting).mu
    assert runs.distances.max() <= mu
    assert runs.distances.min() < 0.9 * mu


def test_a_guarantee_is_not_rejected_and_half_the_noise_is(record):
    setting = paced("ekf")
    mu = privacy_report(setting).mu
    worlds = choose_target(setting, record, "worst-case", "hunter")
    policy = make_policy(setting, "hunter", worlds)
    for factor, verdict in ((1.0, "not rejected"), (0.5, "rejected")):
        runs = attack(setting, worlds, policy, 400, noise_factor=factor, progress=False)
        assert audit(*runs.scores, Claim(mu, 5.0, 0.05)).verdict == verdict


def test_the_shipped_environment_can_be_attacked():
    setting = resolve("private-highway-v1", {"horizon": 5})
    assert attacked(make_release(attacked_form(setting))).follows_estimates
