import csv
import dataclasses

import numpy as np
import pytest

from agents.experiments.old_tables import versions_table
from agents.experiments.reports import fill
from agents.studies.policies import study, tables
from agents.studies.policies.curves import read_curves
from agents.studies.policies.manifest import find_checkpoints
from agents.studies.policies.queries import by_offset, by_segment, near_since_start
from agents.studies.policies.tables import ranking, write_summary
from tests.agents.policies import save
from tests.agents.studies.policies.worlds import SMALL, checkpoints, made_up, queries

PROVENANCE = {
    "sources": ["a", "b"], "machine": {}, "made_with": {"cells": {"primary": {"versions": {}}}},
}  # fmt: skip


def test_the_report_holds_every_table_and_number(tmp_path):
    results = made_up(runs_below=(10.0, 10.0, 7.0, 10.0, 10.0))
    study.draw(tmp_path, results)
    content = study.report(tmp_path, results, PROVENANCE)
    best, paper = content["verdicts"]
    assert (best.is_met, paper.is_met, best.worst_seed) == (False, True, 2)
    assert (best.overall.mean, paper.overall.mean) == (pytest.approx(9.4), pytest.approx(24.5))
    assert content["learned"]["progress"].mean == pytest.approx(47.0)
    assert len(results.comparisons) == 2
    text = fill(study.TEMPLATES, content)
    assert tables.verdict_table(content["verdicts"]) in text
    for name in ("choice", "secondary", "checkpoint", "tuned"):
        assert getattr(tables, f"{name}_table")(results) in text, name
    for cell in results.design.cells:
        assert tables.ranking_table(results, cell.name) in text
    assert versions_table(PROVENANCE) in text
    for words in (
        tables.seeds_table(results, results.primary),
        f"{paper.overall.mean:.1f} % [{paper.overall.low:.1f}",
        "python scripts/study.py policies freeze", "no plan", "plackett-luce, from primary",
    ):  # fmt: skip
        assert words in text, words
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert pictures == {"fig_ladder.png", "fig_cells.png", "fig_curves.png", "fig_queries.png"}
    assert all(f"({name})" in text for name in pictures)


def test_the_command_of_an_earlier_manifest_is_shown_as_it_is_now():
    results = made_up()
    manifest = dataclasses.replace(
        results.manifest, command="python scripts/policy_study.py freeze --quick"
    )
    content = study.report(
        study.TEMPLATES, dataclasses.replace(results, manifest=manifest), PROVENANCE
    )
    assert content["freeze_command"] == "python scripts/study.py policies freeze --quick"


def test_the_summary_has_a_row_for_each_policy_of_a_cell(tmp_path):
    results = made_up(runs_below=(10.0, 10.0, 7.0, 10.0, 10.0))
    write_summary(tmp_path / "summary.csv", results)
    with (tmp_path / "summary.csv").open() as file:
        rows = {(row["cell"], row["policy"]): row for row in csv.DictReader(file)}
    assert float(rows["primary", "plackett-luce"]["percent_below_best"]) == pytest.approx(9.4)
    assert rows["primary", "plackett-luce"]["n_training_seeds"] == "5"
    assert float(rows["primary", "oracle-error"]["percent_below_best"]) == pytest.approx(20.0)


def test_a_report_without_a_trained_policy_has_no_verdict(tmp_path):
    results = made_up(runs_below=(), counts_queries=False)
    choices = {
        name: dataclasses.replace(choice, learners={})
        for name, choice in results.manifest.choices.items()
    }
    manifest = dataclasses.replace(results.manifest, choices=choices)
    results = dataclasses.replace(
        results, manifest=manifest, curves=(),
        queries={key: queries(key[1]) for key in results.scores if key[0].cell == "primary"},
    )  # fmt: skip
    study.draw(tmp_path, results)
    content = study.report(tmp_path, results, PROVENANCE)
    assert (content["verdicts"], content["learned"], results.comparisons) == ([], None, [])
    text = fill(study.TEMPLATES, content)
    assert "plackett-luce" not in text
    # Without learning curves there is no figure, and none is named.
    assert "fig_curves.png" not in text
    assert not (tmp_path / "fig_curves.png").exists()


def test_learning_curves_that_are_gone_leave_their_figure(tmp_path):
    results = made_up()
    study.draw(tmp_path, results)
    before = (tmp_path / "fig_curves.png").read_bytes()
    gone = dataclasses.replace(results, curves=())
    study.draw(tmp_path, gone)
    assert (tmp_path / "fig_curves.png").read_bytes() == before
    assert "fig_curves.png" in fill(study.TEMPLATES, study.report(tmp_path, gone, PROVENANCE))


def test_the_ranking_is_sorted_and_names_transfers():
    labels = [rank.label for rank in ranking(made_up(), "primary")]
    assert labels == [
        "oracle-error", "plackett-luce", "plackett-luce (drawn)", "oldest-first", "paper",
    ]  # fmt: skip
    assert "plackett-luce, from primary" in {rank.label for rank in ranking(made_up(), "moved")}


def test_shares_of_queries():
    episodes = [queries(2000), dataclasses.replace(queries(2001), incident=-1)]
    np.testing.assert_allclose(by_segment(episodes[:1]), np.array([7, 7, 16, 16, 7, 7]) / 240)
    offsets, shares = by_offset(episodes, "during")
    np.testing.assert_array_equal(offsets, np.arange(-3, 3))
    np.testing.assert_allclose(shares, np.array([6, 5, 4, 3, 2, 1]) / 100)
    times, near = near_since_start(episodes, range(-240, 361, 20))
    np.testing.assert_allclose(times, np.arange(-50, 181, 20))
    np.testing.assert_allclose(near, 7 / (60 / 240 * 20))


def test_curves_are_read_where_a_run_has_one(runs, tmp_path):
    curves = read_curves(checkpoints(runs), "primary")
    assert [curve.training_seed for curve in curves] == [0, 1]
    assert curves[0].steps == (0.0, 100.0)
    assert curves[0].errors == pytest.approx((300.0, 200.0))
    assert read_curves(checkpoints(runs), "other") == []
    # The last policy of a run, under another name, has no other curve.
    again = [dataclasses.replace(each, recipe="last") for each in checkpoints(runs)]
    assert read_curves([*checkpoints(runs), *again], "primary") == curves
    save(tmp_path / "best.zip")
    (tmp_path / "progress.csv").write_text("steps,loss\n1,2\n")
    (checkpoint,) = find_checkpoints((f"primary={tmp_path}",), SMALL)
    with pytest.raises(ValueError, match="is no learning curve"):
        read_curves((checkpoint,), "primary")
