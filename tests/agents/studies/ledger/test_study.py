import csv
import dataclasses
import json

import pytest

from agents.experiments.runner import Workplace
from agents.studies.ledger.study import run
from tests.agents.noting import Noting, cut
from tests.agents.studies.ledger.made_up import DESIGN

# Both values of delta are the same, which halves the cells.
SMALL = dataclasses.replace(
    DESIGN, seeds="2000:2002", schedules=("random",), strict_delta=DESIGN.delta
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ledger") / "out"
    run(SMALL, Workplace(folder, Noting()), "the command")
    return folder


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_it_leaves_figures_tables_and_a_report(folder):
    assert {path.name for path in folder.iterdir()} == {
        "fig_epsilon.png", "fig_ladder.png", "fig_ledgers.png", "trips.csv",
        "summary.csv", "episodes.csv", "run.json", "REPORT.md",
    }  # fmt: skip
    assert len(rows(folder / "episodes.csv")) == 2 * len(SMALL.cells())
    assert len(rows(folder / "trips.csv")) == 2 * len({each.cell for each in SMALL.watched})
    assert {row["traffic_seed"] for row in rows(folder / "trips.csv")} == {"2000", "2001"}
    summary = rows(folder / "summary.csv")
    assert len(summary) == len(SMALL.cells())
    assert {"percent_refused", "percent_exhausted_high"} <= summary[0].keys()
    text = (folder / "REPORT.md").read_text()
    assert "the command" in text
    assert str(folder) not in text


def test_noise_costs_and_more_of_it_costs_more(folder):
    error = {
        (row["mechanism"], row["epsilon"]): float(row["rmse_density_veh_km"])
        for row in rows(folder / "summary.csv")
        if row["filter_name"] == "random_walk" or row["mechanism"] == "exact"
    }
    assert error["exact", "inf"] < error["paced", "5.0"] < error["paced", "1.0"]


def test_what_was_cut_off_is_run_again_and_nothing_else(folder):
    for name in ("episodes.csv", "trips.csv"):
        before = cut(folder / name)
        engine = Noting()
        run(SMALL, Workplace(folder, engine), "the command")
        assert len(engine.tasks) <= 2
        assert engine.n_episodes == 2 * len(engine.tasks) > 0
        assert (folder / name).read_bytes() == before


def test_a_complete_folder_is_rendered_without_an_episode_and_without_records(folder, tmp_path):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    engine = Noting()
    run(SMALL, Workplace(folder, engine, str(tmp_path / "records")), "the command")
    assert engine.tasks == []
    assert not (tmp_path / "records").exists()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_an_interrupt_keeps_what_is_done(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(SMALL, Workplace(tmp_path / "out", Noting(interrupt_after=2)), "the command")
    assert len(rows(tmp_path / "out" / "episodes.csv")) == 4


def test_a_folder_of_another_schedule_is_refused_and_kept(folder, tmp_path):
    made = json.loads((folder / "run.json").read_text())
    made["made_with"]["schedule"] = "paper"
    (tmp_path / "run.json").write_text(json.dumps(made))
    with pytest.raises(ValueError, match="schedule is 'paper' there and 'round-robin' now"):
        run(SMALL, Workplace(tmp_path, Noting()), "the command")
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]
