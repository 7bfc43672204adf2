import csv
import dataclasses

import numpy as np
import pytest
from agents.studies.policies.report import draw, write_report
from PIL import Image

from agents.studies.policies import figures, tables
from agents.studies.policies.curves import read_curves
from agents.studies.policies.manifest import (
    find_checkpoints,
)
from tests.agents.policies import save
from tests.agents.studies.policies.worlds import SMALL, asked, checkpoints, made_up


def test_the_report_says_what_was_found(tmp_path):
    measured = made_up(runs_below=(10.0, 10.0, 7.0, 10.0, 10.0))
    draw(tmp_path, measured)
    origin = {
        "sources": ["a", "b"], "machine": {}, "made_with": {"cells": {"primary": {"versions": {}}}},
    }  # fmt: skip
    write_report(tmp_path / "REPORT.md", measured, origin)
    text = (tmp_path / "REPORT.md").read_text()
    for words in (
        "| **missed** | 9.40 [", "| **met** | 24.50 [", "(seed 2)", "no plan",
        "python scripts/policy_study.py freeze", "plackett-luce, from primary",
        "47.0 % [", "The code of dptse_env changed", "Holm's over 2 comparisons",
    ):  # fmt: skip
        assert words in text, words
    names = {path.name for path in tmp_path.glob("*.png")}
    assert names == {"fig_ladder.png", "fig_cells.png", "fig_curves.png", "fig_asked.png"}
    for name in names:
        assert f"({name})" in text
        with Image.open(tmp_path / name) as image:
            assert min(image.size) > 200
    with (tmp_path / "summary.csv").open() as file:
        rows = {(row["cell"], row["policy"]): row for row in csv.DictReader(file)}
    assert float(rows["primary", "plackett-luce"]["percent_below_best"]) == pytest.approx(9.4)
    assert rows["primary", "plackett-luce"]["n_training_seeds"] == "5"
    assert float(rows["primary", "oracle-error"]["percent_below_best"]) == pytest.approx(20.0)


def test_without_a_trained_policy_the_report_says_so(tmp_path):
    measured = made_up(runs_below=(), asks=False)
    choices = {
        name: dataclasses.replace(own, learners={})
        for name, own in measured.manifest.choices.items()
    }
    manifest = dataclasses.replace(measured.manifest, choices=choices)
    measured = dataclasses.replace(
        measured, manifest=manifest, curves=(),
        asked={key: asked(key[1]) for key in measured.scores if key[0].cell == "primary"},
    )  # fmt: skip
    draw(tmp_path, measured)
    origin = {"sources": ["a"], "machine": {}, "made_with": {"cells": {"p": {"versions": {}}}}}
    write_report(tmp_path / "REPORT.md", measured, origin)
    text = (tmp_path / "REPORT.md").read_text()
    assert "**Missed**: no trained policy was frozen" in text
    assert "No learned policy was frozen for a secondary cell" in text


def test_the_ladder_is_sorted_and_names_who_moved():
    labels = [rung.label for rung in tables.ladder(made_up(), "primary")]
    assert labels == [
        "oracle-error", "plackett-luce", "plackett-luce (drawn)", "oldest-first", "paper",
    ]  # fmt: skip
    assert "plackett-luce, from primary" in {
        rung.label for rung in tables.ladder(made_up(), "moved")
    }


def test_shares_of_queries():
    own = [asked(2000), dataclasses.replace(asked(2001), incident=-1)]
    np.testing.assert_allclose(figures.by_segment(own[:1]), np.array([7, 7, 16, 16, 7, 7]) / 240)
    offsets, shares = figures.by_offset(own, "during")
    np.testing.assert_array_equal(offsets, np.arange(-3, 3))
    np.testing.assert_allclose(shares, np.array([6, 5, 4, 3, 2, 1]) / 100)
    times, near = figures.near_since_start(own)
    np.testing.assert_allclose(times, np.arange(-50, 181, 20))
    np.testing.assert_allclose(near, 7 / (60 / 240 * 20))


def test_curves_are_read_where_a_run_has_one(runs, tmp_path):
    curves = read_curves(checkpoints(runs), "primary")
    assert [curve.training_seed for curve in curves] == [0, 1]
    assert curves[0].steps == (0.0, 100.0)
    assert curves[0].errors == pytest.approx((300.0, 200.0))
    assert read_curves(checkpoints(runs), "other") == []
    # The last policy of a run, under a name of its own, has no other curve.
    again = [dataclasses.replace(own, recipe="last") for own in checkpoints(runs)]
    assert read_curves([*checkpoints(runs), *again], "primary") == curves
    save(tmp_path / "best.zip")
    (tmp_path / "progress.csv").write_text("steps,loss\n1,2\n")
    (own,) = find_checkpoints((f"primary={tmp_path}",), SMALL)
    with pytest.raises(ValueError, match="is no learning curve"):
        read_curves((own,), "primary")
