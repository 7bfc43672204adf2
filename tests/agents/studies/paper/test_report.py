import csv
import dataclasses

import pytest

from agents.experiments.cells import METRICS
from agents.experiments.old_tables import markdown, settings_table, versions_table, write_summary
from agents.experiments.provenance import design_provenance
from agents.experiments.reports import fill
from agents.statistics import mean_interval
from agents.studies.paper import study
from agents.studies.paper.claims import judge_all
from agents.studies.paper.paper_claims import CLAIMS, PROJECT_TARGETS
from agents.studies.paper.plan import SETTINGS
from agents.studies.paper.tables import (
    base_table,
    grid_table,
    health_table,
    parts_table,
    time_table,
    verdict_table,
)
from tests.agents.studies.paper.made_up import DESIGN, make_up


def error(cell):
    walk = 2.0 if cell.estimator == "random_walk" else 1.0
    return walk * 10.0 * (2.0 - cell.bandwidth / 11.0)


RESULTS = make_up(error, seconds={"ekf": 1e-3, "mhe": 3e-3})


def rows(table):
    """Return the rows of a Markdown table by their first cell."""
    lines = [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]
    return {line[0]: line[1:] for line in lines}


@pytest.fixture(scope="module")
def provenance():
    return design_provenance(DESIGN)


def test_a_markdown_table():
    assert markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | :-: |\n| 1 | 2 |"


def test_the_report_holds_every_table_and_number(provenance, tmp_path):
    content = study.report(RESULTS, provenance, "the command")
    text = fill(study.TEMPLATES, content)
    for metric in METRICS:
        assert base_table(RESULTS, metric) in text
    for table in (time_table, health_table, grid_table):
        assert table(RESULTS) in text
    for claims in (CLAIMS, PROJECT_TARGETS):
        assert verdict_table(judge_all(claims, RESULTS)) in text
    assert versions_table(provenance) in text
    assert settings_table(provenance) in text
    for claim in (*CLAIMS, *PROJECT_TARGETS):
        assert claim.statement in text
        assert claim.quantity in text
    for outcomes in judge_all((*CLAIMS, *PROJECT_TARGETS), RESULTS):
        assert parts_table(outcomes) in text
    for number in ("the command", "2000 to 2005", f"{len(DESIGN.cells())} configurations"):
        assert number in text
    assert "nan" not in text


def test_settings_show_what_an_estimator_reads(provenance):
    table = rows(settings_table(provenance))
    ukf, walk = table["`ukf-paper-paper`"][-1], table["`random_walk-paper-paper`"][-1]
    assert "alpha" in ukf
    assert "n_members" not in ukf
    assert "walk_noise" in walk
    assert "process_noise" not in walk


def test_results_of_two_states_of_the_code_are_marked(provenance):
    texts = [
        fill(study.TEMPLATES, study.report(RESULTS, {**provenance, "sources": sources}, "command"))
        for sources in (["a"], ["a", "b"])
    ]
    plain, marked = (set(text.splitlines()) for text in texts)
    assert "| source of dptse_env | a, b |" in marked
    # A paragraph says so, which is not there otherwise.
    assert len(marked - plain) == 2


def test_a_verdict_table_counts_the_parts_that_hold():
    table = verdict_table(judge_all(CLAIMS, RESULTS)).splitlines()
    assert table[2].count("(4 of 4)") == len(SETTINGS)
    assert table[4].startswith("| P3.")
    assert "(3 of 3)" not in table[4]


def test_a_detail_shows_intervals_and_the_verdict():
    (outcomes,) = judge_all(CLAIMS[:1], RESULTS)
    table = rows(parts_table(outcomes))
    for setting, cell in zip(outcomes, table["EKF"], strict=True):
        interval, verdict = setting.parts["EKF"]
        assert verdict == "holds"
        assert cell == f"{interval.mean:.2f} [{interval.low:.2f}, {interval.high:.2f}] ✓"
    assert table["**verdict**"] == ["**holds**"] * len(SETTINGS)


def test_the_base_table_compares_with_the_random_walk():
    table = rows(base_table(RESULTS, "rmse_density"))
    mean = mean_interval(RESULTS.base("ekf", SETTINGS[0], "rmse_density"))
    assert table["EKF"][0].startswith(f"{mean.mean:.2f} [{mean.low:.2f}, {mean.high:.2f}]; -50.0")
    assert "%" not in table["random walk"][0]


def test_times_are_shown_beside_the_paper_s_and_relative():
    table = rows(time_table(RESULTS))
    assert table["MHE"][:2] == ["45", "0.75"]
    for cell in table["MHE"][2:]:
        assert cell.startswith("3.0")
        assert "; 3.0" in cell
    assert table["random walk"][:2] == ["-", "-"]


def test_lost_seconds_are_counted_over_all_episodes():
    scores = dict(RESULTS.scores)
    for cell in DESIGN.along("epsilon", "mhe", SETTINGS[2])[:2]:
        scores[cell, 2000] = dataclasses.replace(scores[cell, 2000], n_diverged=2.0, n_fallback=5.0)
    table = health_table(dataclasses.replace(RESULTS, scores=scores)).splitlines()
    lost = [line.strip("| ").split(" | ") for line in table if line.startswith("| MHE")]
    assert {line[1]: line[2:] for line in lost} == {
        str(setting): ["4", "10", "0", "54"] if setting == SETTINGS[2] else ["0", "0", "0", "54"]
        for setting in SETTINGS
    }


def test_the_summary_has_a_row_for_each_cell(tmp_path):
    write_summary(tmp_path / "summary.csv", RESULTS)
    with (tmp_path / "summary.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(DESIGN.cells())
    cell = DESIGN.base("ukf", SETTINGS[3])
    fields = {key: str(value) for key, value in dataclasses.asdict(cell).items()}
    (row,) = (row for row in table if fields.items() <= row.items())
    mean = mean_interval(RESULTS.values(cell, "rmse_density"))
    assert float(row["rmse_density_veh_km"]) == pytest.approx(mean.mean, rel=1e-5)
    assert float(row["rmse_density_low"]) == pytest.approx(mean.low, rel=1e-5)
    assert float(row["rmse_speed_high"]) > float(row["rmse_speed_km_h"])
    assert row["n_seeds"] == "6"
