import csv
import dataclasses
import json
from dataclasses import replace

import pytest

from agents.studies.estimators.cell import LINEAR
from agents.studies.estimators.plan import EstimatorDesign
from agents.studies.estimators.worlds import GUARANTEES, MAIN
from agents.studies.ledger.cell import FilterSets
from agents.studies.ledger.plan import LedgerDesign
from agents.studies.paper.plan import PaperDesign
from agents.studies.policies.plan import PolicyCell
from agents.studies.policies.running import cell_config
from agents.studies.privacy.plan import PrivacyDesign
from dptse_env.estimators.tuned_settings import write_settings
from dptse_env.model import load_parameters
from dptse_env.model.parameters import write_parameters
from dptse_env.traffic import SHORT_HIGHWAY, read_corridor, write_corridor
from scripts.cli import command, run
from scripts.study import (
    EstimatorStudy,
    Freeze,
    LedgerStudy,
    Paper,
    Policies,
    Privacy,
    Run,
    Study,
    freeze,
    main,
    policy_design,
)
from tests.agents.policies import SHORT, save
from tests.scripts.commands import run_script

PAPER = PaperDesign(
    env=SHORT, seeds="2000:2002", estimators=("ekf",), cv_segments=(1, 2, 3), epsilons=(0.5, 2.0),
    deltas=(0.01,), picture_segments=3, privacy_segments=2,
)  # fmt: skip
PRIVACY = PrivacyDesign(
    env=SHORT, seeds="2000:2002", estimators=("random_walk",), epsilons=(1.0,), caps=(4,),
    bandwidths=(1,), bandwidth=2,
)  # fmt: skip
WALK = {"estimator": "random_walk", "bandwidth": 2}
CELLS = (
    PolicyCell("primary", "a short road", SHORT, WALK, bounds=()),
    PolicyCell("moved", "calm", SHORT, {**WALK, "incident": "none"}, ("primary",), ()),
)


@pytest.mark.slow
def test_the_command_line_runs_a_study_and_reports_its_command(tmp_path):
    arguments = (
        "privacy", "--env", SHORT, "--seeds", "2000:2002", "--estimators", "random_walk",
        "--epsilons", "1.0", "--caps", "4", "--bandwidths", "1", "--bandwidth", "2",
        "--workers", "1", "--output", str(tmp_path / "out"),
    )  # fmt: skip
    result = run_script("study.py", *arguments)
    assert result.returncode == 0, result.stderr
    with (tmp_path / "out" / "episodes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * len(PRIVACY.cells())
    report = (tmp_path / "out" / "REPORT.md").read_text()
    (line,) = (line for line in report.splitlines() if line.startswith("python scripts/study.py"))
    assert line.split()[2] == "privacy"
    assert set(line.split()) >= {"--env", SHORT, "2000:2002", "random_walk"}
    assert str(tmp_path) not in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("paper", "--seeds", "0:4"), "error: seeds must be test seeds"),
        (("privacy", "--caps", "64"), "error: caps must hold a value beside 64"),
        (("ledger", "--paces", "0.85"), "error: paces must hold a value beside 0.85"),
        (("policies", "run", "--workers", "0"), "error: workers must be an integer >= 1, got 0"),
        (("policies", "freeze", "--cells", "far"), "error: cells must be of primary, paper"),
        (("ledger", "--corridor", "moon"), "error: corridor must be one of paper-highway, "),
        (("estimators", "--corridor", "no.toml"), "error: "),
    ],
)
def test_mistakes_end_in_one_line_on_stderr(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["study.py", *arguments, "--output", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        run(main, Study, None)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(message)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "0:4"}, "seeds must be test seeds"),
        ({"seeds": "2000"}, "seeds must be 2 or more"),
        ({"seeds": "all"}, "must be 'first:stop' or one seed"),
        ({"estimators": ("kf",)}, "estimator must be one of"),
        ({"cv_segments": (5, 6, 7)}, r"bandwidth must be in 1\.\.6, got 7"),
        ({"deltas": (0.7,)}, "delta"),
    ],
)
def test_bad_arguments_of_the_reproduction_are_named(changes, message, tmp_path):
    design = dataclasses.replace(PAPER, **changes)
    with pytest.raises(ValueError, match=message):
        main(Paper(design=design, workers=1, output=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"epsilons": (-1.0,)}, "privacy.epsilon"),
        ({"delta": 0.7}, r"privacy\.delta"),
        ({"caps": (0,)}, "privacy.cap"),
        ({"bandwidths": (99,)}, "bandwidth must be in"),
        ({"schedule": "mine"}, "schedule must be one of"),
    ],
)
def test_bad_arguments_of_the_study_of_privacy_are_named(changes, message, tmp_path):
    design = dataclasses.replace(PRIVACY, **changes)
    with pytest.raises(ValueError, match=message):
        main(Privacy(design=design, workers=1, output=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.fixture
def road(tmp_path):
    """The file of a short road with a lane more than the shipped one, with a fit and settings."""
    path = tmp_path / "my-road.toml"
    fit = replace(load_parameters("w99-3lane"), name="my-road")
    write_parameters(tmp_path / "fit.json", fit, {})
    write_settings(
        tmp_path / "ekf.json", estimator="ekf", parameters="my-road", privacy="paced",
        settings={"demand": {}}, provenance={},
    )  # fmt: skip
    table = {"parameters": "fit.json", "estimator_settings": "ekf.json"}
    write_corridor(path, replace(SHORT_HIGHWAY, name="my-road", lanes=3), table)
    return str(path)


ESTIMATORS = EstimatorDesign(
    seeds="2000:2002", schedules=("round-robin",), slow_estimators=(), fit_seeds="0:1",
    quick_estimators=("ekf", "random_walk", LINEAR, "recurrent"), worlds=("printed", "paced"),
)  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
@pytest.mark.parametrize(
    ("arguments", "design"), [(Privacy, PRIVACY), (EstimatorStudy, ESTIMATORS)]
)
def test_a_study_is_made_of_a_road_of_one_s_own(arguments, design, road, tmp_path, monkeypatch):
    monkeypatch.setattr("agents.studies.estimators.study.measure", lambda *_: [])
    monkeypatch.chdir(tmp_path)
    main(arguments(design=replace(design, corridor=road), quick=False, workers=1))
    (folder,) = (tmp_path / "results").iterdir()
    assert folder.name.endswith("-my-road")
    assert "on the road `my-road` in place of" in (folder / "REPORT.md").read_text()
    made_with = json.loads((folder / "run.json").read_text())["made_with"]
    digests = {made_with["corridor"]} if "corridor" in made_with else {
        each["corridor"] for each in made_with["cells"].values()
    }  # fmt: skip
    assert digests == {read_corridor(road).digest}


def test_worlds_that_are_other_roads_are_refused_on_a_road_of_one_s_own(road):
    assert set(EstimatorDesign(corridor=road).run_worlds) == {*MAIN, *GUARANTEES}
    with pytest.raises(ValueError, match=r"worlds must be of printed, .* got 'krauss'"):
        EstimatorDesign(corridor=road, worlds=("krauss",)).check()


@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
def test_policies_are_frozen_on_a_road_of_one_s_own(road):
    design = policy_design(Freeze(corridor=road, cells=("primary",)))
    assert design.cells[0].keywords["corridor"] == road
    assert cell_config(design.cells[0], (2000,)).corridor.name == "my-road"


def arguments(folder, **changes):
    return Freeze(
        **{
            "policies": (f"primary={folder}/runs",),
            "cells": ("primary", "moved"),
            "baselines": ("paper", "oldest-first"),
            "validation_seeds": "1000:1002",
            "test_seeds": "2000:2002",
            "workers": 1,
            "output": folder / "out",
            **changes,
        }
    )


def test_policies_are_frozen_and_run(tmp_path, capsys):
    save(tmp_path / "runs" / "pl-0" / "best.zip")
    freeze(arguments(tmp_path), CELLS)
    printed = capsys.readouterr().out
    assert "primary: best baseline" in printed
    assert str(tmp_path / "out" / "manifest.json") in printed
    freeze(arguments(tmp_path), CELLS)
    assert "frozen before" in capsys.readouterr().out
    main(Policies(Run(workers=1, output=tmp_path / "out")))
    assert str(tmp_path / "out") in capsys.readouterr().out
    report = (tmp_path / "out" / "REPORT.md").read_text()
    assert "python scripts/study.py policies freeze --policies" in report


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cells": ("moved",)}, "begin with 'primary'"),
        ({"cells": ("primary", "far")}, "cells must be of primary, moved, got 'far'"),
        ({"policies": ("nowhere",)}, "policies must be cell=path"),
        ({"baselines": ("oldest-first",)}, "hold 'paper'"),
        ({"test_seeds": "1000:1002"}, "test_seeds must be test seeds"),
        ({"validation_seeds": "all"}, "validation_seeds must be 'first:stop'"),
        ({"workers": 0}, "workers must be an integer >= 1"),
    ],
)
def test_bad_arguments_of_freezing_are_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        freeze(arguments(tmp_path, **changes), CELLS)
    assert not (tmp_path / "out").exists()


def test_a_command_holds_what_results_depend_on(tmp_path):
    assert command("study.py paper", Paper()) == "python scripts/study.py paper"
    design = PaperDesign(epsilons=(0.5, 2.0))
    args = Paper(quick=True, design=design, workers=7, output=tmp_path, records=tmp_path)
    assert command("study.py paper", args) == (
        "python scripts/study.py paper --quick --epsilons 0.5 2.0"
    )
    paced = LedgerDesign(single_only=True, sets=FilterSets(paced_demand="tried"))
    assert command("study.py ledger", LedgerStudy(design=paced)) == (
        "python scripts/study.py ledger --paced-demand tried --single-only"
    )


def test_quick_needs_less():
    full, part = policy_design(Freeze()), policy_design(Freeze(quick=True))
    assert len(part.cells) < len(full.cells)
    assert set(part.test_seeds) < set(full.test_seeds)


def test_an_interrupt_ends_with_its_status_and_how_to_go_on(tmp_path, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("agents.studies.paper.study.run", interrupted)
    with pytest.raises(SystemExit) as ended:
        main(Paper(output=tmp_path / "out"))
    assert ended.value.code == 130
    assert "the same command goes on" in capsys.readouterr().err
