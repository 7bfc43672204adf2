r"""Exact relations of Gaussian differential privacy.

A single number describes the privacy loss of a Gaussian release, $\mu = \Delta / \sigma$: its L2
sensitivity over the standard deviation of the noise. A release with parameter $\mu$ is
$(\varepsilon, \delta)$-private exactly for the pairs with (Balle and Wang 2018, theorem 8)

$$\delta = \Phi(\mu/2 - \varepsilon/\mu) - e^{\varepsilon}\,\Phi(-\mu/2 - \varepsilon/\mu),$$

and releases compose as $\mu^2 = \sum_i \mu_i^2$, also without loss (Dong, Roth and Su 2022,
corollary 3.3).

All numbers here are dimensionless floats. `epsilon` is finite and above zero, `delta` lies in
(0, 0.5), `mu`, the sensitivity over the noise's standard deviation, is finite and above zero;
functions raise ValueError for other arguments. The difference above is never formed in that shape:
`e^epsilon` overflows from epsilon 710, and both terms underflow together in the tail. With the
normal density $\varphi$, $\varphi(a) = e^{\varepsilon} \varphi(b)$ for the two arguments $a$ and
$b$, so the second term is $\varphi(a)$ times a ratio that stays of order one.
"""

import math
from collections.abc import Sequence
from decimal import ROUND_CEILING, Decimal, localcontext
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import brentq
from scipy.special import erfcx, log_ndtr, ndtri

from dptse_env.privacy.sensitivity import Sensitivity
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.validation import inside, integer, positive, require

DELTAS = ("1e-2", "1e-3", "1e-4", "1e-5", "1e-6")
"""Values of delta at which reports give epsilon."""

TRIPS = (1, 2, 10, 50, 250)
"""Numbers of trips that an account over days is given for."""

ROUNDING = 2.0**-30
"""Part of every privacy budget mu^2 that is kept back for rounding in double precision.

With u = 2^-53 it covers, each relative to the budget:

- the sum of `MOST_PAYMENTS` payments in a ledger, every addition of which rounds by u of a sum that
  never exceeds the budget: 2^22 u = 2^-31;
- a payment and the deviations of the noise that it is computed with, a dozen roundings: 2^-49;
- `mu_of`, whose relative error is below 2e-12: 4e-12 of mu^2.

Together that is 0.51 of it.
"""

MOST_PAYMENTS = 2**22
"""Largest number of payments of one vehicle from a ledger that `ROUNDING` covers."""

N_LEVELS = 256
"""Levels of mu at which an `EpsilonTable` has epsilon; one between them is rounded up."""

_RELATIVE_TOLERANCE = 4 * 2.0**-52  # the tightest that brentq accepts
_SQRT_TWO = math.sqrt(2.0)
_SQRT_HALF_PI = math.sqrt(0.5 * math.pi)
_LOG_SQRT_TWO_PI = 0.5 * math.log(2.0 * math.pi)
_ZERO_BELOW = -40.0  # delta < Phi(-40) = 4e-350, less than the smallest float
_SMALL_MU = 1e-3  # below it the two terms of delta agree in too many digits to be subtracted


def require_covered(payments: int) -> None:
    """Refuse more payments of one vehicle than `ROUNDING` covers.

    Raises:
        ValueError: See above.
    """
    allowed = f"shorter: a vehicle may pay {MOST_PAYMENTS} times at most"
    require(payments <= MOST_PAYMENTS, "horizon", allowed, f"{payments} payments")


def delta_of(mu: float, epsilon: float) -> float:
    """Smallest delta for which a release of parameter `mu` is (epsilon, delta)-private.

    It lies in [0, 1], and is zero when the exact value is below the smallest positive float (Balle
    and Wang 2018, theorem 8). An `epsilon` of 0 is allowed and gives the total variation distance.
    """
    mu = positive("mu", mu)
    if epsilon != 0:
        epsilon = positive("epsilon", epsilon)
    return math.exp(_log_delta(mu, epsilon))


def epsilon_of(mu: float, delta: float) -> float:
    """Smallest epsilon >= 0 for which a release of parameter `mu` is (epsilon, delta)-private.

    It is exact to ten digits or better up to a mu of 1e3.

    Raises:
        OverflowError: epsilon is beyond the largest float, from a mu of about 1e154.
    """
    mu = positive("mu", mu)
    delta = _checked_delta(delta)
    log_delta = math.log(delta)

    def excess(epsilon: float) -> float:
        return _log_delta(mu, epsilon) - log_delta

    if excess(0.0) <= 0.0:
        return 0.0
    # Dropping the subtracted term of delta gives an epsilon that is too large, in closed form.
    # The margin keeps the bracket valid where that term is lost to rounding.
    high = (0.5 * mu - float(ndtri(delta))) * mu * (1.0 + 1e-9)
    if math.isinf(high):
        raise OverflowError(f"epsilon is beyond the largest float at mu {mu!r}")
    return float(brentq(excess, 0.0, high, xtol=1e-16 * high, rtol=_RELATIVE_TOLERANCE))


def epsilons_of(mu: float) -> dict[str, float]:
    """Return epsilon at each of `DELTAS`, by its name."""
    return {name: epsilon_of(mu, float(name)) for name in DELTAS}


def over_trips(mu: float, trips: Sequence[int] = TRIPS) -> dict[int, dict[str, float]]:
    """Privacy loss of one vehicle that makes several trips, each of parameter `mu`.

    With independent noise n trips have the parameter mu sqrt(n) (Dong, Roth and Su 2022, corollary
    3.3). A vehicle that changes its pseudonym remains one vehicle here.

    Returns:
        For each number of trips ``"mu"``, and epsilon by the name of each of `DELTAS`.
    """
    mus = {n: positive("mu", mu) * math.sqrt(integer("trips", n, 1)) for n in trips}
    return {n: {"mu": total, **epsilons_of(total)} for n, total in mus.items()}


def rounded_up(loss: float, form: str = ".5g") -> str:
    """Return a privacy loss as text of a format, which states no less than there is."""
    with localcontext(rounding=ROUND_CEILING):
        rounded = float(format(Decimal(repr(float(loss))), form))
    return format(rounded, form)


def mu_of(epsilon: float, delta: float) -> float:
    """Largest parameter mu of a release that is (epsilon, delta)-private.

    The inverse of `delta_of` in its first argument. Its relative error is below 2e-12 where epsilon
    lies in [1e-4, 1e4] and delta is at least 1e-12.
    """
    epsilon, delta = positive("epsilon", epsilon), _checked_delta(delta)
    log_delta = math.log(delta)

    def excess(mu: float) -> float:
        return _log_delta(mu, epsilon) - log_delta

    # Le Ny's closed form drops the subtracted term, and so bounds mu from below. The margin keeps
    # the bracket valid where that term is lost to rounding.
    low = (1.0 - 1e-9) / le_ny_kappa(epsilon, delta)
    high = 2.0 * low
    while excess(high) < 0.0:
        low, high = high, 2.0 * high
    return float(brentq(excess, low, high, xtol=1e-16 * low, rtol=_RELATIVE_TOLERANCE))


def le_ny_kappa(epsilon: float, delta: float) -> float:
    """Noise standard deviation per unit of sensitivity that suffices, in closed form.

    It is (K + sqrt(K^2 + 2 epsilon)) / (2 epsilon) with K the upper delta-quantile of the standard
    normal (Le Ny and Pappas 2014, theorem 3; section III of the paper). That bounds delta by the
    first of its two terms, so the result is always above the least multiplier, 1 / `mu_of`.
    """
    epsilon, delta = positive("epsilon", epsilon), _checked_delta(delta)
    quantile = -float(ndtri(delta))
    return (quantile + math.sqrt(quantile * quantile + 2.0 * epsilon)) / (2.0 * epsilon)


def printed_noise_std(sensitivity: Sensitivity, epsilon: float, delta: float) -> tuple[float, ...]:
    """Noise of *variance* kappa^2 Delta for each release, as printed in section III of the paper.

    A variance in veh/km cannot be right: the number depends on the units, here veh/km and km/h.
    """
    kappa = le_ny_kappa(epsilon, delta)
    return tuple(kappa * math.sqrt(release.bound) for release in sensitivity.releases)


def single_noise_std(sensitivity: Sensitivity, epsilon: float, delta: float) -> tuple[float, ...]:
    """Noise of standard deviation kappa Delta for each release by itself, in its unit.

    Le Ny and Pappas (2014), theorem 3. Nothing accounts for the releases together.
    """
    kappa = le_ny_kappa(epsilon, delta)
    return tuple(kappa * release.bound for release in sensitivity.releases)


def joint_noise_std(
    sensitivity: Sensitivity, epsilon: float, delta: float, share: float
) -> tuple[float, ...]:
    """Noise under which two releases together are (epsilon, delta)-private, analytic calibration.

    The budget mu^2 is divided between the sensitivities that can occur together. A release that
    has a larger sensitivity on its own gets the noise that this needs. `share`, in (0, 1), is the
    part of mu^2 for the first release.
    """
    mu = mu_of(epsilon, delta)
    alone = tuple(release.bound for release in sensitivity.releases)
    together = sensitivity.extremes[0] if sensitivity.extremes else alone
    shares = share, 1.0 - share
    return tuple(
        max(bound / math.sqrt(part), largest) / mu
        for bound, part, largest in zip(together, shares, alone, strict=True)
    )


class EpsilonTable:
    """Epsilon at fixed levels of mu, so that a step takes no root finding.

    Attributes:
        mu: The largest mu, that of a complete episode.
    """

    def __init__(self, mu: float, delta: float) -> None:
        """Store the numbers of a complete episode."""
        self.mu, self._delta = mu, delta

    @cached_property
    def _epsilons(self) -> FloatArray:
        """Epsilon at the levels of mu, shape (N_LEVELS + 1,)."""
        levels = self.mu * np.arange(1, N_LEVELS + 1) / N_LEVELS
        return np.array([0.0, *(epsilon_of(mu, self._delta) for mu in levels.tolist())])

    def bounds(self, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mu, held to the largest, and epsilon, rounded up to one of 256 levels of mu."""
        mu = np.minimum(mu, self.mu)
        level = np.ceil(mu / self.mu * N_LEVELS).astype(np.int64)
        return mu, self._epsilons[level]


class ReleaseAccount:
    """Privacy loss of a vehicle by the number of released steps that its data may have entered.

    Attributes:
        mu: Parameter of Gaussian differential privacy of a complete episode.
        delta: The delta at which epsilon is given.
        contributions: C, released steps that a vehicle's data can enter; None if not bounded.
    """

    def __init__(self, mu: float, delta: float, contributions: int | None) -> None:
        """Store the numbers of a complete episode."""
        self.mu, self.delta, self.contributions = mu, delta, contributions

    @cached_property
    def _tables(self) -> tuple[FloatArray, FloatArray]:
        """Values of mu and epsilon after 0..C steps."""
        n = self.contributions
        mu = self.mu * np.sqrt(np.arange(n + 1) / n) if n else np.array([self.mu])
        return mu, np.array([_exact_epsilon(value, self.delta) for value in mu.tolist()])

    def spent(self, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds on the privacy loss of a vehicle, if the sensitivities hold.

        Where contributions are bounded, a vehicle makes at most one per step. The paper's
        sensitivities bound a complete episode and no part of it, so a complete episode is charged
        from the start. `steps` is the number of steps released so far in each of k episodes, and
        the result mu and epsilon at `delta` of all releases together, shape (k,) each.
        """
        mu, epsilon = self._tables
        charged = np.minimum(steps, len(mu) - 1)
        return mu[charged], epsilon[charged]

    def epsilons(self, squares: FloatArray) -> list[float]:
        """Return the exact epsilon of vehicles that have spent these parts of mu^2, shape (m,)."""
        mus = np.sqrt(np.minimum(squares, self.mu**2))
        return [_exact_epsilon(mu, self.delta) for mu in mus.tolist()]


@lru_cache(maxsize=2**16)
def _exact_epsilon(mu: float, delta: float) -> float:
    return epsilon_of(mu, delta) if mu > 0.0 else 0.0


def _checked_delta(delta: float) -> float:
    return inside("delta", delta, 0.0, 0.5)


def _log_delta(mu: float, epsilon: float) -> float:
    """Natural logarithm of delta, without overflow or underflow; see the module's docstring."""
    upper = 0.5 * mu - epsilon / mu
    if upper < _ZERO_BELOW:
        return -math.inf
    if mu < _SMALL_MU:
        # Difference of the Mills ratio over mu around t, by its first and third derivatives.
        t = epsilon / mu
        ratio = _mills_ratio(t)
        first = t * ratio - 1.0
        third = 2.0 * first + t * (ratio + t * first)
        difference = -mu * (first + mu * mu / 24.0 * third)
        return math.log(difference) - 0.5 * upper * upper - _LOG_SQRT_TWO_PI
    lower_over_upper = _mills_ratio(0.5 * mu + epsilon / mu) / _mills_ratio(-upper)
    return float(log_ndtr(upper)) + math.log1p(-lower_over_upper)


def _mills_ratio(t: float) -> float:
    """Phi(-t) / phi(t): 1/t far to the right, and infinite in floats from t = -37 down."""
    return _SQRT_HALF_PI * float(erfcx(t / _SQRT_TWO))
