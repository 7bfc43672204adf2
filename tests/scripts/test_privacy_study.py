import csv
import dataclasses
import json

import pytest

from agents.experiments import runner
from scripts import privacy_study
from scripts.cli import command
from scripts.privacy_study import Args, design_of, main

SMALL = Args(
    env="dptse_env:dptse/ShortHighway-v0",
    seeds="2000:2002",
    estimators=("random_walk",),
    epsilons=(1.0,),
    caps=(4,),
    bandwidths=(1,),
    bandwidth=2,
    workers=1,
)


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    folder = tmp_path_factory.mktemp("privacy") / "out"
    main(dataclasses.replace(SMALL, output=folder))
    return folder


@pytest.fixture
def counted(monkeypatch):
    """Tasks that are run."""
    tasks, run_task = [], runner.run_task

    def count(task):
        tasks.append(task)
        return run_task(task)

    monkeypatch.setattr(runner, "run_task", count)
    return tasks


def test_it_leaves_figures_tables_and_a_report(output):
    assert {path.name for path in output.iterdir()} == {
        "fig_epsilon.png", "fig_modes.png", "fig_claimed.png",
        "summary.csv", "episodes.csv", "run.json", "REPORT.md",
    }  # fmt: skip
    cells = design_of(SMALL).cells()
    with (output / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * len(cells)
    assert {row["traffic_seed"] for row in rows} == {"2000", "2001"}
    made_with = json.loads((output / "run.json").read_text())["made_with"]
    assert made_with["schedule"] == "paper"
    assert "random_walk-paper-guaranteed" in made_with["settings"]
    text = (output / "REPORT.md").read_text()
    assert command("privacy_study", SMALL) in text
    assert str(output) not in text


def test_more_noise_of_a_longer_unit_costs(output):
    with (output / "summary.csv").open() as file:
        error = {
            row["unit"]: float(row["rmse_density_veh_km"])
            for row in csv.DictReader(file)
            if row["preset"] == "guaranteed" and row["epsilon"] == "1.0"
            and row["cap"] in ("0", "64") and row["bandwidth"] == "2"
        }  # fmt: skip
    assert error["event"] < error["trip"] < error["horizon"]


def test_what_was_cut_off_is_run_again_and_nothing_else(output, counted, monkeypatch):
    monkeypatch.setattr(privacy_study, "draw", lambda *_: None)  # drawn once is enough
    path = output / "episodes.csv"
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.rindex(b"\n", 0, len(whole) - 200) - 9])
    main(dataclasses.replace(SMALL, output=output))
    assert 2 <= sum(len(task.seeds) for task in counted) <= 4
    assert path.read_bytes() == whole


def test_an_interrupt_keeps_what_is_done_and_says_how_to_go_on(
    tmp_path, counted, monkeypatch, capsys
):
    count = runner.run_task

    def interrupted(task):
        if len(counted) == 2:
            raise KeyboardInterrupt
        return count(task)

    monkeypatch.setattr(runner, "run_task", interrupted)
    with pytest.raises(SystemExit) as ended:
        main(dataclasses.replace(SMALL, output=tmp_path / "out"))
    assert ended.value.code == 130
    assert "the same command goes on" in capsys.readouterr().err
    with (tmp_path / "out" / "episodes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 4


def test_a_folder_of_other_settings_is_refused_and_kept(output, tmp_path):
    made = json.loads((output / "run.json").read_text())
    made["made_with"]["schedule"] = "round-robin"
    (tmp_path / "run.json").write_text(json.dumps(made))
    with pytest.raises(ValueError, match="schedule is 'round-robin' there and 'paper' now"):
        main(dataclasses.replace(SMALL, output=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "0:4"}, "seeds must be held out"),
        ({"seeds": "all"}, "must be 'first:stop' or one seed"),
        ({"estimators": ("kf",)}, "estimator must be one of"),
        ({"epsilons": (-1.0,)}, "privacy.epsilon"),
        ({"delta": 0.7}, r"privacy\.delta"),
        ({"caps": (0,)}, "privacy.cap"),
        ({"bandwidths": (99,)}, "bandwidth must be in"),
        ({"schedule": "mine"}, "schedule must be one of"),
        ({"workers": 0}, "workers must be an integer >= 1, got 0"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(dataclasses.replace(SMALL, output=tmp_path / "out", **changes))
    assert not (tmp_path / "out").exists()


def test_quick_asks_for_less():
    full, part = design_of(Args()), design_of(Args(quick=True))
    assert set(part.cells()) < set(full.cells())
    assert set(part.seeds) < set(full.seeds)
