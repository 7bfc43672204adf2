"""The study of penetration on two seeds of the short road."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("tyro")

from agents.engines.local import LocalProcesses
from agents.evaluation.episodes import EpisodeScore
from agents.experiments.cells import ERROR
from agents.experiments.ledger import Ledger
from agents.experiments.runner import EpisodeTask, Workplace
from agents.statistics import paired_difference
from agents.studies.penetration import cell as cells
from agents.studies.penetration import study
from agents.studies.penetration.cell import PenetrationCell
from agents.studies.penetration.plan import PenetrationDesign
from agents.studies.penetration.results import PenetrationResults
from agents.studies.penetration.running import run_cell
from dptse_env.privacy import mu_of

DESIGN = PenetrationDesign(
    seeds="2600:2602",
    env="dptse_env:dptse/ShortHighway-v0",
    releases=("paper", "paced"),
    estimators=("ekf", "random_walk"),
    shares=(0.1, 1.0),
    detectors=(1, 3),
    bandwidth=2,
    policies=("round-robin", "inflated-trace", "static"),
    policy_shares=(0.1, 1.0),
    policy_estimators=("ekf", "random_walk"),
    fault_estimators=("ekf",),
    report_estimators=("ekf",),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    place = Workplace(tmp_path_factory.mktemp("penetration"), LocalProcesses(1))
    study.run(DESIGN, place, "the command")
    ledger = Ledger(place.folder / "episodes.csv", PenetrationCell, EpisodeScore)
    return place, PenetrationResults(DESIGN, ledger.rows)


def made_up(errors):
    """Return results in which some cells have an error x 1000 on each of two seeds."""
    scores = {
        (cell, seed): EpisodeScore(seed, 1.0, 1.0, -error / 1000.0, 0.0, 0.0, 0.0)
        for cell, pair in errors.items()
        for seed, error in zip(DESIGN.traffic_seeds, pair, strict=True)
    }
    return PenetrationResults(DESIGN, scores)


def made(cell):
    """Return an environment of a cell."""
    return gym.make(DESIGN.env, **DESIGN.keywords(cell)).unwrapped


def test_every_cell_is_run_once_on_every_seed(finished):
    _, results = finished
    assert set(results.scores) == {(c, seed) for c in DESIGN.cells() for seed in (2600, 2601)}
    assert {c.arm for c in DESIGN.cells() if c.release == "paper"} == {
        "fused", "queries", "detectors",
    }  # fmt: skip
    ranked = {(c.estimator, c.policy) for c in DESIGN.cells()}
    assert ("ekf", "inflated-trace") in ranked
    assert ("random_walk", "inflated-trace") not in ranked


def test_detectors_alone_with_the_whole_budget_do_not_depend_on_the_share(finished):
    place, results = finished
    alone = DESIGN.alone("paced", "ekf", cells.WHOLE)
    other = dataclasses.replace(alone, share=1e-6)
    keywords, seeds = DESIGN.keywords(other), DESIGN.traffic_seeds
    task = EpisodeTask(DESIGN.env, "", other, keywords, seeds, place.records)
    errors = [-1000.0 * score.reward for score in run_cell(task)]
    # Another part of another budget is the same noise but for rounding.
    assert errors == pytest.approx(results.values(alone, ERROR), rel=1e-6)


def test_detectors_alone_have_a_part_of_the_budget_or_all_of_it():
    mu = mu_of(cells.EPSILON, cells.DELTA)
    part = made(DESIGN.alone("paced", "ekf", cells.DETECTORS)).process.release
    whole = made(DESIGN.alone("paced", "ekf")).process.release
    assert part.sensors.report().mu == pytest.approx(mu / np.sqrt(1.0 + 3.0 * np.sqrt(0.1)))
    assert whole.sensors.report().mu == pytest.approx(mu)
    assert DESIGN.alone("paper", "ekf") == DESIGN.alone("paper", "ekf", cells.DETECTORS)


def test_queries_alone_have_the_whole_budget_and_no_detector():
    env = made(DESIGN.queries("paced", "ekf", 0.1))
    assert env.config.corridor.fixed_sensors == ()
    assert env.process.release.queries.report().mu == pytest.approx(mu_of(5.0, 0.05))


def test_faults_are_those_of_one_detector():
    high, _, low, _ = DESIGN.faulty("paper", "ekf", (cells.HIGH, cells.LOW))
    assert made(high).config.detectors.factor == pytest.approx((4.0 / 3.0, 1.0))
    assert made(low).config.detectors.factor == pytest.approx((2.0 / 3.0, 1.0))
    _, without = DESIGN.faulty("paper", "ekf", (cells.WITHOUT,))
    assert made(without).config.corridor.fixed_sensors == (1,)
    (misreporting,) = DESIGN.faulty("paper", "ekf", (cells.MISREPORTING,), cells.TESTED)
    assert made(misreporting).config.penetration.misreporting == 0.3
    assert made(misreporting).config.fusion.innovation_test
    assert made(DESIGN.unknown("paper", "ekf")).config.penetration.share == (0.02, 0.3)


def test_losses_are_of_the_mean_over_faults():
    healthy, *faults = DESIGN.faulty("paper", "ekf", (cells.HEALTHY, cells.HIGH))
    results = made_up({healthy: (90, 110), faults[0]: (99, 121), faults[1]: (99, 141)})
    loss = results.loss(faults, healthy)
    assert loss.mean == pytest.approx(15.0)
    assert loss.low < 15.0 < loss.high


def test_queries_are_worth_their_budget_from_the_share_on_that_all_larger_ones_gain():
    alone = {DESIGN.alone("paced", "ekf"): (100, 102)}
    small, large = (DESIGN.fused("paced", "ekf", share) for share in (0.1, 1.0))
    better, no_better = (50, 52), (100, 103)
    assert made_up({**alone, small: better, large: better}).worth("paced", "ekf") == 0.1
    assert made_up({**alone, small: no_better, large: better}).worth("paced", "ekf") == 1.0
    assert made_up({**alone, small: better, large: no_better}).worth("paced", "ekf") is None


def test_both_are_held_against_either_alone(finished):
    _, results = finished
    gains = results.gains()
    pairs = {(release, estimator) for release in DESIGN.releases for estimator in DESIGN.estimators}
    assert gains[cells.QUERIES].keys() == gains[cells.DETECTORS].keys() == pairs
    assert gains[cells.WHOLE].keys() == {("paced", "ekf"), ("paced", "random_walk")}
    both, queries = (
        results.values(cell, ERROR)
        for cell in (DESIGN.fused("paced", "ekf"), DESIGN.queries("paced", "ekf", 0.1))
    )
    gain = gains[cells.QUERIES]["paced", "ekf"]
    assert gain.mean == pytest.approx(100.0 * (1.0 - both.mean() / queries.mean()))
    assert (gain.low > 0.0) == (paired_difference(queries, both).low > 0.0)


def test_the_report_shows_tables_and_figures(finished):
    place, results = finished
    text = (place.folder / "REPORT.md").read_text()
    assert "the command" in text
    error = results.mean(DESIGN.fused("paced", "ekf"), ERROR).mean
    assert f"| `paced`, EKF | {error:.1f} ± " in text
    assert "| `inflated-trace` |" in text
    for name in ("fig_errors.png", "fig_arms.png"):
        assert (place.folder / name).stat().st_size > 10_000


def test_a_finished_study_is_only_rendered_again(finished, monkeypatch):
    place, _ = finished
    before = (place.folder / "REPORT.md").read_bytes()
    monkeypatch.setattr(study, "run_missing", lambda *_: pytest.fail("something was run"))
    study.run(DESIGN, place, "the command")
    assert (place.folder / "REPORT.md").read_bytes() == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "0:2"}, "seeds must be test seeds"),
        ({"corridor": "short-highway"}, "corridor is part of this study"),
        ({"releases": ("none",)}, "releases must be one of"),
        ({"shares": (1.0, 0.1)}, r"shares must ascend and hold base_share 0\.1"),
        ({"shares": (0.3, 1.0)}, r"shares must ascend and hold base_share 0\.1"),
        ({"policies": ("paper",)}, "policies must hold 'round-robin'"),
    ],
)
def test_bad_designs_are_refused_before_anything_is_written(changes, message, tmp_path):
    place = Workplace(tmp_path / "out", LocalProcesses(1))
    with pytest.raises(ValueError, match=message):
        study.run(dataclasses.replace(DESIGN, **changes), place, "")
    assert not place.folder.exists()


def test_the_quick_design_is_small():
    quick = PenetrationDesign().quick()
    quick.check()
    assert len(quick.cells()) < len(PenetrationDesign().cells()) / 5
