"""Each claim on made-up numbers, once where it holds and once where it does not."""

import dataclasses

import numpy as np
import pytest

from agents.studies.paper.claims import judge
from agents.studies.paper.paper_claims import CLAIMS, PROJECT_TARGETS
from agents.studies.paper.plan import SETTINGS
from agents.studies.paper.results import PaperResults, correlations, roughness, slopes
from tests.agents.studies.paper.made_up import DESIGN, make_up

BY_KEY = {claim.key: claim for claim in (*CLAIMS, *PROJECT_TARGETS)}
RANKS = {"ukf": 10.0, "ekf": 10.2, "mhe": 10.3, "enkf": 12.0, "random_walk": 15.0}


def paper_world(cell):
    """Density errors in which all that the paper says of density is true."""
    if cell.estimator == "open_loop":
        return 80.0
    jagged = 0.4 * (cell.bandwidth % 2) if cell.estimator == "enkf" else 0.0
    privacy = 1.0 + 0.05 * (1.0 / cell.epsilon - 1.0) - 0.01 * np.log10(cell.delta / 0.05)
    return RANKS[cell.estimator] * privacy - 0.5 * (cell.bandwidth - 5) + jagged


def paper_speed(cell):
    """Speed errors in which all that the paper says of speed is true."""
    factor = 1.1 if cell.estimator == "mhe" else 1.0
    return factor * paper_world(cell)


PAPER_TIMES = {"ukf": 1.0, "enkf": 1.5, "mhe": 1.7, "ekf": 2.3}
TRUE = make_up(paper_world, paper_speed, PAPER_TIMES)
LIKE = make_up(paper_world, paper_world, PAPER_TIMES)


def instead(name, error, rest=paper_world):
    """The paper's errors but for one estimator."""
    return lambda cell: error(cell) if cell.estimator == name else rest(cell)


def constant(value):
    return lambda cell: value


def jagged(cell):
    return paper_world(cell) + (3.0 * (cell.bandwidth % 2) if cell.estimator != "enkf" else 0.0)


# Density and speed errors, and times, with which each claim is wrong, as little else as may be.
FALSE = {
    "P1": (instead("mhe", lambda cell: 5.0 + cell.bandwidth), paper_speed),
    "P2": (paper_world, instead("mhe", lambda cell: 5.0 + cell.bandwidth, paper_speed)),
    "P3": (instead("ukf", constant(11.0)), paper_speed),
    "P4": (paper_world, instead("ukf", constant(11.0), paper_speed)),
    "P5": (instead("enkf", constant(5.0)), paper_speed),
    "P6": (paper_world, instead("enkf", constant(5.0), paper_speed)),
    "P7": (instead("ekf", constant(20.0)), paper_speed),
    "P8": (paper_world, instead("ekf", constant(20.0), paper_speed)),
    "P9": (paper_world, instead("mhe", constant(5.0), paper_speed)),
    "P10": (instead("mhe", constant(5.0)), paper_world),
    "P11": (jagged, paper_speed),
    "P12": (instead("ukf", lambda cell: 10.0 + 0.2 / cell.delta), paper_speed),
    "P13": (instead("enkf", constant(5.0)), paper_speed),
    "P14": (instead("mhe", lambda cell: 5.0 + cell.epsilon), paper_speed),
    "P15": (paper_world, lambda cell: 100.0 - paper_world(cell)),
    "P16": (instead("ekf", lambda cell: 10.0 - 2.0 * np.log10(cell.delta)), paper_speed),
    "P17": (instead("ekf", lambda cell: 10.0 - 5.0 * np.log10(cell.delta)), paper_speed),
    "P18": (instead("ekf", lambda cell: 10.0 / cell.epsilon), paper_speed),
    "P19": (instead("ekf", lambda cell: 10.0 + 0.01 / cell.epsilon), paper_speed),
    "P20": (paper_world, paper_speed, {**PAPER_TIMES, "ekf": 0.5}),
    "T1": (instead("random_walk", constant(11.0)), paper_speed),
    "T2": (paper_world, instead("random_walk", constant(11.0), paper_speed)),
    "T3": (instead("open_loop", constant(11.0)), paper_speed),
    "T4": (paper_world, instead("open_loop", constant(11.0), paper_speed)),
}


def verdict(key, results):
    return judge(BY_KEY[key], results, SETTINGS[1]).verdict


# P10 asks both of density and of speed, where P9 asks the contrary of speed.
@pytest.mark.parametrize("key", [key for key in BY_KEY if key != "P10"])
def test_it_holds_where_it_is_true(key):
    assert verdict(key, TRUE) == "holds"


def test_comparable_errors_are_found_so():
    assert verdict("P10", LIKE) == "holds"
    assert verdict("P9", LIKE) == "holds"
    assert verdict("P10", TRUE) == "does not hold"


@pytest.mark.parametrize("key", BY_KEY)
def test_it_does_not_hold_where_it_is_false(key):
    assert verdict(key, make_up(*FALSE[key])) == "does not hold"


def test_seeds_that_disagree_leave_it_open():
    noisy = make_up(paper_world, paper_speed)
    generator = np.random.default_rng(1)
    scores = {
        key: dataclasses.replace(score, rmse_density=float(generator.uniform(5.0, 50.0)))
        for key, score in noisy.scores.items()
    }
    results = PaperResults(DESIGN, scores, noisy.times)
    assert verdict("P3", results) == "undecided"
    assert verdict("P1", results) == "undecided"


def test_claims_about_what_was_not_run_are_not_measured():
    part = make_up(paper_world, design=dataclasses.replace(DESIGN, estimators=("ekf", "ukf")))
    assert verdict("P8", part) == "holds"
    assert verdict("P1", part) == "not measured"
    assert verdict("P20", part) == "not measured"


def test_intervals_of_correlations_stay_within_one():
    for key in ("P14", "P15"):
        for interval, _ in judge(BY_KEY[key], TRUE, SETTINGS[0]).parts.values():
            assert -1.0 < interval.low <= interval.mean <= interval.high < 1.0


def test_every_claim_is_measured_with_all_seeds():
    for claim in BY_KEY.values():
        for interval, _ in judge(claim, TRUE, SETTINGS[0]).parts.values():
            assert interval.n == (3 if claim.key == "P20" else 6)


def test_slopes_are_those_of_least_squares():
    places = np.array([5.0, 6.0, 8.0])
    curve = np.random.default_rng(0).normal(size=(3, 4))
    expected = np.polyfit(places, curve, 1)[0]
    np.testing.assert_allclose(slopes(places, curve), expected)


def test_a_straight_line_is_not_rough():
    line = np.outer([1.0, 3.0, 5.0, 7.0], [1.0, -2.0])
    np.testing.assert_allclose(roughness(line), 0.0, atol=1e-12)
    np.testing.assert_allclose(roughness(np.array([[0.0], [1.0], [0.0], [1.0]])), 2.0)


def test_correlations_are_numpy_s():
    a, b = np.random.default_rng(0).normal(size=(2, 5, 3))
    expected = [np.corrcoef(a[:, k], b[:, k])[0, 1] for k in range(3)]
    np.testing.assert_allclose(correlations(a, b), expected)
