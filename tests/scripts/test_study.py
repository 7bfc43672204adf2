import re
from dataclasses import replace

import polars as pl
import pytest

from agents.study import read_rows
from examples.my_study import STUDY
from scripts.study import STUDIES, Args, find_study, main
from tests.scripts.commands import run_command

MINE, SHORT = "examples.my_study:STUDY", STUDY.cells[0].env
FIRST = replace(STUDY.cells[0], keywords={**STUDY.cells[0].keywords, "corridor": "paper-highway"})
MANY = replace(STUDY.cells[0], keywords={**STUDY.cells[0].keywords, "bandwidth": 15})
WIDE = replace(STUDY, cells=(MANY, *STUDY.cells[1:]), measures={"trips.parquet": lambda _: None})
MIXED = (FIRST, *STUDY.cells[1:])
ROADS = replace(STUDY, cells=MIXED, follow=lambda rows, folder: MIXED)


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_is_found_and_a_cell_has_one_set_of_labels(name):
    study = find_study(Args(name=name))
    assert study.name == name
    labels = {cell.id: cell.labels for cell in study.cells}
    assert all(cell.labels == labels[cell.id] for cell in study.cells)
    quick = find_study(Args(name=name, quick=True))
    assert max(len(quick.seeds_of(cell)) for cell in quick.cells) == 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "moon"}, "study must be one of paper, guarantees, .*, got 'moon'"),
        ({"name": "no_such_module:STUDY"}, "'no_such_module:STUDY' cannot be imported"),
        ({"name": "examples.my_study:CELLS"}, "must be a Study, got tuple"),
        ({"name": MINE, "train": 1.0}, "train is an argument of the study policies, not of"),
        ({"name": "paper", "weights": ("a",)}, "weights is an argument of the study estim"),
        ({"name": MINE, "seeds": "all"}, "must be 'first:stop' or one seed, got 'all'"),
        ({"name": MINE, "workers": 0}, "workers must be an integer >= 1"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(Args(**changes, output=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_report_without_rows_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="run the study without --report"):
        main(Args(name=MINE, report=True, output=tmp_path))


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
    for other in (f'{SHORT} {{"bandwidth": 1}}', "dptse_env:dptse/LongHighway-v0"):
        with pytest.raises(ValueError, match=r"^env must be of"):
            find_study(Args(name=MINE, env=(other,)))


def test_seeds_and_environments_can_be_others_with_an_output_of_their_own():
    for changes in ({"seeds": "2900:2902"}, {"env": (SHORT,)}):
        with pytest.raises(ValueError, match="given with an output of its own"):
            main(Args(name=MINE, **changes))
    assert find_study(Args(name=f"{__name__}:WIDE")).measures
    study = find_study(Args(name=f"{__name__}:WIDE", seeds="2900:2902", env=(SHORT,)))
    assert (study.seeds, study.measures) == ((2900, 2901), {})


def test_choices_keep_their_validation_traffic_on_other_seeds(tmp_path):
    study = find_study(Args(name="policies", seeds="2900:2902", quick=True))
    cells = [*study.cells, *study.follow(pl.DataFrame(), tmp_path)]
    seeds = {cell.labels["part"]: study.seeds_of(cell) for cell in cells}
    assert seeds == {"validation": (1000, 1001, 1002), "test": (2900, 2901)}


@pytest.mark.slow
def test_a_study_of_ones_own_runs_from_the_command_line(tmp_path):
    words = (MINE, "--output", str(tmp_path / "out"), "--workers", "1")
    done = run_command("study", *words)
    assert done.returncode == 0, done.stderr
    rows = read_rows("my-study", tmp_path / "out")
    assert len(rows) == len(STUDY.cells) * len(STUDY.seeds)
    tables = (tmp_path / "out" / "tables.md").read_text("utf-8")
    own = rows.filter(pl.col("rule") == "round-robin", pl.col("bandwidth") == 2)
    row = next(line for line in tables.splitlines() if line.startswith("| round-robin"))
    assert re.findall(r"[\d.]+ \[", row)[1] == f"{own['rmse_density'].mean():.2f} ["
    (tmp_path / "out" / "tables.md").unlink()
    assert run_command("study", *words, "--report").returncode == 0
    assert (tmp_path / "out" / "tables.md").read_text("utf-8") == tables
