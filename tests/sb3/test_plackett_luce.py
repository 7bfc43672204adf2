"""The Plackett-Luce distribution over ordered sets."""

import itertools
import math

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch

from dptse_env.sb3 import PlackettLuce

SCORES = torch.tensor([[0.3, -1.2, 2.0, 0.1], [5.0, 5.0, -5.0, 0.0]], dtype=torch.float64)


def by_formula(scores, chosen):
    """The product of softmax probabilities over those left, in plain Python."""
    left, probability = list(range(len(scores))), 1.0
    for item in chosen:
        probability *= math.exp(scores[item]) / sum(math.exp(scores[i]) for i in left)
        left.remove(item)
    return probability


def sets_of(scores, size):
    return PlackettLuce(size).proba_distribution(scores)


def all_sets(n, size):
    return torch.tensor(list(itertools.permutations(range(n), size)))


def over_all(scores, size):
    """A distribution repeated for each ordered set, and these."""
    sets = all_sets(len(scores), size)
    return sets_of(scores.expand(len(sets), -1), size), sets


@pytest.mark.parametrize("size", [1, 2, 4])
def test_probabilities_are_the_formula_and_sum_to_one(size):
    for row in SCORES:
        distribution, sets = over_all(row, size)
        probabilities = distribution.log_prob(sets).exp().tolist()
        expected = [by_formula(row.tolist(), chosen.tolist()) for chosen in sets]
        assert probabilities == pytest.approx(expected, rel=1e-12)
        assert sum(probabilities) == pytest.approx(1.0, rel=1e-12)


def test_draws_follow_the_probabilities():
    distribution, sets = over_all(SCORES[0], 2)
    torch.manual_seed(0)
    n = 200_000
    drawn = sets_of(SCORES[:1].expand(n, -1), 2).sample()
    counts = (drawn[:, None, :] == sets).all(dim=2).sum(dim=0).numpy()
    assert counts.sum() == n
    probabilities = distribution.log_prob(sets).exp().numpy()
    chi_squared = ((counts - n * probabilities) ** 2 / (n * probabilities)).sum()
    assert chi_squared < 31.3  # 99.9 % of a chi-squared variable of 11 degrees


def test_the_mode_is_the_highest_scores_and_ties_go_upstream():
    assert sets_of(SCORES, 3).mode().tolist() == [[2, 0, 3], [0, 1, 3]]
    assert sets_of(torch.zeros(1, 70), 40).mode().tolist() == [list(range(40))]


@pytest.mark.parametrize("spread", [0.0, 1e3, 3e38])
def test_extreme_scores_stay_finite_in_single_precision(spread):
    scores = (spread * torch.tensor([[1.0, -1.0, 0.5, 0.0, 1.0, -1.0]])).repeat(64, 1)
    scores.requires_grad_()
    distribution = sets_of(scores, 4)
    torch.manual_seed(1)
    for sets in (distribution.sample(), torch.tensor([[5, 1, 3, 2]]).repeat(64, 1)):
        assert (sets.sort(dim=1).values.diff(dim=1) > 0).all()
        logs = distribution.log_prob(sets)
        assert logs.dtype == torch.float32
        assert torch.isfinite(logs).all()
        (gradient,) = torch.autograd.grad(logs.sum(), scores, retain_graph=True)
        assert torch.isfinite(gradient).all()


def test_bad_scores_and_sets_are_refused():
    with pytest.raises(ValueError, match=r"size must be in 1\.\.3, got 4"):
        sets_of(torch.zeros(1, 3), 4)
    with pytest.raises(ValueError, match="scores must be finite"):
        sets_of(torch.tensor([[0.0, torch.inf]]), 1)
    pairs = sets_of(SCORES, 2)
    with pytest.raises(ValueError, match=r"shape \(2, 2\), got \(2, 3\)"):
        pairs.log_prob(torch.tensor([[1, 2, 3], [0, 1, 2]]))
    with pytest.raises(RuntimeError, match="out of bounds"):
        pairs.log_prob(torch.tensor([[1, 4], [0, 2]]))
    assert pairs.log_prob(torch.tensor([[1, 1], [0, 2]])).isneginf().tolist() == [True, False]


def test_the_bonus_is_the_entropy_of_one_draw_times_the_draws():
    probabilities = SCORES.softmax(dim=1).numpy()
    entropy = -(probabilities * np.log(probabilities)).sum(axis=1)
    for size in (1, 3):
        np.testing.assert_allclose(sets_of(SCORES, size).entropy(), size * entropy)
