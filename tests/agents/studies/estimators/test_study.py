import csv
import dataclasses

import pytest

from agents.experiments.runner import Workplace
from agents.studies.estimators import study
from tests.agents.noting import Noting, cut

from .made_up import DESIGN, add_worlds


@pytest.fixture(scope="module", autouse=True)
def _worlds():
    with pytest.MonkeyPatch.context() as patch:
        add_worlds(patch)
        times = [study.StepTime("ekf", 1.0, 1.0, 1.0), study.StepTime("recurrent", 0.9, 0.8, 1.0)]
        patch.setattr(study, "measure", lambda *_: times)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("estimators") / "out"
    study.run(DESIGN, Workplace(folder, Noting()), "the command")
    return folder


def rows(folder):
    with (folder / "episodes.csv").open() as file:
        return list(csv.DictReader(file))


def test_it_leaves_figures_fits_and_a_report(folder):
    assert {path.name for path in folder.iterdir()} == {
        "episodes.csv", "fig_coverage.png", "fig_elsewhere.png", "fig_estimators.png", "run.json",
        "stack.json", "times.json", "REPORT.md",
    }  # fmt: skip
    main = [row for row in rows(folder) if row["world"] == "tiny"]
    assert len(main) == 3 * (4 * 3 + 2)
    assert len(rows(folder)) - len(main) == 2 * 3
    text = (folder / "REPORT.md").read_text()
    assert "the command" in text
    assert str(folder) not in text
    assert "a short road" in text
    assert "| recurrent | 0.90 [0.80, 1.00] |" in text


def test_errors_are_those_of_the_environment(folder):
    for row in rows(folder):
        assert 0.0 < -float(row["reward"]) < 0.5
        counted = sum(float(row[f"n_{regime}"]) for regime in ("jam", "front", "free"))
        squares = sum(float(row[f"speed_{regime}"]) for regime in ("jam", "front", "free"))
        assert (squares / counted) ** 0.5 == pytest.approx(float(row["rmse_speed"]), rel=1e-4)


def test_what_was_cut_off_is_run_again_and_nothing_else(folder):
    before = cut(folder / "episodes.csv")
    engine = Noting()
    study.run(DESIGN, Workplace(folder, engine), "the command")
    assert len(engine.tasks) == 1
    assert (folder / "episodes.csv").read_bytes() == before


def test_a_complete_folder_is_rendered_without_an_episode_and_without_records(folder, tmp_path):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    engine = Noting()
    study.run(DESIGN, Workplace(folder, engine, str(tmp_path / "records")), "the command")
    assert engine.tasks == []
    assert not (tmp_path / "records").exists()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"weights": "no-such"},
            r"estimator_settings\.recurrent\.weights must be a file or one of",
        ),
        ({"worlds": ("tiny", "moon")}, "worlds must be one of .*, got 'moon'"),
        ({"seeds": "0:3"}, "must be test seeds"),
        ({"schedules": ("paper",)}, "schedules must hold the base schedule 'round-robin'"),
        ({"schedules": ("dice",)}, "schedules must be one of .*, got 'dice'"),
    ],
)
def test_bad_designs_are_named_before_anything_is_written(changes, message, tmp_path):
    design = dataclasses.replace(DESIGN, **changes)
    with pytest.raises(ValueError, match=message):
        study.run(design, Workplace(tmp_path / "out", Noting()), "the command")
    assert not (tmp_path / "out").exists()
