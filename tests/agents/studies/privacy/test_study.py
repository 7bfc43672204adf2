import csv
import json

import pytest

from agents.experiments.runner import Workplace
from agents.studies.privacy.plan import PrivacyDesign
from agents.studies.privacy.study import run
from tests.agents.noting import Noting, cut

DESIGN = PrivacyDesign(
    env="dptse_env:dptse/ShortHighway-v0",
    seeds="2000:2002",
    estimators=("random_walk",),
    epsilons=(1.0,),
    caps=(4,),
    bandwidths=(1,),
    bandwidth=2,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("privacy") / "out"
    run(DESIGN, Workplace(folder, Noting()), "the command")
    return folder


def test_it_leaves_figures_tables_and_a_report(folder):
    assert {path.name for path in folder.iterdir()} == {
        "fig_epsilon.png", "fig_modes.png", "fig_claimed.png", "trips.csv",
        "summary.csv", "episodes.csv", "run.json", "REPORT.md",
    }  # fmt: skip
    with (folder / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * len(DESIGN.cells())
    assert {row["traffic_seed"] for row in rows} == {"2000", "2001"}
    made_with = json.loads((folder / "run.json").read_text())["made_with"]
    assert made_with["schedule"] == "paper"
    assert "random_walk-paper-capped" in made_with["settings"]
    text = (folder / "REPORT.md").read_text()
    assert "the command" in text
    assert str(folder) not in text


def test_more_noise_of_a_longer_unit_costs(folder):
    with (folder / "summary.csv").open() as file:
        error = {
            row["unit"]: float(row["rmse_density_veh_km"])
            for row in csv.DictReader(file)
            if row["preset"] == "capped" and row["epsilon"] == "1.0"
            and row["cap"] in ("0", "64") and row["bandwidth"] == "2"
        }  # fmt: skip
    assert error["event"] < error["trip"] < error["horizon"]


def test_what_was_cut_off_is_run_again_and_nothing_else(folder):
    before = cut(folder / "episodes.csv")
    engine = Noting()
    run(DESIGN, Workplace(folder, engine), "the command")
    assert 2 <= engine.n_episodes <= 4
    assert (folder / "episodes.csv").read_bytes() == before


def test_a_complete_folder_is_rendered_without_an_episode_and_without_records(folder, tmp_path):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    engine = Noting()
    run(DESIGN, Workplace(folder, engine, str(tmp_path / "records")), "the command")
    assert engine.tasks == []
    assert not (tmp_path / "records").exists()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_an_interrupt_keeps_what_is_done(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(DESIGN, Workplace(tmp_path / "out", Noting(interrupt_after=2)), "the command")
    with (tmp_path / "out" / "episodes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 4


def test_a_folder_of_other_settings_is_refused_and_kept(folder, tmp_path):
    made = json.loads((folder / "run.json").read_text())
    made["made_with"]["schedule"] = "round-robin"
    (tmp_path / "run.json").write_text(json.dumps(made))
    with pytest.raises(ValueError, match="schedule is 'round-robin' there and 'paper' now"):
        run(DESIGN, Workplace(tmp_path, Noting()), "the command")
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]
