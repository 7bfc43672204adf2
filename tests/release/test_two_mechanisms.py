"""Queries that connected vehicles answer, and fixed sensors that see all vehicles."""

import dataclasses
import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dptse_env.config import resolve
from dptse_env.parts import make_parts, make_release, privacy_report
from dptse_env.privacy import mu_of
from dptse_env.process import QueryProcess
from dptse_env.release import (
    RELEASE_MODELS,
    Capped,
    CappedSettings,
    Detectors,
    QueryOptions,
    ReleaseRequest,
    ReleaseSetup,
    TrafficTable,
    TwoMechanisms,
)
from dptse_env.traffic import Penetration
from tests.cases import pairwise

from .worlds import AWAY, Worlds, corridor, record

SHARE = 0.3
N, SENSORS, S = 6, (3, 5, 7), 8
ONE = np.arange(1)
PRESETS = ("paper", "corrected", "capped", "paced")
OWN_NOISE = {"paper": {}, "corrected": {}, "capped": {"cap": 1_000}, "paced": {}}


def make(n_episodes=1, **keywords):
    given = {
        "traffic_seeds": "0:2",
        "penetration": SHARE,
        "corridor": {"fixed_sensors": SENSORS},
        "horizon": 60,
        "random_start": True,
        **keywords,
    }
    return QueryProcess(make_parts(resolve("short-highway", given), n_episodes))


def begin(process, seed=3, start=150):
    episodes = np.arange(process.n_episodes)
    options = {"traffic_seed": 1, "start": start}
    generators = [np.random.default_rng(seed) for _ in episodes]
    return process.reset(episodes, generators, options)


def play(process, n_steps, queried=(0, 3)):
    """Query the same segments in every step; return the raw releases."""
    action = np.zeros((process.n_episodes, N), dtype=np.int8)
    action[:, list(queried)] = 1
    found, release = [], process.release.release

    def spy(request):
        found.append((release(request), request))
        return found[-1][0]

    process.release.release = spy
    for _ in range(n_steps):
        process.step(np.arange(process.n_episodes), action)
    process.release.release = release
    return found


@pytest.mark.parametrize("keywords", [{}, {"penetration": 1.0}, {"penetration": {"seed": 4}}])
def test_where_all_vehicles_are_connected_there_is_one_mechanism(keywords):
    config = resolve("short-highway", keywords)
    assert type(make_release(config)) is RELEASE_MODELS[config.privacy.preset]
    assert make_parts(config).fusion is None


@pytest.mark.parametrize("preset", PRESETS)
def test_queries_count_connected_vehicles_and_sensors_all(preset):
    # So large an epsilon that the noise is far below one vehicle.
    process = make(privacy={"preset": preset, "epsilon": 10_000.0, **OWN_NOISE[preset]})
    begin(process)
    record = process.traffic.record(1)
    connected = process.config.penetration.reports(process.config.traffic_seeds[1], record)
    length = process.config.corridor.segment_lengths[0]
    for released, request in play(process, 20):
        t = int(request.times[0])
        counts = released.values[0, :, 0] * length
        sigma = np.broadcast_to(released.sigma, released.values.shape)[0, :, 0] * length
        queries, sensors = [0, 3], process.interface.queries.sensor_rows(process.config.corridor)
        np.testing.assert_array_less(
            abs(counts[queries] - connected.counts[t, queries]), 5.0 * sigma[queries]
        )
        np.testing.assert_array_less(
            abs(counts[list(sensors)] - record.counts[t, SENSORS]), 5.0 * sigma[list(sensors)]
        )
        assert sigma.max() < 0.25


def test_a_sensor_and_a_query_of_its_segment_have_rows_of_their_own():
    queries = resolve("short-highway", {"penetration": SHARE}).queries
    corridor = resolve("short-highway", {"corridor": {"fixed_sensors": SENSORS}}).corridor
    rows = queries.rows(corridor)
    assert rows.first.tolist() == [*range(S), 3, 5]
    assert queries.sensor_rows(corridor) == (8, 9, 7)
    process = make()
    begin(process)
    ((_, request),) = play(process, 1)
    assert np.flatnonzero(request.observed[0]).tolist() == [0, 3, 7, 8, 9]


def test_no_connected_vehicle_on_a_queried_segment_is_a_normal_answer():
    process = make(penetration=1e-9, privacy={"preset": "capped"})
    begin(process)
    values = np.array([released.values[0, [0, 3]] for released, _ in play(process, 50)])
    sigma = process.release.sigma
    assert abs(values.mean(axis=(0, 1)) / sigma).max() < 5.0 / math.sqrt(100)
    assert abs(values.std(axis=(0, 1)) / sigma - 1.0).max() < 0.35


@pytest.mark.parametrize("preset", ["capped", "paced"])
def test_squared_parameters_of_both_mechanisms_add_up(preset):
    config = resolve("private-highway-v1", {"penetration": 0.1, "privacy": preset})
    whole, report = mu_of(config.privacy.epsilon, config.privacy.delta), privacy_report(config)
    assert report.mu == pytest.approx(whole, rel=1e-6)
    assert report.void_reasons == ()
    assert report.guarantee.endswith("under queries and fixed sensors together")
    release = make_release(config)
    assert isinstance(release, TwoMechanisms)
    parts = [part.report().mu ** 2 for part in release.parts]
    assert sum(parts) == pytest.approx(whole**2, rel=1e-6)
    details = report.to_dict()
    assert details["queries_mu"] ** 2 == pytest.approx(parts[0])
    assert details["sensors_mu"] ** 2 == pytest.approx(parts[1])


@pytest.mark.parametrize("preset", ["capped", "paced"])
def test_what_is_spent_grows_to_mu_and_not_beyond(preset):
    process = make(privacy={"preset": preset, "epsilon": 1.0})
    begin(process)
    mu, past = privacy_report(process.config).mu, 0.0
    for _ in range(60):
        play(process, 1)
        spent = process.release.spent(ONE, process.elapsed[ONE])[0][0]
        assert past <= spent <= mu * (1.0 + 1e-12)
        past = spent
    assert past > 0.5 * mu


@pytest.mark.parametrize("share", [0.1, 0.6])
@pytest.mark.parametrize("preset", ["capped", "paced"])
def test_sensors_have_the_part_of_the_budget_that_is_asked_for(preset, share):
    keywords = {"penetration": 0.1, "privacy": preset, "detectors": {"budget_share": share}}
    config = resolve("private-highway-v1", keywords)
    whole, release = privacy_report(config).mu, make_release(config)
    assert release.sensors.report().mu ** 2 == pytest.approx(share * whole**2, rel=1e-6)
    assert whole == pytest.approx(mu_of(config.privacy.epsilon, config.privacy.delta), rel=1e-6)


def test_a_part_of_the_budget_makes_two_mechanisms_of_one():
    config = resolve("short-highway", {"detectors": {"budget_share": 0.5}})
    assert isinstance(make_release(config), TwoMechanisms)


def test_without_sensors_queries_have_the_whole_budget():
    process = make(corridor={"fixed_sensors": []}, privacy={"preset": "paced"})
    assert process.release.sensors is None
    assert process.release.queries.setup.budget_share == 1.0
    begin(process)
    play(process, 5)
    assert privacy_report(process.config).mu == pytest.approx(process.release.queries.mu)


def test_only_connected_vehicles_have_ledgers_of_queries():
    process = make(privacy={"preset": "paced"}, truth_in_info=True)
    begin(process)
    play(process, 30)
    connected = process.config.penetration.connected(
        process.config.traffic_seeds[1], process.traffic.record(1)
    )
    truth = process.info(0)["truth"]
    queries, sensors = (np.array(truth[name]) for name in ("ledgers", "sensor_ledgers"))
    assert (queries > 0.0).any()
    assert not queries[~connected[: queries.size]].any()
    assert sensors[~connected[: sensors.size]].any()


@pytest.mark.parametrize(
    ("preset", "keywords"),
    pairwise(PRESETS, [{}, {"detectors": {"dropout": 0.3, "absolute": 0.5}}], n=4),
)
def test_a_fork_gives_the_bits_of_its_origin_and_leaves_it_alone(preset, keywords):
    process = make(privacy={"preset": preset}, **keywords)
    begin(process)
    play(process, 5)
    fork = process.fork()
    ahead = [released.values for released, _ in play(fork, 5)]
    again = [released.values for released, _ in play(process, 5)]
    np.testing.assert_array_equal(ahead, again)
    np.testing.assert_array_equal(fork.estimate.density, process.estimate.density)
    assert fork.release.queries.setup is process.release.queries.setup


def test_given_noise_reaches_both_mechanisms():
    process = make(privacy={"preset": "paced"})
    begin(process)
    columns = process.release.setup.n_columns
    process.release.give_noise(np.zeros((1, columns, 2)))
    ((released, request),) = play(process, 1)
    record, t = process.traffic.record(1), int(request.times[0])
    length = process.config.corridor.segment_lengths[0]
    np.testing.assert_allclose(
        released.values[0, [7, 8, 9], 0] * length, record.counts[t, [7, 3, 5]], atol=0.05
    )


@pytest.mark.parametrize("sensors", [SENSORS, (7,)])
def test_an_empty_sensor_releases_the_speed_limit_of_its_own_segment(sensors):
    road = dataclasses.replace(corridor(1), fixed_sensors=sensors, ramp_speed_limit=60.0)
    empty = record(np.full((1, 2), AWAY), np.zeros((1, 2)), S + road.n_boundaries)
    traffic, settings = (
        TrafficTable(road, (0,), Worlds(empty)),
        CappedSettings(speed_release="mean"),
    )
    options = QueryOptions.make(N, 2, separate_sensors=True)
    setup = ReleaseSetup("capped", settings, traffic, 2, 1, 1, options)
    release = TwoMechanisms(Capped, setup, Penetration(SHARE), Detectors())
    release.load(0, empty)
    release.reset(ONE, [np.random.default_rng(0)])
    release.give_noise(np.zeros((1, setup.n_columns, 2)))
    request = ReleaseRequest(ONE, ONE, ONE + 1, setup.observed(np.zeros((1, N), dtype=bool)))
    speeds = release.release(request).values[0, :, 1]
    np.testing.assert_allclose(speeds, np.array(road.speed_limits)[setup.places], atol=0.5)
    assert speeds[7] == pytest.approx(60.0, abs=0.5)


# --- errors of detectors ---------------------------------------------------------------------


def test_a_detector_that_miscounts_changes_its_answers_alone():
    privacy = {"preset": "paced"}
    sound, wrong = (
        make(privacy=privacy, detectors=detectors)
        for detectors in ({}, {"factor": [1.5, 1.0, 1.0]})
    )
    found = []
    for process in (sound, wrong):
        begin(process)
        process.release.give_noise(np.zeros((1, process.release.setup.n_columns, 2)))
        found.append(play(process, 1)[0][0].values[0])
    np.testing.assert_allclose(found[1][8], 1.5 * found[0][8])
    np.testing.assert_array_equal(np.delete(found[1], 8, axis=0), np.delete(found[0], 8, axis=0))


def test_a_silent_detector_is_not_observed_and_charges_nobody():
    process = make(privacy={"preset": "paced"}, detectors={"dropout": 0.9}, truth_in_info=True)
    begin(process)
    seen, update = [], process.estimator.update
    process.estimator.update = lambda episodes, measured: (
        seen.append(measured.observed[0].copy()),
        update(episodes, measured),
    )
    found = play(process, 40)
    answered = np.array([released.observed[0, [8, 9, 7]] for released, _ in found])
    assert abs(answered.mean() - 0.1) < 0.1
    np.testing.assert_array_equal(np.array(seen)[:, [8, 9, 7]], answered)
    often = make(privacy={"preset": "paced"}, truth_in_info=True)
    begin(often)
    play(often, 40)
    paid = [np.sum(p.info(0)["truth"]["sensor_ledgers"]) for p in (process, often)]
    assert 0.0 < paid[0] < 0.3 * paid[1]


def test_a_known_error_is_in_the_deviation_of_the_release():
    process = make(
        privacy={"preset": "corrected", "epsilon": 10_000.0},
        detectors={"absolute": 2.0, "relative": 0.5},
    )
    begin(process)
    length, errors = process.config.corridor.segment_lengths[0], []
    for released, request in play(process, 60):
        counts = process.traffic.record(1).counts[int(request.times[0]), [3, 5]]
        sigma = released.sigma[0, [8, 9], 0] * length
        assert (sigma >= 2.0).all()
        errors.append((released.values[0, [8, 9], 0] * length - counts) / sigma)
    assert 0.7 < np.std(errors) < 1.3


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"detectors": {"relative": 0.1}}, "detectors.absolute must be > 0"),
        ({"detectors": {"dropout": 1.0}}, "detectors.dropout must be"),
        ({"detectors": {"factor": [1.0, 1.0, 1.0]}}, "one for each of the 2 fixed sensors"),
        (
            {"detectors": {"dropout": 0.1}, "corridor": {"fixed_sensors": []}},
            "detectors must be left out on a road without fixed sensors",
        ),
        ({"fusion": {"dwell_factor": -1.0}}, "fusion.dwell_factor must be"),
    ],
)
def test_bad_sensors_are_refused_by_path(keywords, message):
    with pytest.raises(ValueError, match=message):
        resolve("short-highway", keywords)


def test_detectors_without_errors_are_exact():
    assert Detectors().are_exact
    assert not Detectors(factor=1.1).are_exact


@pytest.mark.parametrize("preset", PRESETS)
def test_the_environment_keeps_gymnasiums_rules(preset):
    env = gym.make(
        "dptse_env:dptse/ShortHighway-v0",
        penetration=0.2,
        privacy={"preset": preset},
        detectors={"dropout": 0.1},
    )
    check_env(env.unwrapped, skip_render_check=True)
    env.close()
