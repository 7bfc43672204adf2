import json
import re
from dataclasses import replace

import polars as pl
import pytest

from agents.executors import this_process
from agents.studies.suite import RECORDED
from agents.study import Place, read_rows
from dptse_env.config import VALIDATION_SEEDS
from examples.my_study import STUDY
from scripts.study import Args, find_study, main
from tests.scripts.commands import run_command

MINE, SHORT = "examples.my_study:STUDY", STUDY.cells[0].env
FIRST = replace(STUDY.cells[0], keywords={**STUDY.cells[0].keywords, "corridor": "paper-highway"})
MANY = replace(STUDY.cells[0], keywords={**STUDY.cells[0].keywords, "bandwidth": 15})
WIDE = replace(STUDY, cells=(MANY, *STUDY.cells[1:]), measures={"trips.parquet": lambda _: None})
MIXED = (FIRST, *STUDY.cells[1:])
ROADS = replace(STUDY, cells=MIXED, follow=lambda rows, folder: MIXED)


def numbered(number):
    return number and replace(STUDY, seeds=tuple(range(2000, 2000 + number)))


def test_the_cells_of_an_environment_are_played_with_its_keywords_and_others_are_told(capsys):
    env = 'dptse/ShortHighway-v0 {"corridor": {"n_mainline": 6}}'
    study = find_study(Args(name=f"{__name__}:WIDE", env=(env,)))
    assert [cell.keywords["bandwidth"] for cell in study.cells] == [2, 3, 1, 2, 3]
    assert all(cell.keywords["corridor"] == {"n_mainline": 6} for cell in study.cells)
    assert {cell.id for cell in study.cells}.isdisjoint(cell.id for cell in STUDY.cells)
    assert "1 of 6 cells do not suit" in capsys.readouterr().err
    # A label would not say what was played.
    study = find_study(Args(name=f"{__name__}:ROADS", env=(env,)))
    assert [cell.labels["bandwidth"] for cell in study.cells] == [2, 3, 1, 2, 3]
    assert "5 of 6 cells" in capsys.readouterr().err
    assert study.follow(None, None) == list(study.cells)


def test_seeds_and_environments_can_be_others_with_an_output_of_their_own():
    of_four = f'{__name__}:numbered {{"number": 4}}'
    for changes in ({"test_seeds": "2900:2902"}, {"env": (SHORT,)}, {"name": of_four}):
        with pytest.raises(ValueError, match="given with an output of its own"):
            main(Args(**{"name": MINE, **changes}))
    assert find_study(Args(name=of_four)).seeds == (2000, 2001, 2002, 2003)
    assert find_study(Args(name=f"{__name__}:WIDE")).measures
    study = find_study(Args(name=f"{__name__}:WIDE", test_seeds="2900:2902", env=(SHORT,)))
    assert (study.seeds, study.measures) == ((2900, 2901), {})


@pytest.mark.skipif(not RECORDED.is_dir(), reason="a source archive has no results")
def test_choices_keep_their_validation_traffic_on_other_seeds(tmp_path):
    study = find_study(Args(name="suite", test_seeds="2900:2902"))
    rows = read_rows("suite", RECORDED)
    cells = [*study.cells, *study.follow(rows, Place(tmp_path, this_process))]
    seeds = {cell.labels["part"]: study.seeds_of(cell) for cell in cells}
    assert seeds["test"] == (2900, 2901)
    assert set(seeds["validation"]) <= set(VALIDATION_SEEDS)


@pytest.mark.slow
def test_a_study_of_ones_own_runs_from_the_command_line(tmp_path):
    words = (MINE, "--output", str(tmp_path / "out"))
    done = run_command("study", *words, "--workers", "1", "--json")
    assert done.returncode == 0, done.stderr
    files = ["errors.png", "rows.parquet", "tables.md"]
    assert json.loads(done.stdout) == {"folder": str(tmp_path / "out"), "files": files}
    rows = read_rows("my-study", tmp_path / "out")
    assert len(rows) == len(STUDY.cells) * len(STUDY.seeds)
    tables = (tmp_path / "out" / "tables.md").read_text("utf-8")
    own = rows.filter(pl.col("rule") == "round-robin", pl.col("bandwidth") == 2)
    row = next(line for line in tables.splitlines() if line.startswith("| round-robin"))
    assert re.findall(r"[\d.]+ \[", row)[1] == f"{own['rmse_density'].mean():.2f} ["
    (tmp_path / "out" / "tables.md").unlink()
    assert run_command("study", *words, "--report").returncode == 0
    assert (tmp_path / "out" / "tables.md").read_text("utf-8") == tables
