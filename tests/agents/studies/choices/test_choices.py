"""The study of choices on two seeds of the short road."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("tyro")

from agents.engines.local import LocalProcesses
from agents.experiments.cells import ERROR
from agents.experiments.ledger import Ledger
from agents.experiments.runner import Workplace
from agents.policies import read_saved_policy
from agents.studies.choices import study, tables
from agents.studies.choices.cell import CAPPED, HIGHWAY, PACED, ChoiceCell
from agents.studies.choices.plan import ORACLE, ChoiceDesign, World
from agents.studies.choices.results import ChoiceResults, _matching

DESIGN = ChoiceDesign(
    seeds="2600:2602",
    bandwidths=(2, 5),
    long_bandwidths=(),
    epsilons=(5.0,),
    joint_epsilons=(1.0,),
    capped=("private-highway",),
)
ON_CAPPED = World(HIGHWAY, CAPPED, "ekf")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    from agents.evaluation.episodes import EpisodeScore

    place = Workplace(tmp_path_factory.mktemp("choices"), LocalProcesses(1))
    study.run(DESIGN, place, "the command")
    ledger = Ledger(place.folder / "episodes.csv", ChoiceCell, EpisodeScore)
    return place, ChoiceResults(DESIGN, ledger.rows)


def test_every_cell_is_run_once_on_every_seed(finished):
    _, results = finished
    cells = DESIGN.cells()
    assert set(results.scores) == {(cell, seed) for cell in cells for seed in (2600, 2601)}
    assert len({(cell.release, cell.estimator) for cell in cells}) == 4
    learned = [cell for cell in cells if cell.policy == "private-highway"]
    assert {cell.release for cell in learned} == {CAPPED}
    assert {cell.keywords["action"] for cell in learned} == {"slots"}


def test_gains_are_those_of_the_means(finished):
    _, results = finished
    base, rule = (
        np.mean(results.values(DESIGN.cell(ON_CAPPED, 5, policy), ERROR))
        for policy in ("round-robin", "speed-front")
    )
    gain = results.gain(ON_CAPPED, 5, ["speed-front"])
    assert gain.mean == pytest.approx(100 * (1 - rule / base))
    assert gain.low <= gain.mean <= gain.high
    assert results.worst_gain(ON_CAPPED, 5, ["speed-front"]) == pytest.approx(gain.mean)
    two = results.worst_gain(ON_CAPPED, 5, ["speed-front", "paper"])
    assert two == pytest.approx(results.gain(ON_CAPPED, 5, ["paper"]).mean)


def test_the_base_schedule_saves_nothing_and_the_oracle_something(finished):
    _, results = finished
    for bandwidth in (2, 5):
        assert results.saved(ON_CAPPED, bandwidth, ["round-robin"]).mean == pytest.approx(0.0)
    assert 0.0 < results.saved(ON_CAPPED, 2, [ORACLE]).mean <= 60.0 + 1e-9


def test_the_report_shows_the_map(finished):
    place, results = finished
    text = (place.folder / "REPORT.md").read_text()
    assert "the command" in text
    assert text.count("| 2 (13 %) |") == 4
    assert "`private-highway`, training seed" in text
    assert "drivers by Krauss" in text
    assert "| `paced`, recurrent, ε = 1, sums over two neighbours |" in text
    assert (place.folder / "fig_gains.png").stat().st_size > 10_000
    places = len(tables.paying(results)) + len(tables.not_paying(results))
    assert places == 4 * 2


def test_a_finished_study_is_only_rendered_again(finished, monkeypatch):
    place, _ = finished
    before = (place.folder / "episodes.csv").read_bytes()
    monkeypatch.setattr(study, "run_missing", lambda *_: pytest.fail("something was run"))
    study.run(DESIGN, place, "the command")
    assert (place.folder / "episodes.csv").read_bytes() == before


def test_bandwidths_are_matched_on_the_falling_curve():
    places = np.log([1.0, 2.0, 4.0, 8.0])
    curve = np.array([80.0, 60.0, 61.0, 50.0])
    errors = np.stack([curve] * 4)
    reached = np.array([90.0, 70.0, 60.0, 40.0])
    matched = np.exp(_matching(places, errors, reached))
    assert matched[0] == pytest.approx(1.0)
    assert matched[1] == pytest.approx(2.0**0.5)
    assert 2.0 <= matched[2] <= 4.0
    assert matched[3] == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "0:2"}, "seeds must be test seeds"),
        ({"long_seeds": "1000:1002"}, "long_seeds must be test seeds"),
        ({"corridor": "short-highway"}, "corridor is part of this study"),
        ({"base_bandwidth": 3}, r"bandwidths must hold 3 and epsilons 5"),
        ({"epsilons": (1.0,)}, r"bandwidths must hold 2 and epsilons 5"),
    ],
)
def test_bad_designs_are_refused_before_anything_is_written(changes, message, tmp_path):
    place = Workplace(tmp_path / "out", LocalProcesses(1))
    with pytest.raises(ValueError, match=message):
        study.run(dataclasses.replace(DESIGN, **changes), place, "")
    assert not place.folder.exists()


def test_missing_policies_are_refused_before_anything_is_written(tmp_path):
    place = Workplace(tmp_path / "out", LocalProcesses(1))
    design = dataclasses.replace(DESIGN, paced=(str(tmp_path / "no.zip"),))
    with pytest.raises(FileNotFoundError):
        study.run(design, place, "")
    assert not place.folder.exists()


def test_provenance_has_the_digests_of_the_policies():
    made_with = study.design_provenance(DESIGN)["made_with"]
    saved = read_saved_policy("private-highway")
    assert made_with["policies"] == {"private-highway": saved.sha256}
    assert {name.split()[1] for name in made_with["cells"]} == {"own", "krauss-two-peaks"}
    assert PACED in {cell.release for cell in DESIGN.quick().cells()}
