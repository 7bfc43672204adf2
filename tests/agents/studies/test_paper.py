from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from agents.executors import this_process
from agents.statistics import Interval
from agents.studies import paper
from agents.studies.paper import CELLS, SETTINGS, STUDY, judge, tables_of, with_times
from agents.study import Place, read_rows, read_table, run


@pytest.fixture(scope="module")
def rows(results):
    return read_rows("paper", results / "paper")


@pytest.fixture(scope="module")
def times(results):
    return read_table(results / "paper" / paper.RUN_TIME)


def entries(text, first):
    """Return the entries of the first table row that begins so."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {first}"))
    return line.strip("| ").split(" | ")[1:]


@pytest.mark.parametrize(
    ("estimator", "column", "factor", "claim", "verdict"),
    [
        ("ukf", "rmse_density", 2.0, "P3.", "does not hold (0 of 3)"),
        pytest.param("ekf", "seconds", 1e3, "P20.", "holds (3 of 3)", marks=pytest.mark.slow),
    ],
)
def test_a_verdict_follows_what_was_measured(
    rows, times, estimator, column, factor, claim, verdict
):
    changed = pl.when(pl.col("estimator") == estimator).then(factor).otherwise(1.0)
    if column == "seconds":
        times = times.with_columns(pl.col(column) * changed)
    else:
        rows = rows.with_columns(pl.col(column) * changed)
    assert entries(tables_of(with_times(rows, times)), claim) == [verdict] * 4


def test_what_was_not_played_is_a_dash(rows, times):
    mhe = (pl.col("estimator") == "mhe") & (pl.col("privacy") == "printed")
    text = tables_of(with_times(rows.filter(~mhe), times.clear()))
    assert entries(text, "P10.") == ["-", "-", *["does not hold (0 of 2)"] * 2]
    assert entries(text, "P16.")[3] == "holds (4 of 4)"
    assert entries(text, "P20.") == ["-"] * 4


def test_a_part_is_undecided_where_its_interval_has_an_end_of_the_range():
    ends = [(-0.5, 0.5), (-1.5, 0.5), (0.5, 1.5), (1.1, 1.5), (-3.0, -1.2)]
    verdicts = [judge(Interval(0.0, low, high, 5), -1.0, 1.0) for low, high in ends]
    assert verdicts == [paper.HOLDS, paper.OPEN, paper.OPEN, paper.FAILS, paper.FAILS]


def test_statistics_of_curves():
    noise = np.random.default_rng(0).normal(scale=1e-3, size=(7, 6))
    line = 20.0 - 0.5 * np.arange(7.0)[:, None] + noise
    zigzag = line + np.array([1.0, -1.0] * 3 + [1.0])[:, None]
    for statistic, curves, expected in (
        (paper.SLOPE, (line,), -0.5),
        (paper.GAP, (line + 2.0, line), 2.0),
        (paper.EXCESS, (1.2 * line, line), 20.0),
        (paper.ROUGHNESS, (zigzag, line), 4.0),
        (paper.FALL, (2.0 * line, line), 3.0),
        (paper.CORRELATION, (line, 3.0 * line + 1.0), 1.0),
        (paper.RATIO, (2.0 * line, line), 2.0),
        (paper.growth("bandwidth", 5, 11), (line,), 100.0 * 3.0 / 17.0),
    ):
        assert statistic.measure(*curves).mean == pytest.approx(expected, abs=0.02)


@pytest.mark.slow
def test_two_cells_are_played_measured_and_reported(results, tmp_path, monkeypatch):
    first, second, *_ = SETTINGS
    monkeypatch.setattr(paper, "PAIRS", [("random_walk", first)])
    monkeypatch.setattr(paper, "N_TIMED", 2)
    base = [paper.labels_of("random_walk", setting) for setting in (first, second)]
    cells = tuple(cell for cell in CELLS if cell.labels in base)
    place = Place(tmp_path, this_process)
    run(replace(STUDY, cells=cells, seeds=(2000, 2001)), place)
    text = (tmp_path / "tables.md").read_text("utf-8")
    assert ["[" in each for each in entries(text, "random walk")] == [True, True, False, False]
    assert read_table(tmp_path / paper.RUN_TIME)["seconds"].min() > 0.0
    maps = read_table(tmp_path / paper.SPACE_TIME)
    assert np.shape(maps["estimate"].to_list()) == (1, 141, 15)
    assert maps.columns == read_table(results / "paper" / paper.SPACE_TIME).columns
    assert not list(tmp_path.glob("*.png"))
