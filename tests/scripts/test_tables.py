"""Tables of every command are printed with all their numbers whole, however narrow."""

import json

import pytest
from rich.console import Console

from agents import terminal
from agents.terminal import make_table, print_table
from scripts import audit, calibrate, evaluate, tune

SHORT = "dptse_env:dptse/ShortHighway-v0"


def evaluation(folder):
    evaluate.main(
        evaluate.Args(
            env=SHORT, schedules=("largest-density-variance", "round-robin"),
            estimators=("random_walk",), seeds="2000:2002", output=folder, workers=1,
        )
    )  # fmt: skip
    for row in json.loads((folder / "summary.json").read_text())["rows"]:
        yield row["policy"]
        for metric in ("rmse_density", "rmse_speed"):
            for sign, part in (("", "mean"), ("+", "difference")):
                interval = row[part][metric]
                if part == "mean" or row["policy"] != "paper":
                    yield f"{interval['mean']:{sign}.2f}"
                    yield f"{(interval['high'] - interval['low']) / 2:.2f}"


def tuning(folder):
    tune.main(
        tune.Args(
            env=SHORT, estimators=("random_walk",), parameters=("paper",), seeds="0:2", trials=3,
            output=folder,
        )
    )  # fmt: skip
    content = json.loads((folder / "random_walk-paper-paper.json").read_text())["provenance"]
    for scores in (content, content["defaults"]):
        yield f"{scores['score']:.5f}"
        yield f"{scores['rmse_density']:.2f}"
        yield f"{scores['rmse_speed']:.2f}"
    yield "random_walk-paper-paper"


def calibration(folder):
    calibrate.main(
        calibrate.Args(
            corridor="short-highway", train="0:1", held_out="1000:1001", max_evaluations=3,
            workers=1, output=folder,
        )
    )  # fmt: skip
    content = json.loads((folder / "fitted.json").read_text())["provenance"]
    for name, error in content["held_out_errors"].items():
        yield name
        for density, speed in zip(error["density"], error["speed"], strict=True):
            yield f"{density:.1f}"
            yield f"{speed:.1f}"


def an_audit(folder):
    audit.main(audit.Args(env=SHORT, privacy="capped", cap=16, runs=20, output=folder))
    (path,) = folder.iterdir()
    result = json.loads(path.read_text())["result"]
    for name in ("mu", "epsilon"):
        yield f"{result['claim'][name]:.3f}"
        for key in ("value", "threshold", "false_positives", "false_negatives"):
            digits = {"value": 3, "threshold": 2}.get(key, 4)
            yield f"{result[name][key]:.{digits}f}"


@pytest.mark.parametrize("table", [evaluation, tuning, calibration, an_audit])
def test_every_number_is_printed_whole_at_60_columns(table, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    expected = list(table(tmp_path / "out"))
    printed = capsys.readouterr().out
    assert "…" not in printed
    words = set(printed.split())
    for text in expected:
        assert text in words, text


ROWS = (
    ("largest-density-variance", "14.38 ± 0.27", "-1234.56 ± 7.89"),
    ("paper", "9.10 ± 12.34", "-"),
)


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_a_narrow_terminal_wraps_between_numbers(width, capsys, monkeypatch):
    monkeypatch.setattr(
        terminal, "Console", lambda: Console(force_terminal=True, width=width, color_system=None)
    )
    table = make_table("a title", "policy", "density RMSE", "against\nlargest-density-variance")
    for row in ROWS:
        table.add_row(*row)
    print_table(table)
    printed = capsys.readouterr().out
    assert "…" not in printed
    words = printed.split()
    for row in ROWS:
        for cell in row:
            for word in cell.split():
                assert word in words
    if width == 200:
        assert all(cell in printed for row in ROWS for cell in row)


def test_a_pipe_takes_the_width_that_a_table_needs(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    table = make_table("", "policy", "density RMSE", "against\nlargest-density-variance")
    for row in ROWS:
        table.add_row(*row)
    print_table(table)
    printed = capsys.readouterr().out
    assert all(cell in printed for row in ROWS for cell in row)
    assert "largest-density-variance" in printed


def test_a_table_may_be_empty(capsys):
    print_table(make_table("title", "policy", "error"))
    assert "error" in capsys.readouterr().out
