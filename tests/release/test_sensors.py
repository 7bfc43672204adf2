"""Connected vehicles and fixed sensors: groups of columns, and the errors of detectors."""

import dataclasses
import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dptse_env.config import resolve
from dptse_env.parts import make_interface, make_parts, make_release, privacy_report
from dptse_env.privacy import mu_of
from dptse_env.process import QueryProcess
from dptse_env.release import Detectors, Group, PacedSettings, make_groups
from dptse_env.release.noise import BLOCK
from dptse_env.traffic import Penetration
from tests.helpers import SumRelease, pairwise

from .test_noise import residual_faults
from .worlds import LENGTH, ONE, Worlds, crowd, predicting, request

SHARE = 0.3
N, SENSORS = 6, (3, 5, 7)
PRESETS = ("paper", "corrected", "capped", "paced")
OWN_NOISE = {"paper": {}, "corrected": {}, "capped": {"cap": 1_000}, "paced": {}}
ERRORS = {"dropout": 0.3, "absolute": 0.5}


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
    """Query the same segments in every step; return releases, what is made of them, requests."""
    action = np.zeros((process.n_episodes, N), dtype=np.int8)
    action[:, list(queried)] = 1
    found, release, update = [], process.release.release, process.estimator.update

    def spy(asked):
        found.append([release(asked), asked])
        return found[-1][0]

    def spy_update(episodes, measured):
        found[-1].append(measured)
        update(episodes, measured)

    process.release.release, process.estimator.update = spy, spy_update
    for _ in range(n_steps):
        process.step(np.arange(process.n_episodes), action)
    process.release.release, process.estimator.update = release, update
    return found


# --- groups of columns -------------------------------------------------------------------------


@pytest.mark.parametrize("keywords", [{}, {"penetration": 1.0}, {"penetration": {"seed": 4}}])
def test_where_all_vehicles_are_connected_there_is_one_group(keywords):
    parts = make_parts(resolve("short-highway", keywords))
    assert parts.release.task.groups == (Group("queries"),)
    assert (parts.fusion, parts.detectors) == (None, None)
    assert "groups" not in parts.release.report().to_dict()


def test_groups_are_queries_and_sensors_with_their_parts_of_the_budget():
    road = resolve("short-highway", {}).corridor
    bare, some = dataclasses.replace(road, fixed_sensors=()), Penetration(0.25)

    def shares(*args, private=False):
        groups = make_groups(*args, private_boundary=private)
        assert [group.population for group in groups][1:] in ([], [None])
        return {group.name: group.budget_share for group in groups}

    assert shares(some, Detectors(), road) == pytest.approx({"queries": 0.6, "sensors": 0.4})
    assert shares(Penetration(), Detectors(budget_share=0.1), road)["sensors"] == 0.1
    assert shares(some, Detectors(), bare) == {"queries": 1.0}
    assert set(shares(some, Detectors(), bare, private=True)) == {"queries", "sensors"}


def test_a_model_that_knows_of_no_groups_is_refused_before_anything_is_recorded():
    for keywords in ({"penetration": 0.5}, {"detectors": {"dropout": 0.1}}):
        config = resolve("short-highway", {"privacy": SumRelease, **keywords})
        with pytest.raises(ValueError, match=r"^penetration\.share must be 1, .*SumRelease'"):
            make_interface(config)
        with pytest.raises(ValueError, match=r"which knows of no groups of columns$"):
            gym.make("dptse_env:dptse/ShortHighway-v0", privacy=SumRelease, **keywords)
    assert make_release(resolve("short-highway", {"privacy": SumRelease})).task.is_whole


def test_a_sensor_and_a_query_of_its_segment_have_columns_of_their_own():
    process = make()
    task = process.release.task
    assert task.first.tolist() == [*range(8), 3, 5]
    assert task.sensors.tolist() == [8, 9, 7]
    assert task.group.tolist() == [0] * N + [1] * 4
    begin(process)
    ((_, asked, _),) = play(process, 1)
    assert np.flatnonzero(asked.observed[0]).tolist() == [0, 3, 7, 8, 9]


@pytest.mark.parametrize("preset", PRESETS)
def test_queries_count_connected_vehicles_and_sensors_all(preset):
    # So large an epsilon that the noise is far below one vehicle.
    process = make(privacy={"preset": preset, "epsilon": 10_000.0, **OWN_NOISE[preset]})
    begin(process)
    record, task = process.traffic.record(1), process.release.task
    connected = Penetration(SHARE).connected(process.config.traffic_seeds[1], record)
    some = record.where(connected[record.vehicle])
    for released, asked, _ in play(process, 20):
        t = int(asked.times[0])
        counts, sigma = released.values[0, :, 0] * LENGTH, released.sigma[0, :, 0] * LENGTH
        for columns, expected in (([0, 3], some.counts[t, [0, 3]]),
                                  (task.sensors, record.counts[t, SENSORS])):  # fmt: skip
            np.testing.assert_array_less(abs(counts[columns] - expected), 5.0 * sigma[columns])
        assert sigma.max() < 0.25


def test_no_connected_vehicle_on_a_queried_segment_is_a_normal_answer():
    process = make(penetration=1e-6, privacy={"preset": "capped"})
    begin(process)
    values = np.array([released.values[0, [0, 3]] for released, *_ in play(process, 50)])
    sigma = process.release.sigma
    assert abs(values.mean(axis=(0, 1)) / sigma).max() < 5.0 / math.sqrt(100)
    assert abs(values.std(axis=(0, 1)) / sigma - 1.0).max() < 0.35


@pytest.mark.parametrize("unit", ["trip", "event"])
def test_one_stream_draws_independent_noise_for_the_columns_of_both_groups(unit):
    """Columns of a query and of a sensor on the same segment are neighbours here."""
    groups = Group("queries", 0.6), Group("sensors", 0.4)
    asked, worlds = PacedSettings(unit=unit), Worlds(crowd())
    release, twin = (worlds.started(asked, seed=3, groups=groups) for _ in range(2))
    n_columns, true, released = release.task.n_columns, [], []
    for second in np.tile(np.arange(1, 9), 80).tolist():
        every = request(second, prediction=predicting(20.0, 50.0), n_columns=n_columns)
        found = release.release(every)
        sums, _ = twin.collect(every, release.prices, found.centre)
        true.append((sums / LENGTH / found.sigma)[0])
        released.append((found.values / found.sigma)[0])
    # Segment 5 has a sensor, whose column comes after the ramps.
    assert release.task.first[[5, 8]].tolist() == [5, 5]
    order = [5, 8, 0, 1, 2, 3, 4, 6, 7, *range(9, n_columns)]
    found = residual_faults(np.array(true)[:, order], np.array(released)[:, order], 1.0)
    assert found == []


# --- the account ---------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["capped", "paced"])
def test_squared_parameters_of_groups_add_up_and_the_report_names_each(preset):
    config = resolve("private-highway-v1", {"penetration": 0.1, "privacy": preset})
    whole, report = mu_of(config.privacy.epsilon, config.privacy.delta), privacy_report(config)
    assert report.mu == pytest.approx(whole, rel=1e-12)
    assert report.void_reasons == ()
    assert report.guarantee.endswith("under queries and fixed sensors together")
    release, groups = make_release(config), report.to_dict()["groups"]
    assert [(g["group"], g["vehicles"]) for g in groups] == [
        ("queries", "connected"), ("sensors", "all"),
    ]  # fmt: skip
    assert sum(g["mu"] ** 2 for g in groups) == pytest.approx(whole**2, rel=1e-12)
    for group, share, mu in zip(groups, release.task.shares, release.mu, strict=True):
        assert group["budget_share"] == pytest.approx(share)
        assert group["mu"] == mu == pytest.approx(whole * math.sqrt(share))
    assert groups[0]["noise_std"] == release.sigma.tolist()
    assert groups[1]["noise_std"] != groups[0]["noise_std"]


@pytest.mark.parametrize("share", [0.1, 0.6])
@pytest.mark.parametrize("preset", ["capped", "paced"])
def test_sensors_have_the_part_of_the_budget_that_is_asked_for(preset, share):
    keywords = {"penetration": 0.1, "privacy": preset, "detectors": {"budget_share": share}}
    release = make_release(resolve("private-highway-v1", keywords))
    whole = release.report().mu
    assert release.mu[1] ** 2 == pytest.approx(share * whole**2, rel=1e-12)
    if preset == "paced":
        assert release.ledgers.budget == pytest.approx(release.mu**2 / 2.0)


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


def test_what_is_spent_is_the_sum_over_groups():
    """Not that of the group that has spent more."""
    process = make(privacy={"preset": "paced"})
    begin(process)
    for released, asked, _ in play(process, 3):
        assert released.observed.sum() == asked.observed.sum()
    release, task = process.release, process.release.task
    charged = np.zeros(2)
    begin(process)
    for _ in range(3):
        ((_, asked, _),) = play(process, 1)
        paid = np.where(asked.observed[0], 2.0 * release.prices[0], 0.0)
        charged += [paid[task.group == g].max() for g in (0, 1)]
    assert release.spent(ONE, ONE)[0][0] ** 2 == pytest.approx(2.0 * charged.sum())


def test_only_connected_vehicles_have_ledgers_of_queries():
    process = make(privacy={"preset": "paced"}, truth_in_info=True)
    begin(process)
    play(process, 30)
    record = process.traffic.record(1)
    connected = Penetration(SHARE).connected(process.config.traffic_seeds[1], record)
    truth = process.info(0)["truth"]
    queries, sensors = (np.array(truth[name]) for name in ("ledgers", "sensor_ledgers"))
    assert (queries > 0.0).any()
    assert not queries[~connected].any()
    assert sensors[~connected].any()
    assert len(truth["individual_epsilon"]) == record.n_vehicles


# --- the process -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "keywords"), pairwise(PRESETS, [{}, {"detectors": ERRORS}], n=4, rest=False)
)
def test_a_fork_gives_the_bits_of_its_origin_and_leaves_it_alone(preset, keywords):
    process = make(privacy={"preset": preset}, **keywords)
    begin(process)
    play(process, 5)
    fork = process.fork()
    ahead = [measured.values for *_, measured in play(fork, 5)]
    again = [measured.values for *_, measured in play(process, 5)]
    np.testing.assert_array_equal(ahead, again)
    np.testing.assert_array_equal(fork.estimate.density, process.estimate.density)
    assert fork.release.task is process.release.task
    assert fork.release.traffic is process.traffic


def test_given_noise_reaches_both_groups():
    process = make(privacy={"preset": "paced"})
    begin(process)
    process.release.give_noise(np.zeros((1, process.release.task.n_columns, 2)))
    ((released, asked, _),) = play(process, 1)
    record, t = process.traffic.record(1), int(asked.times[0])
    np.testing.assert_allclose(
        released.values[0, [7, 8, 9], 0] * LENGTH, record.counts[t, [7, 3, 5]], atol=0.05
    )


# --- detectors ---------------------------------------------------------------------------------


def test_an_error_of_a_detector_changes_what_it_measures_alone_and_no_release():
    """Noise comes from a stream of its own: that of releases is the same with errors or without."""
    found = []
    for detectors in ({"budget_share": 0.4}, {"budget_share": 0.4, "factor": [2.0, 1.0, 1.0]},
                      {"budget_share": 0.4, "absolute": 1.0}):  # fmt: skip
        process = make(privacy={"preset": "corrected"}, detectors=detectors, estimator="open_loop")
        begin(process)
        found.append(play(process, BLOCK + 2))  # the second block of noise as well
    for (one, *_), (two, *_), (three, *_) in zip(*found, strict=True):
        np.testing.assert_array_equal(one.values, two.values)
        np.testing.assert_array_equal(one.values, three.values)
    for exact, doubled, noisy in zip(*found, strict=True):
        measured = [each[2] for each in (exact, doubled, noisy)]
        others = np.arange(10) != 8
        np.testing.assert_array_equal(measured[1].values[0, others], measured[0].values[0, others])
        assert measured[1].values[0, 8, 0] == 2.0 * measured[0].values[0, 8, 0]
        np.testing.assert_array_equal(measured[2].values[0, :N], measured[0].values[0, :N])
        assert (measured[2].values[0, [7, 8, 9], 0] != measured[0].values[0, [7, 8, 9], 0]).all()


def test_a_silent_detector_is_not_observed_and_charges_nobody():
    process = make(privacy={"preset": "paced"}, detectors={"dropout": 0.9}, truth_in_info=True)
    begin(process)
    found = play(process, 40)
    sensors = process.release.task.sensors
    answered = np.array([released.observed[0, sensors] for released, *_ in found])
    assert abs(answered.mean() - 0.1) < 0.1
    told = np.array([measured.observed[0, sensors] for *_, measured in found])
    np.testing.assert_array_equal(told, answered)
    often = make(privacy={"preset": "paced"}, truth_in_info=True)
    begin(often)
    play(often, 40)
    paid = [np.sum(p.info(0)["truth"]["sensor_ledgers"]) for p in (process, often)]
    assert 0.0 < paid[0] < 0.3 * paid[1]


def test_a_known_error_is_in_the_deviation_of_the_measurement():
    process = make(
        privacy={"preset": "corrected", "epsilon": 10_000.0},
        detectors={"absolute": 2.0, "relative": 0.5},
    )
    begin(process)
    errors = []
    for _, asked, measured in play(process, 60):
        counts = process.traffic.record(1).counts[int(asked.times[0]), [3, 5]]
        sigma = measured.sigma[0, [8, 9], 0] * LENGTH
        assert (sigma >= 2.0).all()
        errors.append((measured.values[0, [8, 9], 0] * LENGTH - counts) / sigma)
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
    assert Detectors(budget_share=0.5).are_exact
    assert not Detectors(factor=1.1).are_exact


@pytest.mark.parametrize("preset", PRESETS)
def test_the_environment_keeps_gymnasiums_rules(preset):
    env = gym.make(
        "dptse_env:dptse/ShortHighway-v0",
        penetration=0.2, privacy={"preset": preset}, detectors={"dropout": 0.1},
    )  # fmt: skip
    check_env(env.unwrapped, skip_render_check=True)
    env.close()
