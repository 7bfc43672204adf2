"""The noise of some episodes: what is released, less what would be released without noise.

A mechanism that states sigma claims that these residuals over sigma are independent standard normal
numbers. They are tested for less noise than that, and for noise that is used again; more noise
than stated is no fault here. A fault in what noise is added to does not show.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import ndtr
from scipy.stats import chi2, halfnorm, kstest

from agents.audit.attack import make_overheard
from agents.audit.worlds import Trajectory, Worlds
from dptse_env.config import EnvConfig
from dptse_env.release import Queries
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, FloatArray

RISK = 1e-4
"""Probability of refusing noise that is as stated."""

BATCH, ROUNDS = 2, 2
"""Episodes that are played at once, and how often: noise may be shared, or outlive a reset."""

FEWEST = 10.0
"""Least sum of squares by which a correlation is divided: that of some ten numbers."""

AXES, QUANTITIES = ("second", "channel", "quantity"), ("density", "speed")


@dataclass(frozen=True)
class NoiseTest:
    """Agreement of residuals with independent noise that is no smaller than stated.

    Attributes:
        n: Number of residuals.
        p_value: Probability that any property is as unlikely as the most unlikely one.
        suspect: This property, in words.
    """

    n: int
    p_value: float
    suspect: str

    @property
    def is_rejected(self) -> bool:
        """True where the probability is below `RISK`."""
        return self.p_value < RISK


def residuals_of(
    config: EnvConfig, record: Record, *, noise_factor: float = 1.0, seed: int = 0
) -> FloatArray:
    """Play episodes of random queries; return their residuals over sigma, one after the other.

    Args:
        config: The configuration under attack.
        record: The traffic.
        noise_factor: Multiplies the real noise, not the declared one.
        seed: Seeds queries and noise, >= 0.

    Returns:
        Shape (4 horizon, C, 2), NaN where nothing was released.

    Raises:
        ValueError: The release model does not let itself be checked: not all of its noise is that
            of a `dptse_env.release.noise.Noise`, or it does not state how large it is.
    """
    alike = Worlds.adjacent(record, (Trajectory.absent(), Trajectory.absent()))
    process, release = make_overheard(config, alike, BATCH, noise_factor)
    generator, every, name = np.random.default_rng(seed), np.arange(BATCH), release.task.name
    found = []
    for _ in range(ROUNDS):
        process.reset(
            every, generator.spawn(BATCH), {"traffic_seed": np.zeros(BATCH, int), "start": 0}
        )
        for _ in range(config.horizon_steps):
            plan = random_plan(release.task.queries, BATCH, generator)
            process.step(every, plan.astype(np.int8))
            if release.square.any():
                raise ValueError(
                    "the audit needs a release model whose attribute noise is all that is random, "
                    f"got {name!r}, which twice released other numbers without it"
                )
            last, (true, _) = release.last, release.means
            found.append(np.full(true.shape, np.nan))
            found[-1][last.observed] = ((last.values - true) / last.sigma)[last.observed]
    rows = np.array(found).reshape(ROUNDS, -1, *true.shape)
    return rows.swapaxes(1, 2).reshape(-1, *true.shape[1:])


def random_plan(queries: Queries, n: int, generator: np.random.Generator) -> BoolArray:
    """Return as many random queries as can be paid for n times, (n, G)."""
    ranked = np.argsort(generator.random((n, queries.n_queries)), axis=1)
    paid = np.cumsum(queries.cost[ranked], axis=1) <= queries.bandwidth
    plan = np.zeros(ranked.shape, dtype=bool)
    np.put_along_axis(plan, ranked, paid, axis=1)
    return plan


def examine(residuals: FloatArray) -> NoiseTest:
    """Test residuals over sigma, shape (n, C, 2), for independent noise that is no smaller.

    Sums of squares by second, channel and quantity follow a chi-square law, and no size is exceeded
    less often than by a normal number. Products with later numbers are tested for each lag [s], for
    each pair of channels and quantities, and for all pairs as far apart together: given the earlier
    numbers y, the sum of x y over the root of that of y^2 is a standard normal number. Bonferroni's
    correction is for all tests.
    """
    seen = np.isfinite(residuals)
    known = np.where(seen, residuals, 0.0)
    sizes = kstest(np.abs(residuals[seen]), halfnorm.cdf, alternative="greater")
    at = f"many numbers below {sizes.statistic_location:.2f} of the stated deviation"
    tests = [(float(sizes.pvalue), at), *_squares(known, seen), *_products(known, seen)]
    p_value, suspect = min(tests)
    return NoiseTest(int(seen.sum()), min(len(tests) * p_value, 1.0), suspect)


def _squares(known: FloatArray, seen: BoolArray) -> Iterator[tuple[float, str]]:
    """Yield the probability of so little noise in any second, channel and quantity."""
    for axis, name in enumerate(AXES):
        others = tuple(each for each in range(3) if each != axis)
        n, squares = seen.sum(axis=others), np.sum(known**2, axis=others)
        tails = np.where(n > 0, chi2.cdf(squares, np.maximum(n, 1)), 1.0)
        worst = int(np.argmin(tails))
        what = QUANTITIES[worst] if name == "quantity" else worst
        size = np.sqrt(squares[worst] / n[worst])
        yield (
            float(tails[worst] * np.count_nonzero(n)),
            f"{size:.3f} times the stated deviation in {name} {what}",
        )


def _products(known: FloatArray, seen: BoolArray) -> Iterator[tuple[float, str]]:
    """Yield the probability of so large a correlation of any two series, and of all as apart.

    A series is a quantity of a channel.
    """
    n, n_channels = len(known), known.shape[1]
    x, seen = known.reshape(n, -1), seen.reshape(n, -1)
    # More noise than stated correlates no more.
    scale = np.sqrt(np.sum(x**2, axis=0) / np.maximum(seen.sum(axis=0), 1))
    x = x / np.where(scale > 0.0, scale, 1.0)
    size = next_fast_len(2 * n)
    values, squares, flags = (rfft(each, size, axis=0) for each in (x, x**2, seen.astype(float)))
    # How many channels and quantities two series are apart, as one number.
    place = 3 * np.repeat(np.arange(n_channels), 2) + np.tile([0, 1], n_channels)
    apart, pairs = np.zeros((2, n, 6 * n_channels)), []
    for i in range(x.shape[1]):
        terms = (values[:, [i]], values), (squares[:, [i]], flags)
        both = np.array([irfft(y.conj() * later, size, axis=0)[:n] for y, later in terms])
        both[:, 0, : i + 1] = 0.0
        apart[:, :, place - place[i] + 3 * n_channels] += both
        most = _largest(*both)
        names = (f"the {QUANTITIES[each % 2]} of channel {each // 2}" for each in (i, most.series))
        pairs.append((most, " and ".join(names)))
    together = _largest(*apart)
    channels, quantities = divmod(together.series - 3 * n_channels + 1, 3)
    words = f"every number and that {channels} channels and {quantities - 1} quantities further"
    most, pair = max(pairs)
    most = most._replace(n_tests=sum(each.n_tests for each, _ in pairs))
    for found, between in ((most, pair), (together, words)):
        what = f"correlation {found.correlation:.2f} of {between}, {found.lag} s later"
        yield 2.0 * float(ndtr(-found.z)) * max(found.n_tests, 1), what


class _Largest(NamedTuple):
    """The largest of some correlations, in standard deviations z."""

    z: float
    n_tests: int
    lag: int
    series: int
    correlation: float


def _largest(products: FloatArray, squares: FloatArray) -> _Largest:
    """Return the largest correlation, of sums over lags and series."""
    tested = squares > FEWEST
    squares = np.where(tested, squares, np.inf)
    z = np.abs(products) / np.sqrt(squares)
    lag, series = np.unravel_index(np.argmax(z), z.shape)
    # Series are standardised where they are seen, which is not only here.
    correlation = float(np.clip(products[lag, series] / squares[lag, series], -1.0, 1.0))
    return _Largest(float(z.max()), int(tested.sum()), int(lag), int(series), correlation)
