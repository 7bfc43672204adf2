import csv
import dataclasses
import json
import shutil

import pytest

from agents.experiments.seeds import STUDY_TEST, STUDY_VALIDATION
from agents.studies.policies.plan import Cell
from scripts import policy_study
from scripts.policy_study import Freeze, Run, main
from tests.agents.policies import SHORT, save

WALK = {"estimator": "random_walk", "bandwidth": 2}
CELLS = (
    Cell("primary", "a short road", SHORT, WALK, bounds=("oracle-error",)),
    Cell("moved", "without an incident", SHORT, {**WALK, "incident": "none"}, ("primary",), ()),
)


@pytest.fixture(autouse=True)
def _small_cells(monkeypatch):
    monkeypatch.setattr(policy_study, "CELLS", CELLS)


def arguments(folder, **changes):
    return Freeze(
        **{
            "policies": (f"primary={folder}/runs",),
            "cells": ("primary", "moved"),
            "baselines": ("paper", "oldest-first", "offline"),
            "validation_seeds": "1000:1002",
            "test_seeds": "2000:2002",
            "workers": 1,
            "output": folder / "out",
            **changes,
        }
    )


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A folder in which everything was run once."""
    folder = tmp_path_factory.mktemp("study")
    for seed in range(2):
        save(folder / "runs" / f"pl-{seed}" / "best.zip", seed=seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policy_study, "CELLS", CELLS)
        main(arguments(folder))
        main(Run(workers=1, output=folder / "out"))
    return folder


@pytest.fixture
def frozen(done, tmp_path):
    """A copy in which test traffic was not run yet."""
    shutil.copytree(done, tmp_path / "study")
    folder = tmp_path / "study"
    manifest = json.loads((folder / "out" / "manifest.json").read_text())
    for own in manifest["checkpoints"]:
        own["path"] = own["path"].replace(str(done), str(folder))
    (folder / "out" / "manifest.json").write_text(json.dumps(manifest))
    for name in ("episodes.csv", "asked.csv"):
        (folder / "out" / name).unlink()
    return folder


@pytest.fixture
def counted(monkeypatch):
    """Tasks that are run."""
    tasks, run_entry = [], policy_study.run_entry

    def count(task):
        tasks.append(task)
        return run_entry(task)

    monkeypatch.setattr(policy_study, "run_entry", count)
    return tasks


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_it_leaves_a_manifest_scores_figures_and_a_report(done):
    assert {path.name for path in (done / "out").iterdir()} == {
        "manifest.json", "run.json", "validation.csv", "episodes.csv", "asked.csv", "summary.csv",
        "fig_ladder.png", "fig_cells.png", "fig_curves.png", "fig_asked.png", "REPORT.md",
    }  # fmt: skip
    validation, test = rows(done / "out" / "validation.csv"), rows(done / "out" / "episodes.csv")
    assert {row["traffic_seed"] for row in validation} == {"1000", "1001"}
    assert {row["traffic_seed"] for row in test} == {"2000", "2001"}
    # Oracles and policies that moved meet test traffic alone.
    assert {row["kind"] for row in validation} == {"baseline", "learned"}
    assert len(validation) == 2 * (2 + 4 + 2)
    assert len(test) == 2 * (2 + 1 + 4 + 2 + 2)
    text = (done / "out" / "REPORT.md").read_text()
    assert "policy_study.py freeze --policies" in text
    assert "5 training seeds and 64 test seeds" in text
    assert str(done / "out") not in text


def test_the_choice_rests_on_validation_traffic(done):
    manifest = json.loads((done / "out" / "manifest.json").read_text())
    for cell in ("primary", "moved"):
        errors = {}
        for row in rows(done / "out" / "validation.csv"):
            if row["cell"] == cell and row["kind"] == "baseline":
                errors.setdefault(row["policy"], []).append(-float(row["reward"]))
        best = min(errors, key=lambda name: sum(errors[name]))
        assert manifest["choices"][cell]["baseline"] == best


def test_nothing_is_frozen_once_test_traffic_was_run(done):
    with pytest.raises(ValueError, match="test traffic has been run"):
        main(arguments(done))


def test_freezing_again_changes_nothing_and_other_policies_are_refused(frozen, counted, capsys):
    before = (frozen / "out" / "manifest.json").read_text()
    main(arguments(frozen))
    assert "frozen before" in capsys.readouterr().out
    with pytest.raises(ValueError, match="manifest of other policies"):
        main(arguments(frozen, policies=(f"primary={frozen}/runs/pl-0",)))
    assert (frozen / "out" / "manifest.json").read_text() == before
    assert counted == []


def test_a_policy_that_is_not_the_frozen_one_is_refused_before_anything_is_run(
    done, frozen, counted
):
    save(frozen / "runs" / "pl-1" / "best.zip", seed=9)
    with pytest.raises(ValueError, match=r"pl-1/best\.zip is not the policy that was frozen"):
        main(Run(workers=1, output=frozen / "out"))
    assert counted == []
    assert not (frozen / "out" / "episodes.csv").exists()
    shutil.copy(done / "out" / "episodes.csv", frozen / "out")
    shutil.copy(done / "out" / "asked.csv", frozen / "out")
    with pytest.raises(ValueError, match="is not the policy"):  # a report of it, neither
        main(Run(workers=1, output=frozen / "out"))
    (frozen / "runs" / "pl-1" / "best.zip").unlink()
    with pytest.raises(FileNotFoundError, match=r"pl-1/best\.zip"):
        main(Run(workers=1, output=frozen / "out"))


def test_what_is_missing_is_run_and_nothing_else(done, frozen, counted, monkeypatch):
    monkeypatch.setattr(policy_study, "draw", lambda *_: None)  # drawn once is enough
    whole = (done / "out" / "episodes.csv").read_bytes()
    path = frozen / "out" / "episodes.csv"
    path.write_bytes(whole[: whole.rindex(b"\n", 0, len(whole) - 200) - 9])
    main(Run(workers=1, output=frozen / "out"))
    assert 1 <= len(counted) <= 2
    assert {task.noise for task in counted} == {STUDY_TEST.start}
    assert path.read_bytes() == whole
    assert (frozen / "out" / "asked.csv").read_bytes() == (done / "out" / "asked.csv").read_bytes()


def test_an_interrupted_freeze_goes_on(done, tmp_path, monkeypatch, capsys):
    run_entry, n_run = policy_study.run_entry, []

    def interrupted(task):
        if len(n_run) == 3:
            raise KeyboardInterrupt
        n_run.append(task)
        return run_entry(task)

    shutil.copytree(done / "runs", tmp_path / "runs")
    own = arguments(tmp_path)
    monkeypatch.setattr(policy_study, "run_entry", interrupted)
    with pytest.raises(SystemExit) as ended:
        main(own)
    assert ended.value.code == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert len(rows(tmp_path / "out" / "validation.csv")) == 6
    assert {task.noise for task in n_run} == {STUDY_VALIDATION.start}
    with pytest.raises(ValueError, match="not frozen yet"):
        main(Run(workers=1, output=tmp_path / "out"))
    monkeypatch.setattr(policy_study, "run_entry", run_entry)
    main(own)
    assert (tmp_path / "out" / "validation.csv").read_bytes() == (
        done / "out" / "validation.csv"
    ).read_bytes()


def test_running_needs_a_manifest(tmp_path):
    with pytest.raises(FileNotFoundError, match="freeze policies first"):
        main(Run(workers=1, output=tmp_path))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cells": ("moved",)}, "begin with 'primary'"),
        ({"cells": ("primary", "far")}, "cells must be of primary, moved, got 'far'"),
        ({"policies": ("nowhere",)}, "policies must be cell=path"),
        ({"baselines": ("oldest-first",)}, "hold 'paper'"),
        ({"test_seeds": "1000:1002"}, "seeds must be held out"),
        ({"validation_seeds": "all"}, "validation_seeds must be 'first:stop'"),
        ({"workers": 0}, "workers must be an integer >= 1"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(changes, message, done, tmp_path):
    own = dataclasses.replace(arguments(done, **changes), output=tmp_path / "out")
    with pytest.raises(ValueError, match=message):
        main(own)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_two_processes_find_the_same(done, frozen):
    main(Run(workers=2, output=frozen / "out"))
    assert rows(frozen / "out" / "episodes.csv") == rows(done / "out" / "episodes.csv")
