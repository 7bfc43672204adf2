import dataclasses

import numpy as np
import pytest
from scipy import stats

from agents.suite.scoring import normalised_score, scores, suite_score

from .small import SMALL
from .test_card import BAD, CARD, RESULT

ZERO = dataclasses.replace(RESULT, error=(100.0, 110.0, 120.0))
ONE = dataclasses.replace(RESULT, error=(60.0, 50.0, 70.0))


def test_the_references_have_zero_and_one():
    for result, expected in ((ZERO, 0.0), (ONE, 1.0)):
        score = normalised_score(result, ZERO, ONE)
        assert (score.mean, score.half_width) == (expected, pytest.approx(0.0, abs=1e-12))


def test_a_score_is_the_share_of_the_way_to_the_oracle():
    result = dataclasses.replace(RESULT, error=(80.0, 90.0, 70.0))
    score = normalised_score(result, ZERO, ONE)
    assert score.mean == pytest.approx(30.0 / 50.0)
    gained = np.array([20.0, 20.0, 50.0]) - 0.6 * np.array([40.0, 60.0, 50.0])
    half = stats.t.ppf(0.975, 2) * stats.sem(gained) / 50.0
    assert (score.low, score.high) == pytest.approx((0.6 - half, 0.6 + half))
    better = dataclasses.replace(RESULT, error=(40.0, 40.0, 40.0))
    assert normalised_score(better, ZERO, ONE).mean == pytest.approx(70.0 / 50.0)


def test_without_a_scale_or_the_same_traffic_there_is_no_score():
    with pytest.raises(ValueError, match="'plain' the error oracle is no better"):
        normalised_score(RESULT, ONE, ZERO)
    other = dataclasses.replace(ONE, traffic_seeds=(1, 2, 3))
    with pytest.raises(ValueError, match="'plain' must be of the same traffic seeds"):
        normalised_score(RESULT, ZERO, other)


def card_of(result):
    return dataclasses.replace(
        CARD,
        results={cell.name: dataclasses.replace(result, cell=cell.name) for cell in SMALL.cells},
    )


def test_the_score_of_a_suite_needs_every_cell():
    zero, one = card_of(ZERO), card_of(ONE)
    whole = card_of(dataclasses.replace(RESULT, error=(80.0, 80.0, 95.0)))
    assert suite_score(scores(whole, zero, one, SMALL), SMALL) == pytest.approx(0.5)
    failed = dataclasses.replace(whole, results={**whole.results, "wide": BAD})
    found = scores(failed, zero, one, SMALL)
    assert set(found) == {"plain", "paced"}
    assert suite_score(found, SMALL) is None
