import csv
import dataclasses
import math

import numpy as np
import pytest

from agents.environments import make_config, quietly
from agents.evaluation.episodes import EpisodeScore
from agents.experiments.cells import DENSITY, METRICS, SPEED, Change
from agents.experiments.old_tables import (
    format_number,
    settings_table,
    versions_table,
    write_summary,
)
from agents.experiments.provenance import design_provenance
from agents.experiments.reports import fill
from agents.experiments.runner import EpisodeTask, run_task
from agents.statistics import Interval
from agents.studies.privacy import study, tables
from agents.studies.privacy.account import make_account, measure_trips, mu_alone, mu_met
from agents.studies.privacy.plan import BOUNDARY_MODES, PrivacyCell, PrivacyDesign, Protection
from agents.studies.privacy.results import PrivacyResults
from agents.studies.privacy.tables import cost_table, modes_table
from dptse_env.config import resolve
from dptse_env.parts import privacy_report
from dptse_env.privacy import epsilon_of
from dptse_env.traffic import RecordLibrary
from dptse_env.traffic.record import Record

SHORT = "dptse_env:dptse/ShortHighway-v0"
DESIGN = PrivacyDesign(
    seeds="2000:2003",
    epsilons=(1.0, 20.0),
    caps=(4,),
    bandwidths=(1,),
    bandwidth=2,
    env=SHORT,
)
BASE = DESIGN.cell("ekf")


def config_of(cell):
    with quietly():
        return make_config(SHORT, cell.keywords)


# What is run


def test_the_full_design_holds_what_the_study_is_about():
    design = PrivacyDesign()
    assert len(design.traffic_seeds) >= 20
    cells = set(design.cells())
    for name in ("ekf", "random_walk"):
        for epsilon in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0):
            for cap in (4, 16, 64):
                cell = PrivacyCell(name, "capped", "trip", cap, "nominal", epsilon, 0.05, 5)
                assert cell in cells
            for unit in ("horizon", "event"):
                assert PrivacyCell(name, "capped", unit, 0, "nominal", epsilon, 0.05, 5) in cells
            for preset in ("paper", "corrected"):
                assert PrivacyCell(name, preset, "none", 0, "true", epsilon, 0.05, 5) in cells
        for mode in ("true", "nominal", "private"):
            assert PrivacyCell(name, "capped", "trip", 64, mode, 5.0, 0.05, 5) in cells
        for bandwidth in (3, 5, 8, 15):
            cell = PrivacyCell(name, "capped", "trip", 64, "nominal", 5.0, 0.05, bandwidth)
            assert cell in cells


def test_cells_that_figures_share_are_run_once():
    cells = PrivacyDesign().cells()
    assert len(cells) == len(set(cells))
    # Five units of six epsilons, two presets of six, two modes, three bandwidths; for each of two.
    n_private_open_loops = 1
    assert len(cells) == 2 * (5 * 6 + 2 * 6 + 2 + 3) + 2 + n_private_open_loops


@pytest.mark.parametrize("cell", DESIGN.cells(), ids=str)
def test_the_environment_is_what_the_cell_says(cell):
    config = config_of(cell)
    privacy = config.privacy
    assert (config.estimator, config.bandwidth) == (cell.estimator, cell.bandwidth)
    assert (privacy.preset, privacy.boundary) == (cell.preset, cell.boundary_inputs)
    assert (privacy.epsilon, privacy.delta) == (cell.epsilon, cell.delta)
    if cell.preset == "capped":
        assert (privacy.unit, privacy.contribution_cap or 0) == (cell.unit, cell.cap)


def test_the_open_loop_does_not_depend_on_what_its_shared_cell_leaves_out():
    RecordLibrary().ensure(resolve("short-highway", {}).corridor, (2000,))
    for other in (
        PrivacyCell("open_loop", "paper", "none", 0, "true", 0.5, 0.05, 1),
        PrivacyCell("open_loop", "capped", "event", 0, "nominal", 20.0, 0.05, 3),
    ):
        shared = DESIGN.cell("open_loop", boundary_inputs=other.boundary_inputs)
        assert shared in DESIGN.cells()
        scores = [
            run_task(EpisodeTask(SHORT, "paper", cell, cell.keywords, (2000,), None))
            for cell in (other, shared)
        ]
        assert scores[0] == scores[1]


def test_grids_are_sorted_and_hold_the_base_values():
    assert DESIGN.epsilons == (1.0, 5.0, 20.0)
    assert DESIGN.caps == (4, 64)
    assert DESIGN.bandwidths == (1, 2)


def test_quick_is_a_part_of_the_full_design():
    full, part = PrivacyDesign(), PrivacyDesign().quick()
    assert set(part.cells()) < set(full.cells())
    assert set(part.traffic_seeds) < set(full.traffic_seeds)
    n_part, n_full = (len(each.cells()) * len(each.traffic_seeds) for each in (part, full))
    assert n_part < n_full / 8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "2000"}, "seeds must be 2 or more"),
        ({"seeds": "7:9"}, r"test seeds, in 2000\.\.2999.*got 7"),
        ({"estimators": ()}, "estimators must be 1 or more"),
        ({"estimators": ("kf",)}, "estimator must be one of"),
        ({"estimators": ("open_loop",)}, "it is always run"),
        ({"epsilons": (5.0,)}, "epsilons must hold a value beside 5"),
        ({"caps": (64,)}, "caps must hold a value beside 64"),
        ({"bandwidths": ()}, "bandwidths must hold a value beside 2"),
        ({"schedule": "random"}, r"schedule must be one of .*round-robin"),
    ],
)
def test_bad_designs_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(DESIGN, **changes).check()


# What noise is worth


def test_a_vehicle_met_as_often_as_the_cap_has_the_guarantee_s_own_share_of_mu():
    config = config_of(BASE)
    report = privacy_report(config)
    (density, _) = (release.noise_std for release in report.releases)
    # Half of mu^2 goes to density.
    assert mu_met(config, density, 64) == pytest.approx(report.mu * math.sqrt(0.5))
    assert mu_met(config, density, 16) == pytest.approx(mu_met(config, density, 64) / 2.0)


def test_a_guarantee_is_worth_what_it_claims_and_no_vehicle_counts_beyond_the_cap():
    account = make_account(DESIGN, DESIGN.cell("ekf"), (4, 64, 500))
    assert account.claimed == account.composed == pytest.approx(5.0)
    assert account.alone[64] == account.alone[500] == pytest.approx(5.0)
    assert account.alone[4] < 2.0
    assert account.met[4] < account.met[64] == account.met[500] < 5.0
    assert account.void_reasons == ()


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_the_paper_s_noise_is_worth_less_the_more_often_a_vehicle_is_met(preset):
    cell = DESIGN.cell("ekf", Protection(preset), epsilon=1.0)
    account = make_account(DESIGN, cell, (4, 64, 300))
    report = privacy_report(config_of(cell))
    assert account.composed == report.epsilon
    assert (account.density_std, account.second_std) == tuple(r.noise_std for r in report.releases)
    assert account.met[4] < account.met[64] < account.met[300]
    # sqrt(2 C) vehicles on 100 m, by hand.
    by_hand = math.sqrt(2 * 64) / 0.1 / account.density_std
    assert account.met[64] == pytest.approx(epsilon_of(by_hand, 0.05))
    assert account.met[64] < account.alone[64]
    assert "adaptive_queries" in account.void_reasons


def test_a_vehicle_alone_moves_a_mean_speed_by_the_limit():
    config = config_of(DESIGN.cell("ekf", Protection("paper")))
    limit = config.corridor.speed_limit
    assert mu_alone(config, 1e12, 2.0, 9) == pytest.approx(math.sqrt(18.0) * limit / 2.0)
    assert mu_alone(config, 3.0, 2.0, 9) == pytest.approx(
        math.hypot(mu_met(config, 3.0, 9), mu_alone(config, 1e12, 2.0, 9))
    )


class OneRecord(RecordLibrary):
    """A library of a record that a test makes up."""

    def __init__(self, record):
        super().__init__()
        self.record = record

    def get(self, corridor, seed):
        return self.record


def test_trips_count_seconds_where_a_vehicle_can_be_queried():
    corridor = config_of(BASE).corridor
    n = corridor.n_mainline
    record = Record(
        step=np.array([1, 1, 2, 2, 3]),
        vehicle=np.array([0, 1, 0, 2, 0]),
        segment=np.array([0, n, 1, n - 1, n]),  # vehicle 1 is on a ramp alone
        speed=np.zeros(5),
        n_steps=4,
        n_columns=n + 1,
    )
    trips = measure_trips(corridor, 2000, OneRecord(record))
    assert trips.traffic_seed == 2000
    assert sorted(trips.lengths) == [1, 2]


# The report


def score(seed, density, speed):
    return EpisodeScore(seed, density, speed, -0.1, 0.0, 1.0, 0.0)


def made_up(density=lambda cell: 10.0):
    scores = {}
    for cell in DESIGN.cells():
        for k, seed in enumerate(DESIGN.traffic_seeds):
            # Seeds differ by much, cells on one seed by little: what pairing is for.
            scores[cell, seed] = score(seed, density(cell) + 5.0 * k + 0.01 * k**2, 4.0 + k)
    accounts = {
        protection: [
            make_account(DESIGN, cell, (64, 90, 400))
            for cell in DESIGN.along_epsilon("ekf", protection)
        ]
        for protection in (*DESIGN.guaranteed, *DESIGN.printed)
    }
    return PrivacyResults(DESIGN, scores, accounts, np.array([50, 60, 70, 90]), 400)


def priced(cell):
    return {"paper": 8.0, "corrected": 9.0}.get(cell.preset, 11.0)


@pytest.fixture(scope="module")
def results():
    return made_up(priced)


def test_differences_are_paired(results):
    paper = DESIGN.cell("ekf", Protection("paper"))
    assert results.mean(BASE, DENSITY).half_width > 5.0
    difference = results.difference(BASE, paper, DENSITY)
    assert difference.mean == pytest.approx(3.0)
    assert difference.half_width < 1e-9
    assert results.difference(BASE, paper, SPEED).mean == 0.0


def test_the_price_is_in_table_and_numbers(results):
    assert "3.00 [3.00, 3.00]" in cost_table(results, "ekf")
    assert "2.00 [2.00, 2.00]" in cost_table(results, "ekf")
    numbers = study.estimator_numbers(results, "ekf")
    (printed, change), _ = numbers["over_printed"]
    assert printed == Protection("paper")
    assert (change.density.mean, change.speed.mean) == (pytest.approx(3.0), 0.0)


def test_the_open_loop_is_beaten_where_the_numbers_are_lower():
    def saves(cell):
        return 11.0 - (2.0 if cell.estimator == "ekf" and cell.epsilon > 4.0 else 0.0)

    results = made_up(saves)
    ekf, walk = (study.estimator_numbers(results, name) for name in ("ekf", "random_walk"))
    assert (ekf["better_density"], ekf["better_speed"]) == ([5.0, 20.0], [])
    assert (walk["better_density"], walk["better_speed"]) == ([], [])


def test_the_report_holds_every_table_and_number(results):
    provenance = design_provenance(DESIGN)
    content = study.report(results, provenance, "the command")
    text = fill(study.TEMPLATES, content)
    for name in ("claimed", "noise", "modes", "bandwidth", "health"):
        assert getattr(tables, f"{name}_table")(results) in text
    for table in (versions_table(provenance), settings_table(provenance)):
        assert table in text
    for numbers in content["estimators"]:
        assert cost_table(results, numbers["name"]) in text
        for metric in METRICS:
            assert tables.epsilon_table(results, numbers["name"], metric) in text
        for _, change in numbers["over_printed"]:
            assert f"{change.density.mean:+.2f} [{change.density.low:+.2f}, " in text
    assert "the command" in text
    for protection in (*DESIGN.guaranteed, *DESIGN.printed):
        assert f"| {protection} |" in text
    assert "`ekf-paper-capped`" in text


@pytest.mark.parametrize(
    ("interval", "is_certain"),
    [(Interval(1.0, 0.5, 1.5, 3), True), (Interval(-1.0, -2.5, 0.5, 3), False)],
)
def test_a_change_is_marked_where_zero_is_in_its_interval(interval, is_certain, results):
    provenance = design_provenance(DESIGN)
    content = study.report(results, provenance, "the command")
    content["estimators"][0]["cap_change"] = Change(interval, interval)
    lines = fill(study.TEMPLATES, content).splitlines()
    text = f"{interval.mean:+.2f} [{interval.low:+.2f}, {interval.high:+.2f}] km/h"
    (line,) = (line for line in lines if text in line)
    assert line.partition(text)[2].startswith(".") is is_certain


@pytest.mark.parametrize(
    ("value", "text"), [(0.4512, "0.451"), (33.26, "33.3"), (2117.0, "2120"), (408595.2, "408,595")]
)
def test_numbers_have_three_digits_and_no_exponent(value, text):
    assert format_number(value) == text


def test_every_mode_of_every_estimator_is_in_the_table(results):
    rows = modes_table(results).splitlines()[2:]
    assert [row.split(" | ")[:2] for row in rows] == [
        [f"| {name}", mode]
        for name in ("EKF", "random walk", "open loop")
        for mode in BOUNDARY_MODES
    ]


def test_the_summary_has_a_row_for_each_cell(results, tmp_path):
    write_summary(tmp_path / "summary.csv", results)
    with (tmp_path / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(DESIGN.cells())
    row = next(row for row in rows if row["preset"] == "paper" and row["estimator"] == "ekf")
    assert float(row["rmse_density_veh_km"]) == pytest.approx(8.0 + 5.0 + 0.05 / 3.0, rel=1e-5)
    assert float(row["n_diverged"]) == 3.0


def test_figures_show_every_cell(results):
    epsilon, modes = study.draw_epsilon(results), study.draw_modes(results)
    n_protections = len(DESIGN.guaranteed)
    for axis in epsilon.axes:
        assert len(axis.containers) == n_protections
    means = epsilon.axes[0].containers[1].lines[0].get_ydata()
    cells = DESIGN.along_epsilon("ekf", DESIGN.guaranteed[1])
    np.testing.assert_allclose(means, [results.mean(cell, DENSITY).mean for cell in cells])
    assert len(modes.axes[0].containers) == len(DESIGN.all_estimators)
    claimed = study.draw_claimed(results)
    for axis in claimed.axes[1:]:
        assert len(axis.containers) == len(DESIGN.printed) + 1
