import csv
import json

import pytest
from PIL import Image

from agents.experiments import runner
from scripts import reproduce
from scripts.cli import command
from scripts.reproduce import Args, design_of, main

SMALL = {
    "env": "dptse_env:dptse/ShortHighway-v0",
    "seeds": "2000:2002",
    "estimators": ("ekf",),
    "cv_segments": (1, 2, 3),
    "epsilons": (0.5, 2.0),
    "deltas": (0.01,),
    "picture_segments": 3,
    "privacy_segments": 2,
    "workers": 1,
}
FIGURES = ("fig1_cv_segments", "fig2_space_time", "fig3_epsilon", "fig4_delta", "fig5_run_time")


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reproduce") / "out"
    main(Args(**SMALL, output=folder))
    return folder


@pytest.fixture
def counted(monkeypatch):
    """Seeds of the tasks that are run."""
    tasks, run_task = [], runner.run_task

    def count(task):
        tasks.append(task)
        return run_task(task)

    monkeypatch.setattr(runner, "run_task", count)
    return tasks


def test_it_leaves_figures_tables_and_a_report(output):
    for name in FIGURES:
        with Image.open(output / f"{name}.png") as image:
            assert min(image.size) > 300
    with (output / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    # 4 settings of 3 + 2 + 1 cells for two estimators, the open loop twice, on two seeds.
    assert len(rows) == (4 * 6 * 2 + 2) * 2
    assert {row["traffic_seed"] for row in rows} == {"2000", "2001"}
    with (output / "summary.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 50
    assert (
        "ekf-paper-paper" in json.loads((output / "run.json").read_text())["made_with"]["settings"]
    )
    report = (output / "REPORT.md").read_text()
    assert "--seeds 2000:2002 --estimators ekf" in report
    assert (
        "| P1. The density error of every technique falls with more CV segments. | not me" in report
    )


def test_what_was_cut_off_is_run_again_and_nothing_else(output, counted, monkeypatch):
    monkeypatch.setattr(reproduce, "draw", lambda *_: None)  # drawn once is enough
    path = output / "episodes.csv"
    whole, times = path.read_bytes(), (output / "run_time.csv").read_bytes()
    path.write_bytes(whole[: whole.rindex(b"\n", 0, len(whole) - 200) - 9])
    main(Args(**SMALL, output=output))
    again = [(task.cell, seed) for task in counted for seed in task.seeds]
    assert 2 <= len(again) <= 4
    assert path.read_bytes() == whole
    assert (output / "run_time.csv").read_bytes() == times


def test_a_folder_made_otherwise_is_refused_and_kept(output, tmp_path):
    made = json.loads((output / "run.json").read_text())
    made["made_with"]["versions"]["dptse-env"] = "0.0.1"
    (tmp_path / "run.json").write_text(json.dumps(made))
    with pytest.raises(ValueError, match=r"versions\.dptse-env is '0\.0\.1' there and"):
        main(Args(**SMALL, output=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "0:4"}, "seeds must be held out"),
        ({"seeds": "2000"}, "seeds must be 2 or more"),
        ({"seeds": "all"}, "must be 'first:stop' or one seed"),
        ({"estimators": ("kf",)}, "estimator must be one of"),
        ({"cv_segments": (5, 6, 7)}, r"bandwidth must be in 1\.\.6, got 7"),
        ({"workers": 0}, "workers must be an integer >= 1, got 0"),
        ({"deltas": (0.7,)}, "delta"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(Args(**{**SMALL, **changes}, output=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_the_command_says_what_matters_to_the_results(tmp_path):
    assert command("reproduce", Args()) == "python scripts/reproduce.py"
    args = Args(quick=True, epsilons=(0.5, 2.0), workers=7, output=tmp_path, records=tmp_path)
    assert command("reproduce", args) == "python scripts/reproduce.py --quick --epsilons 0.5 2.0"


def test_quick_asks_for_less():
    full, part = design_of(Args()), design_of(Args(quick=True))
    assert len(part.seeds) < len(full.seeds)
    assert set(part.cells()) < set(full.cells())
