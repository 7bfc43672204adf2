"""Recorded studies: every cell was played, and tables and figures are those of the rows."""

import importlib
import shutil

import pytest

from agents.executors import this_process
from agents.study import Place, read_rows, write_report

NAMES = ["estimators", "guarantees", "paper", "roads", "suite"]


def study(name):
    return importlib.import_module(f"agents.studies.{name}").STUDY


@pytest.mark.parametrize("name", NAMES)
def test_every_cell_was_played(name, results, tmp_path):
    rows = read_rows(name, results / name)
    follow = study(name).follow
    cells = [*study(name).cells, *(follow(rows, Place(tmp_path, this_process)) if follow else ())]
    played = dict(rows.group_by("cell").agg("traffic_seed").iter_rows())
    assert all(set(study(name).seeds_of(cell)) <= set(played[cell.id]) for cell in cells)
    for file in tmp_path.iterdir():
        assert file.read_bytes() == (results / name / file.name).read_bytes()


def leave(figure, path, title):
    """Leave an empty file, without the seconds that drawing takes."""
    path.touch()


@pytest.mark.parametrize("name", NAMES)
def test_tables_and_figures_are_those_of_the_rows(name, results, tmp_path, monkeypatch):
    for module in ("agents.figures", "agents.studies.suite"):
        monkeypatch.setattr(f"{module}.save_figure", leave)
    read = shutil.ignore_patterns("*.md", "*.png")
    shutil.copytree(results / name, tmp_path, ignore=read, dirs_exist_ok=True)
    write_report(study(name), tmp_path)
    tables = (tmp_path / "tables.md").read_text(encoding="utf-8")
    assert tables == (results / name / "tables.md").read_text(encoding="utf-8")
    shown = {path.name: path.stat().st_size for path in (results / name).glob("*.png")}
    assert shown.keys() == {path.name for path in tmp_path.glob("*.png")}
    assert max(shown.values()) < 300_000
