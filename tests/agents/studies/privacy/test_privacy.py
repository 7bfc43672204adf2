import csv
import dataclasses
import math

import numpy as np
import pytest
from PIL import Image

from agents.evaluation.episodes import EpisodeScore
from agents.evaluation.statistics import Interval
from agents.experiments.provenance import provenance
from agents.experiments.runner import Task, make_env, run_task
from agents.studies.privacy import report
from agents.studies.privacy.account import account_of, mu_alone, mu_met, trip_lengths
from agents.studies.privacy.plan import (
    BOUNDARY_MODES,
    PrivacyCell,
    PrivacyDesign,
    Protection,
    quick,
)
from agents.studies.privacy.results import DENSITY, SPEED, PrivacyResults
from agents.studies.privacy.tables import cost_table, modes_table, number, write_summary
from dptse_env.config import resolve
from dptse_env.privacy import epsilon_of
from dptse_env.traffic import Corridor, RecordLibrary
from dptse_env.traffic.record import Record

SHORT = "dptse_env:dptse/ShortHighway-v0"
DESIGN = PrivacyDesign(
    seeds=(2000, 2001, 2002),
    epsilons=(1.0, 20.0),
    caps=(4,),
    bandwidths=(1,),
    bandwidth=2,
    env=SHORT,
)
BASE = DESIGN.cell("ekf")


def config_of(cell):
    return make_env(SHORT, cell, DESIGN.seeds, None).unwrapped.config


# What is run


def test_the_full_design_holds_what_the_study_is_about():
    design = PrivacyDesign()
    assert len(design.seeds) >= 20
    cells = set(design.cells())
    for name in ("ekf", "random_walk"):
        for epsilon in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0):
            for cap in (4, 16, 64):
                own = PrivacyCell(name, "guaranteed", "trip", cap, "nominal", epsilon, 0.05, 5)
                assert own in cells
            for unit in ("horizon", "event"):
                assert (
                    PrivacyCell(name, "guaranteed", unit, 0, "nominal", epsilon, 0.05, 5) in cells
                )
            for preset in ("paper", "corrected"):
                assert PrivacyCell(name, preset, "none", 0, "true", epsilon, 0.05, 5) in cells
        for mode in ("true", "nominal", "private"):
            assert PrivacyCell(name, "guaranteed", "trip", 64, mode, 5.0, 0.05, 5) in cells
        for bandwidth in (3, 5, 8, 15):
            own = PrivacyCell(name, "guaranteed", "trip", 64, "nominal", 5.0, 0.05, bandwidth)
            assert own in cells


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
    assert (privacy.contribution_cap or 0) == cell.cap
    if cell.preset == "guaranteed":
        assert privacy.unit == cell.unit


def test_the_open_loop_hears_nothing_that_its_shared_cell_leaves_out():
    RecordLibrary().ensure(resolve("short-highway", {}).corridor, (2000,))
    for other in (
        PrivacyCell("open_loop", "paper", "none", 0, "true", 0.5, 0.05, 1),
        PrivacyCell("open_loop", "guaranteed", "event", 0, "nominal", 20.0, 0.05, 3),
    ):
        shared = DESIGN.cell("open_loop", boundary_inputs=other.boundary_inputs)
        assert shared in DESIGN.cells()
        own, same = (
            run_task(Task(SHORT, "paper", cell, (2000,), None)) for cell in (other, shared)
        )
        assert own == same


def test_grids_are_sorted_and_hold_the_base_values():
    assert DESIGN.epsilons == (1.0, 5.0, 20.0)
    assert DESIGN.caps == (4, 64)
    assert DESIGN.bandwidths == (1, 2)


def test_quick_is_a_part_of_the_full_design():
    full, part = PrivacyDesign(), quick(PrivacyDesign())
    assert set(part.cells()) < set(full.cells())
    assert set(part.seeds) < set(full.seeds)
    assert len(part.cells()) * len(part.seeds) < len(full.cells()) * len(full.seeds) / 8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": (2000,)}, "seeds must be 2 or more"),
        ({"seeds": (2000, 2000)}, "distinct"),
        ({"seeds": (7, 2000)}, r"held out, in 2000\.\.2999.*got 7"),
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
        dataclasses.replace(DESIGN, **changes)


# What noise is worth


def test_a_vehicle_met_as_often_as_the_cap_has_the_guarantee_s_own_share_of_mu():
    config = config_of(BASE)
    (density, _) = (own.noise_std for own in config.accountant().report.releases)
    # Half of mu^2 goes to density.
    assert mu_met(config, density, 64) == pytest.approx(
        config.accountant().report.mu * math.sqrt(0.5)
    )
    assert mu_met(config, density, 16) == pytest.approx(mu_met(config, density, 64) / 2.0)


def test_a_guarantee_is_worth_what_it_claims_and_no_vehicle_counts_beyond_the_cap():
    own = account_of(SHORT, DESIGN.cell("ekf"), DESIGN.seeds, (4, 64, 500))
    assert own.claimed == own.composed == pytest.approx(5.0)
    assert own.alone[64] == own.alone[500] == pytest.approx(5.0)
    assert own.alone[4] < 2.0
    assert own.met[4] < own.met[64] == own.met[500] < 5.0
    assert own.void_reasons == ()


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_the_paper_s_noise_is_worth_less_the_more_often_a_vehicle_is_met(preset):
    cell = DESIGN.cell("ekf", Protection(preset), epsilon=1.0)
    own = account_of(SHORT, cell, DESIGN.seeds, (4, 64, 300))
    report = config_of(cell).accountant().report
    assert own.composed == report.epsilon
    assert (own.density_std, own.second_std) == tuple(r.noise_std for r in report.releases)
    assert own.met[4] < own.met[64] < own.met[300]
    # sqrt(2 C) vehicles on 100 m, by hand.
    by_hand = math.sqrt(2 * 64) / 0.1 / own.density_std
    assert own.met[64] == pytest.approx(epsilon_of(by_hand, 0.05))
    assert own.met[64] < own.alone[64]
    assert "adaptive_queries" in own.void_reasons


def test_a_vehicle_alone_moves_a_mean_speed_by_the_limit():
    config = config_of(DESIGN.cell("ekf", Protection("paper")))
    limit = config.corridor.speed_limit
    assert mu_alone(config, 1e12, 2.0, 9) == pytest.approx(math.sqrt(18.0) * limit / 2.0)
    assert mu_alone(config, 3.0, 2.0, 9) == pytest.approx(
        math.hypot(mu_met(config, 3.0, 9), mu_alone(config, 1e12, 2.0, 9))
    )


def test_trips_count_seconds_where_a_vehicle_can_be_queried(monkeypatch):
    corridor: Corridor = config_of(BASE).corridor
    n = corridor.n_mainline
    record = Record(
        step=np.array([1, 1, 2, 2, 3]),
        vehicle=np.array([0, 1, 0, 2, 0]),
        segment=np.array([0, n, 1, n - 1, n]),  # vehicle 1 is on a ramp alone
        speed=np.zeros(5),
        n_steps=4,
        n_columns=n + 1,
    )
    monkeypatch.setattr(RecordLibrary, "get", lambda *_: record)
    assert sorted(trip_lengths(corridor, (2000, 2001), None)) == [1, 1, 2, 2]


# What is said


def score(seed, density, speed):
    return EpisodeScore(seed, density, speed, -0.1, 0.0, 1.0, 0.0)


def made_up(density=lambda cell: 10.0):
    scores = {}
    for cell in DESIGN.cells():
        for k, seed in enumerate(DESIGN.seeds):
            # Seeds differ by much, cells on one seed by little: what pairing is for.
            scores[cell, seed] = score(seed, density(cell) + 5.0 * k + 0.01 * k**2, 4.0 + k)
    accounts = {
        protection: [
            account_of(SHORT, cell, DESIGN.seeds, (64, 90, 400))
            for cell in DESIGN.along_epsilon("ekf", protection)
        ]
        for protection in (*DESIGN.guaranteed, *DESIGN.printed)
    }
    return PrivacyResults(DESIGN, scores, accounts, np.array([50, 60, 70, 90]), 400)


def priced(cell):
    return {"paper": 8.0, "corrected": 9.0}.get(cell.preset, 11.0)


@pytest.fixture(scope="module")
def measured():
    return made_up(priced)


def test_differences_are_paired(measured):
    paper = DESIGN.cell("ekf", Protection("paper"))
    assert measured.mean(BASE, DENSITY).half_width > 5.0
    difference = measured.difference(BASE, paper, DENSITY)
    assert difference.mean == pytest.approx(3.0)
    assert difference.half_width < 1e-9
    assert measured.difference(BASE, paper, SPEED).mean == 0.0


def test_the_price_is_in_table_and_sentence(measured):
    assert "3.00 [3.00, 3.00]" in cost_table(measured, "ekf")
    assert "2.00 [2.00, 2.00]" in cost_table(measured, "ekf")
    first = next(iter(report.sentences(measured)))
    assert "density +3.00 [+3.00, +3.00] veh/km, speed unchanged" in first
    assert "guarantee of ε = 5 (trip, C = 64)" in first


def test_sentences_follow_the_numbers():
    def saves(cell):
        return 11.0 - (2.0 if cell.estimator == "ekf" and cell.epsilon > 4.0 else 0.0)

    text = "\n".join(report.sentences(made_up(saves)))
    assert "density at ε = 5, 20; speed at none" in text
    assert "random walk with a guarantee (trip, C = 64) errs less" in text
    assert "zero: density at none" in text


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (Interval(1.0, 0.5, 1.5, 3), "+1.00 [+0.50, +1.50] km/h"),
        (Interval(-1.0, -2.5, 0.5, 3), "-1.00 [-2.50, +0.50] km/h (not told from 0)"),
        (Interval(0.0, 0.0, 0.0, 3), "unchanged to the last digit [km/h]"),
    ],
)
def test_a_change_says_whether_it_can_be_told_from_zero(interval, text):
    assert report.change(interval, "km/h") == text


@pytest.mark.parametrize(
    ("value", "text"), [(0.4512, "0.451"), (33.26, "33.3"), (2117.0, "2120"), (408595.2, "408,595")]
)
def test_numbers_have_three_digits_and_no_exponent(value, text):
    assert number(value) == text


def test_every_mode_of_every_estimator_is_in_the_table(measured):
    rows = modes_table(measured).splitlines()[2:]
    assert [row.split(" | ")[:2] for row in rows] == [
        [f"| {name}", mode]
        for name in ("EKF", "random walk", "open loop")
        for mode in BOUNDARY_MODES
    ]


def test_the_summary_has_a_row_for_each_cell(measured, tmp_path):
    write_summary(tmp_path / "summary.csv", measured)
    with (tmp_path / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(DESIGN.cells())
    own = next(row for row in rows if row["preset"] == "paper" and row["estimator"] == "ekf")
    assert float(own["rmse_density_veh_km"]) == pytest.approx(8.0 + 5.0 + 0.05 / 3.0, rel=1e-5)
    assert float(own["n_diverged"]) == 3.0


def test_figures_and_report_stand_by_themselves(measured, tmp_path):
    report.draw(tmp_path, measured)
    report.write_report(tmp_path / "REPORT.md", measured, provenance(DESIGN), "the command")
    text = (tmp_path / "REPORT.md").read_text()
    assert "the command" in text
    for name in report.CAPTIONS:
        assert f"({name})" in text
        with Image.open(tmp_path / name) as image:
            # Something is drawn: neither one colour nor the few of an empty frame.
            assert len(image.convert("RGB").getcolors(maxcolors=2**20)) > 100
    for protection in (*DESIGN.guaranteed, *DESIGN.printed):
        assert f"| {protection} |" in text
    assert "`ekf-paper-guaranteed`" in text
