import csv
import json

import pytest
from PIL import Image

from agents.experiments.runner import Workplace
from agents.studies.paper.plan import PaperDesign
from agents.studies.paper.study import run
from tests.agents.noting import Noting, cut

DESIGN = PaperDesign(
    env="dptse_env:dptse/ShortHighway-v0",
    seeds="2000:2002",
    estimators=("ekf",),
    cv_segments=(1, 2, 3),
    epsilons=(0.5, 2.0),
    deltas=(0.01,),
    picture_segments=3,
    privacy_segments=2,
)
# Figures of a whole study; those of the other studies are drawn in each run of the tests.
pytestmark = pytest.mark.slow

FIGURES = ("fig1_cv_segments", "fig2_space_time", "fig3_epsilon", "fig4_delta", "fig5_run_time")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper") / "out"
    run(DESIGN, Workplace(folder, Noting()), "the command")
    return folder


def test_it_leaves_figures_tables_and_a_report(folder):
    for name in FIGURES:
        with Image.open(folder / f"{name}.png") as image:
            assert image.format == "PNG"
    with (folder / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    # 4 settings of 3 + 2 + 1 cells for two estimators, the open loop twice, on two seeds.
    assert len(rows) == (4 * 6 * 2 + 2) * 2
    assert {row["traffic_seed"] for row in rows} == {"2000", "2001"}
    with (folder / "summary.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 50
    made_with = json.loads((folder / "run.json").read_text())["made_with"]
    assert "ekf-paper-paper" in made_with["settings"]
    report = (folder / "REPORT.md").read_text()
    assert "the command" in report
    assert "| not measured |" in report


def test_what_was_cut_off_is_run_again_and_nothing_else(folder):
    times = (folder / "run_time.csv").read_bytes()
    before = cut(folder / "episodes.csv")
    engine = Noting()
    run(DESIGN, Workplace(folder, engine), "the command")
    assert 2 <= engine.n_episodes <= 4
    assert (folder / "episodes.csv").read_bytes() == before
    assert (folder / "run_time.csv").read_bytes() == times


def test_a_complete_folder_is_rendered_without_an_episode(folder):
    def contents():
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    made = json.loads((folder / "run.json").read_text())
    made["sources"] = ["an earlier state"]
    (folder / "run.json").write_text(json.dumps(made))
    run(DESIGN, Workplace(folder, Noting()), "the command")
    before = contents()
    engine = Noting()
    run(DESIGN, Workplace(folder, engine), "the command")
    assert engine.tasks == []
    assert contents() == before
    # The present state of the code has made none of the results.
    assert json.loads(before["run.json"])["sources"] == ["an earlier state"]
    (folder / "REPORT.md").unlink()
    run(DESIGN, Workplace(folder, engine), "another command")
    assert "another command" in (folder / "REPORT.md").read_text()


def test_a_folder_made_otherwise_is_refused_and_kept(folder, tmp_path):
    made = json.loads((folder / "run.json").read_text())
    made["made_with"]["versions"]["dptse-env"] = "0.0.1"
    (tmp_path / "run.json").write_text(json.dumps(made))
    with pytest.raises(ValueError, match=r"versions\.dptse-env is '0\.0\.1' there and"):
        run(DESIGN, Workplace(tmp_path, Noting()), "the command")
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]
