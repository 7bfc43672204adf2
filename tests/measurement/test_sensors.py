"""Connected vehicles and fixed sensors: groups of channels, and errors of the latter."""

import dataclasses
import math

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.measurement import SensorSettings, make_groups
from dptse_env.parts import make_release, privacy_report
from dptse_env.privacy import mu_of
from dptse_env.process import QueryProcess
from dptse_env.release import Group
from dptse_env.release.noise import BLOCK
from dptse_env.traffic import Penetration
from tests.helpers import SumRelease, lock_step
from tests.release.worlds import LENGTH, ONE

SHARE = 0.3
N, SENSORS = 6, (3, 5, 7)
COLUMNS = [7, 8, 9]
"""Columns of the sensors on 7, a ramp, 3 and 5."""
PRESETS = ("printed", "corrected", "capped", "paced")
QUIET = {"epsilon": 10_000.0}
"""So large an epsilon that the noise is far below one vehicle."""


def begun(preset="paced", seed=3, *, privacy=None, **keywords):
    """A process of one episode with three sensors, a part of whose vehicles is connected."""
    given = {
        "traffic_seeds": "0:2",
        "penetration": SHARE,
        "corridor": {"fixed_sensors": SENSORS},
        "horizon": 60,
        "random_start": True,
        "privacy": {"preset": preset, **(privacy or {})},
        **keywords,
    }
    process = QueryProcess(resolve("short-plain", given))
    process.reset(ONE, [np.random.default_rng(seed)], {"traffic_seed": 1, "start": 150})
    return process


def play(process, n_steps, queried=(0, 3)):
    """Query the same segments in every step; return releases, requests, and what is made of them.

    The last is what the estimator is given.
    """
    found, release, update = [], process.release.release, process.estimator.update

    def spy(asked):
        found.append([release(asked), asked])
        return found[-1][0]

    def spy_update(episodes, measured):
        found[-1].append(measured)
        update(episodes, measured)

    process.release.release, process.estimator.update = spy, spy_update
    for _ in range(n_steps):
        process.step(ONE, np.isin(np.arange(N), queried)[None].astype(np.int8))
    process.release.release, process.estimator.update = release, update
    return found


# --- groups of channels -------------------------------------------------------------------------


def test_groups_are_queries_and_sensors_with_their_parts_of_the_budget():
    road = resolve("short-plain", {}).corridor
    bare, some = dataclasses.replace(road, fixed_sensors=()), Penetration(0.25)

    def shares(*args, private=False):
        groups = make_groups(*args, private_boundary=private)
        assert [group.population for group in groups][1:] in ([], [None])
        return {group.name: group.budget_share for group in groups}

    assert shares(some, SensorSettings(), road) == pytest.approx({"queries": 0.6, "sensors": 0.4})
    assert shares(Penetration(), SensorSettings(budget_share=0.1), road)["sensors"] == 0.1
    assert shares(some, SensorSettings(), bare) == {"queries": 1.0}
    assert set(shares(some, SensorSettings(), bare, private=True)) == {"queries", "sensors"}
    assert make_release(resolve("short-plain", {"privacy": SumRelease})).task.is_whole
    for all_connected in ({}, {"penetration": 1.0}, {"penetration": {"seed": 4}}):
        process = QueryProcess(resolve("short-plain", all_connected))
        assert process.release.task.groups == (Group("queries"),)
        assert (process.fusion, process.sensor_errors) == (None, None)
        assert "groups" not in process.release.report().to_dict()


@pytest.mark.parametrize("preset", PRESETS)
def test_queries_count_connected_vehicles_and_sensors_all_in_columns_of_their_own(preset):
    process = begun(preset, privacy={**QUIET, **({"cap": 1_000} if preset == "capped" else {})})
    task = process.release.task
    assert task.channels.first.tolist() == [*range(8), 3, 5]
    assert task.sensors.tolist() == [8, 9, 7]
    assert task.channels.group.tolist() == [0] * N + [1] * 4
    record = process.traffic.record(1)
    connected = Penetration(SHARE).connected(process.config.traffic_seeds[1], record)
    some = record.where(connected[record.vehicle])
    for released, asked, _ in play(process, 12):
        assert np.flatnonzero(asked.observed[0]).tolist() == [0, 3, *COLUMNS]
        second = int(asked.times[0])
        expected = np.append(some.counts[second, [0, 3]], record.counts[second, [7, 3, 5]])
        counts, sigma = (
            array[0, [0, 3, *COLUMNS], 0] * LENGTH for array in (released.values, released.sigma)
        )
        np.testing.assert_array_less(abs(counts - expected), 5.0 * sigma)
        assert sigma.max() < 0.25


# --- the account -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "asked"), [("capped", None), ("capped", 0.1), ("paced", None), ("paced", 0.6)]
)
def test_squared_parameters_of_groups_add_up_and_the_report_names_each(preset, asked):
    keywords = {"sensor_settings": {"budget_share": asked}} if asked else {}
    config = resolve("private-highway", {"penetration": 0.1, "privacy": preset, **keywords})
    whole, report = mu_of(config.privacy.epsilon, config.privacy.delta), privacy_report(config)
    assert report.mu == pytest.approx(whole, rel=1e-12)
    assert report.void_reasons == ()
    assert "under queries and fixed sensors together" in report.guarantee
    release, groups = make_release(config), report.to_dict()["groups"]
    assert [(g["group"], g["vehicles"]) for g in groups] == [
        ("queries", "connected"), ("sensors", "all"),
    ]  # fmt: skip
    assert sum(g["mu"] ** 2 for g in groups) == pytest.approx(whole**2, rel=1e-12)
    for group, share, mu in zip(groups, release.task.shares, release.mu, strict=True):
        assert group["budget_share"] == pytest.approx(share)
        assert group["mu"] == mu == pytest.approx(whole * math.sqrt(share))
    assert asked in (None, pytest.approx(groups[1]["budget_share"]))
    assert groups[0]["noise_std"] == release.sigma.tolist()
    assert groups[1]["noise_std"] != groups[0]["noise_std"]
    if preset == "paced":
        assert release.ledgers.terms.budget == pytest.approx(release.mu**2 / 2.0)


@pytest.mark.parametrize("preset", ["capped", "paced"])
def test_what_is_spent_grows_to_mu_by_the_largest_charges_of_both_groups(preset):
    process = begun(preset, privacy={"epsilon": 1.0})
    release, task = process.release, process.release.task
    mu, past, charged = privacy_report(process.config).mu, 0.0, np.zeros(2)
    for second in range(60):
        ((_, asked, _),) = play(process, 1)
        spent = release.spent(ONE, process.elapsed[ONE])[0][0]
        assert past <= spent <= mu * (1.0 + 1e-12)
        past = spent
        if preset == "paced" and second < 3:
            paid = np.where(asked.observed[0], 2.0 * release.prices[0], 0.0)
            charged += [paid[task.channels.group == g].max() for g in (0, 1)]
            assert spent**2 == pytest.approx(2.0 * charged.sum())
    assert past > 0.5 * mu


# --- the process -------------------------------------------------------------------------------


def test_a_batch_is_so_many_scalar_environments():
    """Ledgers among their infos, too, which differ in length from record to record."""
    keywords = {"penetration": SHARE, "sensor_settings": {"dropout": 0.3, "absolute": 0.5}}
    lock_step({"privacy": "paced", "truth_in_info": True, **keywords}, 8)


# --- errors of fixed sensors ---------------------------------------------------------------------


def test_an_error_of_a_sensor_changes_what_it_measures_alone_and_no_release():
    """Noise comes from a stream of its own: that of releases is the same with errors or without."""
    exact, doubled, noisy = (
        play(
            begun(
                "corrected", sensor_settings={"budget_share": 0.4, **error}, estimator="open_loop"
            ),
            BLOCK + 2,  # the second block of noise as well
        )
        for error in ({}, {"factor": [2.0, 1.0, 1.0]}, {"absolute": 1.0})
    )
    for (one, _, good), (two, _, twice), (three, _, wrong) in zip(
        exact, doubled, noisy, strict=True
    ):
        np.testing.assert_array_equal(one.values, two.values)
        np.testing.assert_array_equal(one.values, three.values)
        expected = good.values.copy()
        expected[0, 8, 0] *= 2.0
        np.testing.assert_array_equal(twice.values, expected)
        np.testing.assert_array_equal(wrong.values[0, :N], good.values[0, :N])
        assert (wrong.values[0, COLUMNS, 0] != good.values[0, COLUMNS, 0]).all()


def test_a_silent_sensor_is_not_observed_and_charges_nobody():
    process, often = begun(sensor_settings={"dropout": 0.9}), begun()
    found = play(process, 40)
    play(often, 40)
    answered = np.array([released.observed[0, COLUMNS] for released, *_ in found])
    assert abs(answered.mean() - 0.1) < 0.1
    told = np.array([measured.observed[0, COLUMNS] for *_, measured in found])
    np.testing.assert_array_equal(told, answered)
    one = np.array([0])
    private = [p.release.private(one, p.traffic_index) for p in (process, often)]
    paid = [np.sum(each["sensor_ledgers"][0]) for each in private]
    assert 0.0 < paid[0] < 0.3 * paid[1]


@pytest.mark.parametrize("preset", ["corrected", "paced"])
def test_errors_are_as_large_as_the_deviation_of_the_measurement_says(preset):
    """Flows have the factor alone, mean speeds nothing; the factor is in no deviation."""
    process = begun(preset, sensor_settings={"absolute": 2.0, "relative": 0.5, "factor": 1.5})
    errors = []
    for released, _, measured in play(process, 60):
        values, sigma = measured.values[0, COLUMNS], measured.sigma[0, COLUMNS]
        density, second = 1.5 * released.values[0, COLUMNS, 0], released.values[0, COLUMNS, 1]
        known = 2.0 / LENGTH + 0.5 * np.maximum(density, 0.0)
        errors.append((values[:, 0] - density) / known)
        np.testing.assert_allclose(sigma[:, 0], np.hypot(released.sigma[0, COLUMNS, 0], known))
        np.testing.assert_array_equal(sigma[:, 1], released.sigma[0, COLUMNS, 1])
        np.testing.assert_allclose(values[:, 1], second * (1.5 if preset == "paced" else 1.0))
    assert 0.8 < np.std(errors) < 1.2


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"sensor_settings": {"relative": 0.1}}, "sensor_settings.absolute must be > 0"),
        ({"sensor_settings": {"dropout": 1.0}}, "sensor_settings.dropout must be"),
        ({"sensor_settings": {"factor": [1.0, 1.0, 1.0]}}, "sensor_settings.factor must be one"),
        (
            {"sensor_settings": {"dropout": 0.1}, "corridor": {"fixed_sensors": []}},
            "sensor_settings must be left out on a road without fixed sensors",
        ),
        ({"fusion": {"dwell_factor": -1.0}}, "fusion.dwell_factor must be"),
        # Of a model that knows of no groups.
        ({"privacy": SumRelease, "penetration": 0.5}, "penetration.share must be 1 with .*Sum"),
        (
            {"privacy": SumRelease, "sensor_settings": {"dropout": 0.1}},
            "sensor_settings must be left out with the release model .*SumRelease'",
        ),
    ],
)
def test_bad_sensors_are_refused_by_path(keywords, message):
    with pytest.raises(ValueError, match=rf"^{message}"):
        resolve("short-plain", keywords)
