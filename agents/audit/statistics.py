r"""Statistics of a privacy audit: lower bounds on the privacy loss from scores in two worlds.

An adversary meets a mechanism many times in each of two adjacent worlds and gives every run a
score, the higher the more the run looks like world 1. A threshold on the score is a test with two
error rates, and privacy bounds both from below together:

$$\mu \ge -\Phi^{-1}(\alpha) - \Phi^{-1}(\beta), \qquad
\varepsilon \ge \log \frac{1 - \delta - \beta}{\alpha}, \quad
\varepsilon \ge \log \frac{1 - \delta - \alpha}{\beta}$$

with $\alpha$ the rate of false positives and $\beta$ that of false negatives (Dong, Roth and Su
2022, section 2). One half of the runs chooses the thresholds. The other half counts the errors,
and exact upper bounds on their rates (Clopper and Pearson 1934) turn into lower bounds here.

In one run, many canaries each have a coin that says in which of two worlds they are, and the
adversary guesses all coins from one transcript (Steinke, Nasr and Jagielski 2023). A mechanism with
$\mu$-Gaussian differential privacy makes him err with probability $\Phi(-\mu/2)$ or more at each.
If, as claimed, the noise of different numbers is independent, and no two canaries move the same
number, the errors are at least as many as those of independent trials at this rate: an exact upper
bound on the rate gives

$$\mu \ge -2 \Phi^{-1}(\bar p).$$

*Proof.* In a trial with a coin, let X be a Brownian motion with drift $\mp 1/2$ by the coin, over a
time of $\mu^2$. The transcript can be made of such motions alone, one for each canary and
independent, and of further noise: what a canary moves in a number, as a multiple D of its noise, is
fixed by what was released before, and the number is read off the next increment of its motion,
over a time of $D^2$; the claim is that these times add up to at most $\mu^2$. Given all motions and
the further noise, every guess is fixed, and the coins are independent: he errs at each with at
least the probability e(X) with which the best guess errs that knows X alone. The e(X) are
independent, and each has the mean $\Phi(-\mu/2)$. $\square$

Rejected is therefore the claim with its independence, which `agents.audit.residuals` tests. Without
it, errors can come together: one number drawn for all canaries would make all guesses right, or all
wrong.

An audit can refute a claim and never prove one. Nothing here depends on traffic.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri
from scipy.stats import beta

from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.validation import (
    POSITIVE,
    Interval,
    checked_fields,
    inside,
    require,
)

_N_RATES = 4  # two thresholds, one for mu and one for epsilon, with two error rates each

# Thresholds are chosen by bounds of this risk. For Gaussian releases every threshold would show
# the same mu, were the rates known: wide bounds keep the choice where rates are known best, and
# not where the estimated rates are low by chance.
_RISK_OF_CHOICE = 1e-5


@dataclass(frozen=True)
class Claim:
    """Claimed privacy parameters, which an audit tests.

    Attributes:
        mu: parameter of Gaussian differential privacy.
        epsilon: privacy parameter.
        delta: privacy parameter.

    Raises:
        ValueError: A number is out of range.
    """

    mu: Annotated[float, POSITIVE]
    epsilon: Annotated[float, POSITIVE]
    delta: Annotated[float, Interval(0, 0.5, open_low=True, open_high=True)]

    def __post_init__(self) -> None:
        """Check the numbers."""
        checked_fields(self, "claim")


@dataclass(frozen=True)
class LowerBound:
    """A lower bound on a privacy parameter, and the test behind it.

    Attributes:
        value: the bound, >= 0.
        threshold: score above which a run is classified as world 1.
        false_positives: upper bound on the rate of runs in world 0 that score above it.
        false_negatives: upper bound on the rate of runs in world 1 that do not.
    """

    value: float
    threshold: float
    false_positives: float
    false_negatives: float


@dataclass(frozen=True)
class AuditResult:
    """Outcome of an audit.

    Attributes:
        claim: the claim that was tested.
        mu: lower bound on mu.
        epsilon: lower bound on epsilon at the claim's delta, for any mechanism. A large
            epsilon shows in rare errors only, so the bound lies well below the truth. None for
            one run.
        confidence: probability with which both bounds hold together.
        n: runs in each world, or canaries of the one run.
    """

    claim: Claim
    mu: LowerBound
    epsilon: LowerBound | None
    confidence: float
    n: int

    @property
    def is_one_run(self) -> bool:
        """True if all scores are of one run."""
        return self.epsilon is None

    @property
    def most(self) -> float:
        """The bound on mu that as many runs or canaries show without any error."""
        risk = 1.0 - self.confidence
        if self.is_one_run:
            return _least_mu(error_bound(0, self.n, risk))
        return _least_mu(error_bound(0, self.n - self.n // 2, risk / _N_RATES))

    @property
    def verdict(self) -> Literal["rejected", "not rejected"]:
        """``rejected`` if a bound lies above the claim."""
        exceeds = self.mu.value > self.claim.mu or (
            self.epsilon is not None and self.epsilon.value > self.claim.epsilon
        )
        return "rejected" if exceeds else "not rejected"


def audit(
    scores_0: npt.ArrayLike, scores_1: npt.ArrayLike, claim: Claim, confidence: float = 0.95
) -> AuditResult:
    """Test a claim on the scores of independent runs.

    Args:
        scores_0: (n,) scores of the runs in world 0, n >= 2.
        scores_1: (n,) scores of the runs in world 1.
        claim: the claim to test; a true one is rejected with probability 1 - confidence at most.
        confidence: in (0, 1).

    Raises:
        ValueError: There are too few scores, they differ in number, or one is not finite.
    """
    worlds = np.asarray(scores_0, dtype=np.float64), np.asarray(scores_1, dtype=np.float64)
    for name, scores in zip(("scores_0", "scores_1"), worlds, strict=True):
        require(scores.ndim == 1 and len(scores) >= 2, name, "two or more numbers", scores.shape)
        require(bool(np.isfinite(scores).all()), name, "finite", scores)
    require(len(worlds[0]) == len(worlds[1]), "scores_1", "as many as scores_0", len(worlds[1]))
    risk = (1.0 - inside("confidence", confidence, 0.0, 1.0)) / _N_RATES

    half = len(worlds[0]) // 2
    chosen = [np.sort(scores[:half]) for scores in worlds]
    held_out = [np.sort(scores[half:]) for scores in worlds]
    candidates = _between(np.unique(np.concatenate(chosen)))
    rates = _error_bounds(chosen, candidates, _RISK_OF_CHOICE)

    def bound(values: FloatArray, parameter: Literal["mu", "epsilon"]) -> LowerBound:
        best = np.flatnonzero(values == values.max())
        threshold = candidates[best[[len(best) // 2]]]
        bounds = _error_bounds(held_out, threshold, risk)
        value = _mu(*bounds) if parameter == "mu" else _epsilon(*bounds, claim.delta)
        false_positives, false_negatives = (float(rate[0]) for rate in bounds)
        return LowerBound(float(value[0]), float(threshold[0]), false_positives, false_negatives)

    return AuditResult(
        claim=claim,
        mu=bound(_mu(*rates), "mu"),
        epsilon=bound(_epsilon(*rates, claim.delta), "epsilon"),
        confidence=confidence,
        n=len(worlds[0]),
    )


def audit_coins(
    scores: npt.ArrayLike, coins: npt.ArrayLike, claim: Claim, confidence: float = 0.95
) -> AuditResult:
    """Test a claim on mu on the scores of the canaries of one run.

    Args:
        scores: (n,) log-likelihood ratios of coin 1, n >= 1; a coin is guessed by the sign.
        coins: (n,) fair and independent coins, 0 or 1.
        claim: the claim to test; a true one is rejected with probability 1 - confidence at most.
        confidence: in (0, 1).

    Raises:
        ValueError: There are no scores, one is not finite, or the coins are not as many.
    """
    told, thrown = np.asarray(scores, dtype=np.float64), np.asarray(coins, dtype=bool)
    require(told.ndim == 1 and told.size > 0, "scores", "one or more numbers", told.shape)
    require(bool(np.isfinite(told).all()), "scores", "finite", told)
    require(thrown.shape == told.shape, "coins", "as many as scores", thrown.shape)
    risk = 1.0 - inside("confidence", confidence, 0.0, 1.0)
    errors, n = int(np.count_nonzero((told > 0.0) != thrown)), told.size
    rate = float(error_bound(errors, n, risk))
    bound = LowerBound(_least_mu(rate), 0.0, rate, rate)
    return AuditResult(claim, bound, None, confidence, n)


def error_bound(errors: npt.ArrayLike, trials: int, risk: float) -> FloatArray:
    """Exact upper confidence bound on an error rate (Clopper and Pearson 1934), of any shape.

    It is the rate at which so few errors among the trials or fewer have probability `risk`, in
    (0, 1), and 1 where all trials are errors.
    """
    counts = np.asarray(errors, dtype=np.float64)
    # Where all trials are errors the distribution has no second parameter above zero.
    some_right = np.minimum(counts, trials - 1.0)
    rates = beta.ppf(1.0 - risk, some_right + 1.0, trials - some_right)
    bounds: FloatArray = np.where(counts >= trials, 1.0, rates)
    return bounds


def _least_mu(rate: npt.ArrayLike) -> float:
    """Return the least mu at which both errors have this rate."""
    return max(-2.0 * float(ndtri(rate)), 0.0)


def _between(scores: FloatArray) -> FloatArray:
    """Midpoints of increasing scores, so that a threshold separates worlds that do not overlap."""
    return 0.5 * (scores[1:] + scores[:-1]) if len(scores) > 1 else scores


def _error_bounds(
    scores: list[FloatArray], thresholds: FloatArray, risk: float
) -> tuple[FloatArray, FloatArray]:
    """Upper bounds on both error rates of each threshold; `scores` are sorted."""
    below_0, below_1 = (np.searchsorted(world, thresholds, side="right") for world in scores)
    trials = len(scores[0])
    return error_bound(trials - below_0, trials, risk), error_bound(below_1, trials, risk)


def _mu(false_positives: FloatArray, false_negatives: FloatArray) -> FloatArray:
    bound: FloatArray = np.maximum(-ndtri(false_positives) - ndtri(false_negatives), 0.0)
    return bound


def _epsilon(false_positives: FloatArray, false_negatives: FloatArray, delta: float) -> FloatArray:
    """The larger of the two bounds; zero where neither is informative."""
    ratios = np.maximum(
        (1.0 - delta - false_negatives) / false_positives,
        (1.0 - delta - false_positives) / false_negatives,
    )
    return np.log(np.maximum(ratios, 1.0))
