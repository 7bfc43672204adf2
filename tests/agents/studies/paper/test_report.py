import csv
import dataclasses

import pytest

from agents.evaluation.statistics import mean_interval
from agents.experiments.provenance import provenance
from agents.studies.paper.paper_claims import CLAIMS, TARGETS
from agents.studies.paper.plan import SETTINGS
from agents.studies.paper.report import write_report
from agents.studies.paper.tables import (
    base_table,
    detail,
    health_table,
    markdown,
    outcomes,
    time_table,
    verdict_table,
    write_summary,
)
from tests.agents.studies.paper.made_up import DESIGN, make_up


def error(cell):
    walk = 2.0 if cell.estimator == "random_walk" else 1.0
    return walk * 10.0 * (2.0 - cell.bandwidth / 11.0)


MEASURED = make_up(error, seconds={"ekf": 1e-3, "mhe": 3e-3})


def test_a_markdown_table():
    assert markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | :-: |\n| 1 | 2 |"


def test_the_verdicts_of_all_claims_come_first(tmp_path):
    write_report(tmp_path / "REPORT.md", MEASURED, provenance(DESIGN), "the command")
    text = (tmp_path / "REPORT.md").read_text()
    assert text.index("the command") < text.index("| P1.") < text.index("| T1.")
    assert text.index("| T4.") < text.index("## How a verdict is made")
    for claim in (*CLAIMS, *TARGETS):
        assert f"| {claim.key}. {claim.says} |" in text
        assert f"**{claim.key}. {claim.says}**" in text
    for words in ("lost", "MATLAB", "2000 to 2005", "fig5_run_time.png", "process_noise", "numba"):
        assert words in text
    assert "nan" not in text


def test_settings_show_what_an_estimator_reads(tmp_path):
    write_report(tmp_path / "REPORT.md", MEASURED, provenance(DESIGN), "the command")
    lines = (tmp_path / "REPORT.md").read_text().splitlines()
    ukf = next(line for line in lines if line.startswith("| `ukf-paper-paper`"))
    assert "alpha" in ukf
    assert "n_members" not in ukf
    walk = next(line for line in lines if line.startswith("| `random_walk-paper-paper`"))
    assert "walk_noise" in walk
    assert "process_noise" not in walk


def test_results_of_two_states_of_the_code_are_marked(tmp_path):
    origin = provenance(DESIGN)
    texts = []
    for sources in (["a"], ["a", "b"]):
        write_report(tmp_path / "REPORT.md", MEASURED, {**origin, "sources": sources}, "command")
        texts.append((tmp_path / "REPORT.md").read_text())
    assert ["changed while this folder was filled" in text for text in texts] == [False, True]


def test_a_verdict_table_counts_the_parts_that_hold():
    rows = verdict_table(outcomes(CLAIMS, MEASURED)).splitlines()
    assert rows[2].count("**holds** (4 of 4)") == len(SETTINGS)
    assert rows[4].startswith("| P3.")
    assert "holds** (3" not in rows[4]


def test_a_detail_shows_the_rule_the_intervals_and_the_verdict():
    text = detail(outcomes(CLAIMS, MEASURED)["P1"])
    assert "Holds if below 0." in text
    assert text.count("✓") == 16
    assert text.count("**holds**") == len(SETTINGS)


def test_the_base_table_compares_with_the_random_walk():
    rows = {line.split(" | ")[0]: line for line in base_table(MEASURED, "rmse_density").split("\n")}
    own = mean_interval(MEASURED.base("ekf", SETTINGS[0], "rmse_density"))
    assert f"{own.mean:.2f} [{own.low:.2f}, {own.high:.2f}]; -50.0" in rows["| EKF"]
    assert "%" not in rows["| random walk"]


def test_times_are_shown_beside_the_paper_s_and_relative():
    rows = {line.split(" | ")[0]: line for line in time_table(MEASURED).split("\n")}
    assert rows["| MHE"].startswith("| MHE | 45 | 0.75 | 3.0")
    assert rows["| MHE"].count("; 3.0") == len(SETTINGS)
    assert rows["| random walk"].startswith("| random walk | - | - |")


def test_lost_seconds_are_counted_over_all_episodes():
    scores = dict(MEASURED.scores)
    for cell in DESIGN.along("epsilon", "mhe", SETTINGS[2])[:2]:
        scores[cell, 2000] = dataclasses.replace(scores[cell, 2000], n_diverged=2.0, n_fallback=5.0)
    measured = make_up(error)
    measured.scores = scores
    row = next(line for line in health_table(measured).split("\n") if line.startswith("| MHE"))
    assert row.split(" | ")[1:] == [
        "0, 0 (of 54 episodes)", "0, 0 (of 54 episodes)", "4, 10 (of 54 episodes)",
        "0, 0 (of 54 episodes) |",
    ]  # fmt: skip


def test_the_summary_has_a_row_for_each_cell(tmp_path):
    write_summary(tmp_path / "summary.csv", MEASURED)
    with (tmp_path / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(DESIGN.cells())
    cell = DESIGN.base("ukf", SETTINGS[3])
    row = next(
        row for row in rows
        if row["estimator"] == "ukf" and row["privacy"] == "corrected" and row["bandwidth"] == "5"
        and row["parameters"] == "w99-3lane" and row["epsilon"] == "1.0" and row["delta"] == "0.05"
    )  # fmt: skip
    own = mean_interval(MEASURED.values(cell, "rmse_density"))
    assert float(row["rmse_density_veh_km"]) == pytest.approx(own.mean, rel=1e-5)
    assert float(row["rmse_density_low"]) == pytest.approx(own.low, rel=1e-5)
    assert float(row["rmse_speed_high"]) > float(row["rmse_speed_km_h"])
    assert row["n_seeds"] == "6"
