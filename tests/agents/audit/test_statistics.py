import math

import numpy as np
import pytest
from scipy.stats import binom, binomtest, norm

from agents.audit.statistics import (
    Claim,
    audit,
    audit_coins,
    error_bound,
)
from dptse_env.privacy import epsilon_of


def gaussian_scores(mu, n, seed):
    """Log-likelihood ratios of N(mu, 1) against N(0, 1) under either: N(-+mu^2/2, mu^2)."""
    z = np.random.default_rng(seed).standard_normal((2, n))
    return mu * z + np.array([[-0.5], [0.5]]) * mu**2


def claim_at(mu, delta=0.05):
    return Claim(mu, epsilon_of(mu, delta), delta)


def test_the_error_bound_is_scipys_and_has_its_coverage():
    trials, risk = 200, 0.0125
    errors = np.arange(trials + 1)
    bounds = error_bound(errors, trials, risk)
    for count in (0, 1, 17, 100, 199, 200):
        # The two-sided interval puts half of its risk above.
        interval = binomtest(count, trials).proportion_ci(1.0 - 2.0 * risk, method="exact")
        assert bounds[count] == pytest.approx(interval.high, rel=1e-12)
    for rate in (0.01, 0.3, 0.9):
        assert binom.pmf(errors[bounds < rate], trials, rate).sum() <= risk


@pytest.mark.parametrize("mu", [0.5, 2.118])
def test_a_true_claim_is_rarely_rejected(mu):
    results = [audit(*gaussian_scores(mu, 1_000, seed), claim_at(mu)) for seed in range(200)]
    rejected = sum(result.verdict == "rejected" for result in results)
    # At most 5 % in truth: more than 18 of 200 then have probability 0.6 %.
    assert rejected <= 18
    # The bound lies close below the truth, by the width of its own confidence interval.
    assert np.median([result.mu.value for result in results]) > mu - 0.4


def one_run(mu, n, seed, claimed=None):
    """The finding on n canaries at a distance of mu."""
    scores, coins = gaussian_scores(mu, n, seed), np.random.default_rng((1, seed))
    thrown = coins.integers(2, size=n)
    return audit_coins(scores[thrown, np.arange(n)], thrown, claim_at(claimed or mu))


@pytest.mark.parametrize(("mu", "n"), [(0.75, 30), (2.118, 20), (2.118, 115)])
def test_the_bound_of_one_run_covers(mu, n):
    bounds = np.array([one_run(mu, n, seed).mu.value for seed in range(1_000)])
    # At most 5 % in truth: more than 72 of 1,000 then have probability 0.1 %.
    assert np.count_nonzero(bounds > mu) <= 72
    assert np.median(bounds) > mu - 6.0 / math.sqrt(n)


def test_the_bounds_rest_on_held_out_runs():
    # A threshold fitted to noise finds a difference in the half that it was fitted to.
    found = [
        audit(*np.random.default_rng(seed).standard_normal((2, 2_000)), Claim(0.01, 0.01, 0.01))
        for seed in range(100)
    ]
    assert sum(result.verdict == "rejected" for result in found) <= 11


def test_both_bounds_follow_from_their_error_rates():
    result = audit(*gaussian_scores(1.5, 2_000, 1), claim_at(1.5))
    scores = gaussian_scores(1.5, 2_000, 1)[:, 1_000:]
    for bound in (result.mu, result.epsilon):
        false_positives = int((scores[0] > bound.threshold).sum())
        false_negatives = int((scores[1] <= bound.threshold).sum())
        assert bound.false_positives == error_bound(false_positives, 1_000, 0.0125)
        assert bound.false_negatives == error_bound(false_negatives, 1_000, 0.0125)
    a, b = result.mu.false_positives, result.mu.false_negatives
    # The trade-off curve of a Gaussian release of that mu passes through the two rates.
    assert norm.cdf(norm.isf(a) - result.mu.value) == pytest.approx(b)
    a, b = result.epsilon.false_positives, result.epsilon.false_negatives
    e = math.exp(result.epsilon.value)
    assert max(1.0 - b - 0.05 - e * a, 1.0 - a - 0.05 - e * b) == pytest.approx(0.0, abs=1e-12)


def test_epsilon_alone_can_reject():
    # Randomised response reveals its bit once in ten and else nothing: a large epsilon at small
    # error rates, but next to nothing at the rates that a bound on mu is best at.
    generator = np.random.default_rng(3)
    scores = generator.standard_normal((2, 5_000))
    scores[1, generator.random(5_000) < 0.3] += 100.0
    claim = Claim(mu=50.0, epsilon=1.0, delta=0.05)
    result = audit(*scores, claim)
    assert result.mu.value < claim.mu
    assert result.epsilon.value > 3.0
    assert result.verdict == "rejected"
    mirrored = audit(-scores[1], -scores[0], claim)
    assert mirrored.epsilon.value > 3.0


def test_worlds_far_apart_are_separated_midway():
    result = audit(*gaussian_scores(24.0, 5_000, 0), claim_at(0.75))
    assert abs(result.mu.threshold) < 100.0  # the scores lie at -288 and 288, with deviation 24
    assert result.mu.false_positives == result.mu.false_negatives == error_bound(0, 2_500, 0.0125)
    # No error in 2,500 runs still leaves a rate of 0.00175 possible.
    assert result.mu.value == pytest.approx(2.0 * norm.isf(0.00175), abs=1e-2)
    assert result.mu.value == pytest.approx(result.most)


REFUSED = [
    (audit, ([0.0], [0.0], claim_at(1.0)), "scores_0 must be two or more"),
    (audit, (np.zeros(3), np.zeros(4), claim_at(1.0)), "scores_1 must be as many .* 4"),
    (audit, (np.zeros(2), [0.0, math.nan], claim_at(1.0)), "scores_1 must be finite"),
    (audit, (np.zeros(2), np.zeros(2), claim_at(1.0), 1.0), "confidence must be"),
    (audit_coins, ([], [], claim_at(1.0)), "scores must be one or more"),
    (audit_coins, ([1.0, 2.0], [0], claim_at(1.0)), "coins must be as many"),
    (audit_coins, ([1.0, math.inf], [0, 1], claim_at(1.0)), "scores must be finite"),
    (Claim, (0.0, 1.0, 0.05), r"claim\.mu must be"),
    (Claim, (1.0, math.inf, 0.05), r"claim\.epsilon must be"),
    (Claim, (1.0, 1.0, 0.5), r"claim\.delta must be"),
]


def test_bad_scores_and_claims_are_named():
    for function, given, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            function(*given)
