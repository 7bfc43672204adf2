"""The paced ledger: what it releases, what it says of it, and what nobody can tell from it.

No two trips are told apart by more than mu under ledgers, whatever is public. That holds surely and
is tested without noise: for any queries, prices and centres, two records that differ in one vehicle
have sums that are never further apart than mu, in units of the noise.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from agents.audit.residuals import RISK, examine
from dptse_env.config import resolve
from dptse_env.parts import privacy_report
from dptse_env.privacy import epsilon_of, mu_of
from dptse_env.release import PacedSettings
from dptse_env.release.noise import LARGEST_SIGMA
from dptse_env.release.vehicles import Ledgers
from tests.helpers import record

from .worlds import (
    BOTH,
    COLUMNS,
    LENGTH,
    LIMIT,
    ONE,
    SEGMENTS,
    TWO_GROUPS,
    WHOLE,
    Public,
    T,
    Worlds,
    adjacent_trips,
    collected,
    crowd,
    drives,
    predicting,
    request,
    sigma_at,
    squared_distance,
    stays,
    streams,
)

WANDERER = Worlds(drives(np.arange(T) % 6, 40.0))
ROUNDS = np.arange(1, T + 1)


SEEDS = st.integers(0, 2**32)


def started(worlds=WANDERER, **wish):
    return worlds.started(PacedSettings(**wish))


# --- what is released ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wish", "groups"),
    [
        ({}, WHOLE),
        ({"clip": 10.0, "ratio": 0.25}, TWO_GROUPS),
        ({"unit": "event"}, TWO_GROUPS),
    ],
)
def test_residuals_are_white_and_of_the_stated_size(wish, groups):
    """A twin at the same prices and centres says what is true, as an adversary works it out."""
    release, twin = (
        Worlds(crowd()).started(PacedSettings(**wish), 3, groups=groups) for _ in range(2)
    )
    n_columns, true, released = release.task.n_channels, [], []
    for second in np.tile(ROUNDS, 80).tolist():
        asked = request(
            second, prediction=predicting(np.linspace(5.0, 90.0, 8)), n_columns=n_columns
        )
        found = release.release(asked)
        sums, _ = twin.collect(asked, release.prices, found.centre, found.sigma * LENGTH)
        true.append((sums / LENGTH / found.sigma)[0])
        released.append((found.values / found.sigma)[0])
    residuals = np.array(released) - np.array(true)
    assert not examine(residuals).is_rejected
    assert stats.kstest(residuals.ravel(), "norm").pvalue > RISK


def test_noise_is_that_of_the_prices_on_a_grid_that_is_as_public():
    release = started(Worlds(crowd()), clip=20.0, ratio=0.25)
    for second in ROUNDS.tolist():
        released = release.release(request(second, second % 3))
        deviations = released.sigma * LENGTH
        np.testing.assert_allclose(deviations[..., 0], release.prices**-0.5, rtol=1e-12)
        np.testing.assert_allclose(deviations[..., 1], 40.0 * release.prices**-0.5, rtol=1e-12)
        grid = np.minimum(np.exp2(np.floor(np.log2(deviations / 1024.0))), 1.0)
        steps = released.values * LENGTH / grid
        np.testing.assert_allclose(steps, np.rint(steps), rtol=1e-12, atol=0.0)


def test_a_second_episode_is_released_like_the_first():
    """No ledger, price or account of either of two episodes outlasts a reset."""
    release = started(Worlds(crowd(), crowd(seed=1)), epsilon=0.5)
    told = []
    for _ in range(2):
        release.reset(BOTH, streams(3, 4))
        assert not release.prices.any()
        assert not np.concatenate([*release.spent(BOTH, BOTH), release.budgets_spent(BOTH)]).any()
        assert not release.private(BOTH, BOTH)["n_refused"].any()
        asked = [request(second, episodes=BOTH) for second in np.tile(ROUNDS, 3).tolist()]
        rounds = [release.release(each) for each in asked]
        values = [np.concatenate([each.values, each.sigma]) for each in rounds]
        told.append((values, release.ledgers.paid.copy(), release.private(BOTH, BOTH)["n_refused"]))
    for first, second in zip(*told, strict=True):
        np.testing.assert_array_equal(first, second)
        assert np.any(first)


# --- centres and prices ----------------------------------------------------------------------


def test_centres_are_predicted_speeds_within_the_limits():
    speed = np.array([-5.0, 0.0, 30.0, 60.0, 101.0, 140.0, 20.0, 10.0])
    released = started().release(request(1, prediction=predicting(10.0, speed)))
    own = np.clip(speed, 0.0, LIMIT)
    # The ends of the road, the on-ramp and the off-ramp, each as the segment beside it.
    np.testing.assert_array_equal(released.centre, [[*own, *own[[0, 5, 6, 7]]]])


@pytest.mark.parametrize(("bad", "quantity"), [(np.nan, "density"), (-np.inf, "speed")])
def test_without_a_finite_prediction_centres_fall_back_and_releases_go_on(bad, quantity):
    release, told = started(), []
    values = {"density": np.full(SEGMENTS, 20.0), "speed": np.full(SEGMENTS, 40.0)}
    values[quantity][3] = bad
    for prediction in (predicting(**values), predicting(20.0, 40.0), predicting(**values)):
        told.append(release.public(ONE)["centre_fallback"][0])
        released = release.release(request(1, prediction=prediction))
        for array in (released.values, released.sigma, release.prices):
            assert np.isfinite(array).all()
    assert released.centre[0, :SEGMENTS].tolist() == [40.0] * 3 + [LIMIT] + [40.0] * 4
    told.append(release.public(ONE)["centre_fallback"][0])
    release.reset(ONE, streams(0))
    assert [*told, release.public(ONE)["centre_fallback"][0]] == [0.0, 1.0, 0.0, 1.0, 0.0]


def test_a_price_buys_noise_of_its_deviation_and_one_whose_noise_is_not_exact_is_refused():
    release, prices = started(), np.full((1, COLUMNS), 0.04)
    release.pacing.prices = lambda *args: prices
    assert release.release(request(1)).sigma[0, 0, 0] == pytest.approx(5.0 / LENGTH)
    for bad in (-0.1, 0.0, np.nan, 0.9 / LARGEST_SIGMA**2):
        prices[:] = bad
        with pytest.raises(ValueError, match=r"^privacy\.epsilon must be such that noise"):
            release.release(request(1))


def test_a_report_above_the_limit_counts_as_the_limit():
    release = started(Worlds(stays(0, 1.3 * LIMIT)))
    sums, _ = next(collected(release, Public.constant(release, 0.01, LIMIT - 5.0)))
    assert sums[0, 0].tolist() == [1.0, 5.0]


def test_expected_deviations_are_those_of_free_traffic():
    release = started()
    release.release(request(1, prediction=predicting(10.0, LIMIT)))
    (price,) = release.pacing.expected_prices(np.full(SEGMENTS, LIMIT))
    sigma = 1.0 / np.sqrt(price) / LENGTH
    np.testing.assert_allclose(release.sigma, [sigma, PacedSettings().clip * sigma])
    assert 0.5 < sigma * LENGTH * np.sqrt(release.prices[0, 2]) < 2.0


# --- who pays --------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.3, 1.0])
def test_for_an_event_each_second_has_a_budget_and_nobody_is_refused(ratio):
    """Not even who deviates by the clip or more, which costs the whole of the budget."""
    for traffic, centre, most in ((stays(1, 0.0), LIMIT, True), (stays(2, LIMIT), 0.0, True),
                                  (crowd(), 0.0, False), (crowd(), LIMIT, False)):  # fmt: skip
        release = started(Worlds(traffic), unit="event", ratio=ratio)
        for second in ROUNDS.tolist():
            release.release(request(second, prediction=predicting(10.0, centre)))
            info = release.private(ONE, ONE)
            here = traffic.vehicle[traffic.step == second]
            assert np.flatnonzero(info["ledgers"][0]).tolist() == sorted(here.tolist())
            assert max(info["ledgers"][0]) <= 1.0
            assert info["n_refused"] == [0]
        if most:
            assert max(info["ledgers"][0]) == pytest.approx(1.0)


def test_refusals_and_ledgers_are_told_as_private_lists():
    release, refused = started(Worlds(crowd(3)), epsilon=0.5), 0
    for second in np.tile(ROUNDS, 6).tolist():
        release.release(request(second))
        info = release.private(ONE, ONE)
        assert [type(info[key][0]) for key in ("ledgers", "individual_epsilon")] == [list, list]
        refused += int(info["n_refused"][0])
    assert refused > 0
    ledgers, epsilons = (np.array(info[key][0]) for key in ("ledgers", "individual_epsilon"))
    budget = mu_of(0.5, 0.05) ** 2 / 2.0
    np.testing.assert_allclose(ledgers * budget, release.ledgers.paid[0, 0], rtol=1e-14)
    assert release.budgets_spent(ONE) == pytest.approx([ledgers.sum()])
    exact = [epsilon_of(np.sqrt(2.0 * budget * part), 0.05) for part in ledgers]
    assert (epsilons >= exact).all()  # rounded up to a level of mu
    np.testing.assert_allclose(epsilons, exact, atol=0.01)


@pytest.mark.parametrize("adjacency", ["replace", "add_remove"])
def test_a_part_of_the_budget_is_kept_back_for_rounding(adjacency):
    """A vehicle that pays in exactly representable parts is refused the last of them."""
    release = started(Worlds(stays(1, 60.0)), adjacency=adjacency)
    asked, centre = request(1), np.full((1, COLUMNS), 60.0)
    prices = np.full((1, COLUMNS), release.budget[0] / 4.0)
    public = prices, centre, sigma_at(release, prices)
    counts = [release.collect(asked, *public)[0][0, 1, 0] for _ in range(4)]
    assert counts == [1.0, 1.0, 1.0, 0.0]
    (offered,) = release.pacing.budget
    assert offered < release.ledgers.terms.budget[0] < release.budget[0]


def test_more_payments_than_the_reserve_covers_are_refused(monkeypatch):
    """A vehicle may pay every query of its segment in every second."""
    monkeypatch.setattr("dptse_env.privacy.gaussian.MOST_PAYMENTS", 3 * T)
    WANDERER.release(PacedSettings(), spans=(1, 2), bandwidth=6)
    with pytest.raises(ValueError, match=r"^horizon must be shorter: .* 24 times .*48 payments"):
        WANDERER.release(PacedSettings(), spans=(1, 2, 3), bandwidth=6)


# --- the account, and the report ---------------------------------------------------------------


@settings(max_examples=40)
@given(st.data())
def test_the_account_bounds_every_ledger_and_never_decreases(data):
    """Where queries overlap, a vehicle may pay for all that cover it in a second."""
    asked = PacedSettings(
        adjacency=data.draw(st.sampled_from(["replace", "add_remove"])),
        unit=data.draw(st.sampled_from(["trip", "event"])),
        epsilon=data.draw(st.sampled_from([0.5, 5.0])),
    )
    spans = data.draw(st.sampled_from([(1,), (1, 2)]))
    release = Worlds(crowd(15)).started(asked, 1, spans=spans)
    n_columns, n_queries = release.task.n_channels, release.task.queries.n_queries
    generator = np.random.default_rng(data.draw(SEEDS))
    squares = 2.0 if asked.adjacency == "replace" else 1.0
    mu, epsilon = 0.0, 0.0
    for second in np.tile(ROUNDS, 3).tolist():
        flags = np.isin(np.arange(n_columns), generator.integers(n_queries, size=3))
        speed = generator.choice([0.0, 20.0, LIMIT])
        release.release(request(second, flags, predicting(30.0, speed), n_columns=n_columns))
        (spent,), (loss,) = release.spent(ONE, ONE)
        assert mu <= spent <= mu_of(asked.epsilon, asked.delta)
        assert epsilon <= loss <= asked.epsilon * (1.0 + 1e-9)
        assert squares * release.ledgers.paid.max() <= spent**2 * (1.0 + 1e-9)
        assert spent == 0.0 or loss >= epsilon_of(spent, asked.delta) * (1.0 - 1e-9)
        mu, epsilon = spent, loss


def test_where_queries_overlap_the_account_adds_what_a_vehicle_pays_for_all_of_them():
    """A vehicle that deviates by the clip pays exactly what the account says, query by query."""
    asked = PacedSettings(epsilon=5.0)
    release = Worlds(stays(1, 0.0)).started(asked, spans=(1, 2), bandwidth=6)
    # Segment 1, and the pairs that begin on 0 and on 1; another covers other segments.
    n_columns = release.task.n_channels
    observed = np.isin(np.arange(n_columns), [1, 6, 7, 3])
    for second in range(1, 4):
        release.release(request(second, observed, predicting(10.0, 80.0), n_columns=n_columns))
        spent = release.spent(ONE, ONE)[0][0]
        assert spent**2 == pytest.approx(2.0 * release.ledgers.paid[0, 0, 0])
    assert 0.0 < spent < release.mu[0]


@pytest.mark.parametrize(("unit", "adjacency"), [("trip", "replace"), ("event", "add_remove")])
def test_the_report_says_what_is_guaranteed(unit, adjacency):
    privacy = {"unit": unit, "adjacency": adjacency, "clip": 25.0}
    found = privacy_report(resolve("private-highway", {"privacy": privacy}))
    mu = mu_of(5.0, 0.05)
    assert ("whole trip" in found.protects) == (unit == "trip")
    assert found.protects.endswith("or by none" if adjacency == "replace" else "removed")
    claim = "2.119-Gaussian differential privacy (rounded up), which is (5, 0.05)-"
    assert found.guarantee.startswith(claim)
    assert f"{found.protects}, against whoever does not know the seed" in found.guarantee
    assert found.void_reasons == ()
    assert (found.preset, found.speed_release) == ("paced", "flow")
    assert found.boundary_inputs == "nominal"
    assert found.mu == pytest.approx(mu, rel=1e-12)
    assert found.epsilon == pytest.approx(5.0, rel=1e-9)
    assert found.epsilons["1e-4"] == pytest.approx(epsilon_of(mu, 1e-4))
    squares = 2.0 if adjacency == "replace" else 1.0
    assert found.assumptions == {"budget": pytest.approx(mu**2 / squares)}
    assert found.details == {**privacy, "ratio": 1.0}


# --- nothing public exceeds mu -------------------------------------------------------------------


@settings(max_examples=100)
@given(st.data())
def test_nothing_public_exceeds_mu(data):
    """Queries, prices and centres may be of any kind, as no sensible pacing would choose them."""
    adjacency = data.draw(st.sampled_from(["replace", "add_remove"]))
    ratios = [0.1, 0.7, 1.0] + ([2.0, 50.0] if adjacency == "add_remove" else [])
    asked = PacedSettings(
        epsilon=data.draw(st.sampled_from([0.5, 5.0])),
        adjacency=adjacency,
        clip=data.draw(st.sampled_from([5.0, 25.0, 51.0, 150.0])),
        ratio=data.draw(st.sampled_from(ratios)),
        unit=data.draw(st.sampled_from(["trip", "event"])),
    )
    mu = mu_of(asked.epsilon, asked.delta)
    places, speeds, *others = data.draw(adjacent_trips(asked, 3, T, 4))
    release = Worlds(record(places, speeds), record(*others)).started(
        asked,
        groups=data.draw(st.sampled_from([WHOLE, TWO_GROUPS])),
        spans=data.draw(st.sampled_from([(1,), (1, 2, 3)])),
        bandwidth=6,
    )
    shape, generator = (T, release.task.n_channels), np.random.default_rng(data.draw(SEEDS))
    extremes = generator.choice([0.0, LIMIT / 2, LIMIT, np.nan], (T, COLUMNS))
    public = Public(
        generator.random(shape) < generator.choice([0.2, 0.8]),
        # From so small that no vehicle runs out to so large that none can ever pay.
        mu**2 * 10.0 ** generator.uniform(-3.0, 0.0, shape),
        np.where(np.isnan(extremes), generator.uniform(0.0, LIMIT, (T, COLUMNS)), extremes),
    )
    assert squared_distance(release, public) <= mu**2


def test_a_ratio_above_one_exceeds_mu_under_replace():
    """Two vehicles that deviate oppositely on one segment: 4 r of the 2 (1 + r) that they pay."""
    for ratio, least, most in ((1.0, 0.999, 1.0), (2.0, 1.33, 1.34)):
        release = started(Worlds(stays(1, LIMIT), stays(1, 0.0)), clip=25.0)
        object.__setattr__(release.task.settings, "ratio", ratio)  # 2 is refused
        terms = release.ledgers.terms._replace(ratio=ratio)
        release.ledgers = Ledgers(release.task.channels, 2, terms)
        release.ledgers.reset(BOTH, release.traffic.n_vehicles)
        price = 0.999999 * release.ledgers.terms.budget[0] / (T * (1.0 + ratio))
        public = Public.constant(release, price)
        assert least < squared_distance(release, public) / release.mu[0] ** 2 <= most
