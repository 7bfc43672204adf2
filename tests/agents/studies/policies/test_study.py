import csv
import json
import shutil

import pytest

from agents.engines.local import LocalProcesses
from agents.experiments.runner import Workplace
from agents.seeds import STUDY_TEST, STUDY_VALIDATION
from agents.studies.policies.manifest import find_checkpoints
from agents.studies.policies.plan import PolicyCell, PolicyDesign
from agents.studies.policies.study import freeze, run
from tests.agents.noting import Noting, cut
from tests.agents.policies import SHORT, save

WALK = {"estimator": "random_walk", "bandwidth": 2}
DESIGN = PolicyDesign(
    cells=(
        PolicyCell("primary", "a short road", SHORT, WALK, bounds=("oracle-error",)),
        PolicyCell("moved", "calm", SHORT, {**WALK, "incident": "none"}, ("primary",), ()),
    ),
    baselines=("paper", "oldest-first", "optimised-plan"),
    validation_seeds=(1000, 1001),
    test_seeds=(2000, 2001),
)


def freeze_in(folder, engine=None, policies="runs"):
    checkpoints = find_checkpoints((f"primary={folder}/{policies}",), DESIGN)
    place = Workplace(folder / "out", engine or Noting())
    return freeze(DESIGN, place, "the command", checkpoints=checkpoints)


def run_in(folder, engine=None):
    run(Workplace(folder / "out", engine or Noting()), n_resamples=200)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A folder in which everything was run once."""
    folder = tmp_path_factory.mktemp("study")
    for seed in range(2):
        save(folder / "runs" / f"pl-{seed}" / "best.zip", seed=seed)
    freeze_in(folder)
    run_in(folder)
    return folder


@pytest.fixture
def frozen(done, tmp_path):
    """A copy in which test traffic was not run yet."""
    shutil.copytree(done, tmp_path / "study")
    folder = tmp_path / "study"
    manifest = json.loads((folder / "out" / "manifest.json").read_text())
    for checkpoint in manifest["checkpoints"]:
        checkpoint["path"] = checkpoint["path"].replace(str(done), str(folder))
    (folder / "out" / "manifest.json").write_text(json.dumps(manifest))
    for name in ("episodes.csv", "queries.csv"):
        (folder / "out" / name).unlink()
    return folder


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_it_leaves_a_manifest_scores_figures_and_a_report(done):
    assert {path.name for path in (done / "out").iterdir()} == {
        "manifest.json", "run.json", "validation.csv", "episodes.csv", "queries.csv",
        "summary.csv", "fig_ladder.png", "fig_cells.png", "fig_queries.png", "REPORT.md",
    }  # fmt: skip
    validation, test = rows(done / "out" / "validation.csv"), rows(done / "out" / "episodes.csv")
    assert {row["traffic_seed"] for row in validation} == {"1000", "1001"}
    assert {row["traffic_seed"] for row in test} == {"2000", "2001"}
    # Oracles and policies that are transferred meet test traffic alone.
    assert {row["kind"] for row in validation} == {"baseline", "learned"}
    assert len(validation) == 2 * (2 + 4 + 2)
    assert len(test) == 2 * (2 + 1 + 4 + 2 + 2)
    text = (done / "out" / "REPORT.md").read_text()
    assert "the command" in text
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
        freeze_in(done)


def test_freezing_again_changes_nothing_and_other_policies_are_refused(frozen):
    before, engine = (frozen / "out" / "manifest.json").read_text(), Noting()
    manifest, is_new = freeze_in(frozen, engine)
    assert manifest.frozen
    assert not is_new
    with pytest.raises(ValueError, match="manifest of other policies"):
        freeze_in(frozen, engine, "runs/pl-0")
    assert (frozen / "out" / "manifest.json").read_text() == before
    assert engine.tasks == []


def test_a_policy_that_is_not_the_frozen_one_is_refused_before_anything_is_run(frozen):
    save(frozen / "runs" / "pl-1" / "best.zip", seed=9)
    engine = Noting()
    with pytest.raises(ValueError, match=r"pl-1/best\.zip is not the policy that was frozen"):
        run_in(frozen, engine)
    (frozen / "runs" / "pl-1" / "best.zip").unlink()
    with pytest.raises(FileNotFoundError, match=r"pl-1/best\.zip"):
        run_in(frozen, engine)
    assert engine.tasks == []
    assert not (frozen / "out" / "episodes.csv").exists()


def test_a_complete_folder_is_rendered_without_an_episode_and_without_the_policies(done, tmp_path):
    shutil.copytree(done / "out", tmp_path / "out")
    shutil.move(done / "runs", done / "gone")
    engine = Noting()
    try:
        run_in(tmp_path, engine)
    finally:
        shutil.move(done / "gone", done / "runs")
    assert engine.tasks == []
    for path in (done / "out").iterdir():
        assert (tmp_path / "out" / path.name).read_bytes() == path.read_bytes(), path.name


def test_what_is_missing_is_run_and_nothing_else(done, frozen):
    names = ("episodes.csv", "queries.csv", "summary.csv")
    for name in names:
        shutil.copy(done / "out" / name, frozen / "out")
    cut(frozen / "out" / "episodes.csv")
    engine = Noting()
    run_in(frozen, engine)
    assert 1 <= len(engine.tasks) <= 2
    assert {task.noise for task in engine.tasks} == {STUDY_TEST.start}
    for name in names:
        assert (frozen / "out" / name).read_bytes() == (done / "out" / name).read_bytes()


def test_queries_are_counted_where_they_are_missing(done, frozen):
    shutil.copy(done / "out" / "episodes.csv", frozen / "out")
    run_in(frozen)
    expected = (done / "out" / "queries.csv").read_bytes()
    assert (frozen / "out" / "queries.csv").read_bytes() == expected


def test_an_interrupted_freeze_goes_on(done, tmp_path):
    shutil.copytree(done / "runs", tmp_path / "runs")
    engine = Noting(interrupt_after=3)
    with pytest.raises(KeyboardInterrupt):
        freeze_in(tmp_path, engine)
    assert len(rows(tmp_path / "out" / "validation.csv")) == 6
    assert {task.noise for task in engine.tasks} == {STUDY_VALIDATION.start}
    with pytest.raises(ValueError, match="not frozen yet"):
        run_in(tmp_path)
    freeze_in(tmp_path)
    path, expected = (folder / "out" / "validation.csv" for folder in (tmp_path, done))
    assert path.read_bytes() == expected.read_bytes()


def test_running_needs_a_manifest(tmp_path):
    with pytest.raises(FileNotFoundError, match="freeze policies first"):
        run_in(tmp_path)


@pytest.mark.slow
def test_two_processes_find_the_same(done, frozen):
    run_in(frozen, LocalProcesses(2))
    assert rows(frozen / "out" / "episodes.csv") == rows(done / "out" / "episodes.csv")
