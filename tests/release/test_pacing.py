"""Pacings: prices from public numbers, with which a budget lasts for a trip."""

import numpy as np
import pytest

from dptse_env.release import PACINGS, PacingSetup, PublicStep
from dptse_env.release.pacing import EventPacing, TracerPacing, check_prices
from dptse_env.traffic import SHORT_HIGHWAY
from tests.cases import pairwise

from .paced_worlds import OVERLAPPING

ONE = np.array([0])
BUDGET, PACE, RATIO = 2.0, 0.8, 1.0
N, S, LENGTH = SHORT_HIGHWAY.n_mainline, SHORT_HIGHWAY.n_segments, SHORT_HIGHWAY.segment_length
SHARE = 1.0 + 0.15 * RATIO
"""Expected payment over the price."""


def setup(n_episodes=1, first=None, span=None, places=S, always=(), coverage=0.5, level=None):
    first = np.arange(places) if first is None else np.asarray(first)
    span = np.ones(len(first), dtype=np.int64) if span is None else np.asarray(span)
    level = np.ones(len(first)) if level is None else np.asarray(level)
    return PacingSetup(
        SHORT_HIGHWAY, BUDGET, PACE, RATIO, first, span, level,
        np.array(always, dtype=np.int64), coverage, places, n_episodes,
    )  # fmt: skip


def started(**keywords):
    pacing = TracerPacing(setup(**keywords))
    pacing.reset(np.arange(pacing.setup.n_episodes))
    return pacing


def step(observed, density=10.0, speed=60.0, episodes=ONE, n_columns=S):
    """A second of some episodes; columns are observed by flags or by index."""
    shape = len(episodes), S
    flags = np.zeros((len(episodes), n_columns), dtype=bool)
    flags[:, observed] = True
    return PublicStep(
        episodes,
        flags,
        np.broadcast_to(density, shape).astype(float),
        np.broadcast_to(speed, shape).astype(float),
    )


def seconds_on(speed):
    return 3600.0 * LENGTH / np.clip(speed, 8.0, 102.0)


STANDING = 0.0
NOTHING = []


# --- the tracer ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("speed", "coverage"), pairwise([2.0, 8.0, 50.0, 102.0, 110.0], [0.2, 1.0], rest=False)
)
def test_a_price_spends_the_offer_over_the_queried_rest_of_a_trip(speed, coverage):
    prices = started(coverage=coverage).prices(step(NOTHING, 10.0, speed))[0]
    ahead = N - np.arange(N)
    expected = PACE * BUDGET / (2.0 + coverage * seconds_on(speed) * ahead)
    np.testing.assert_allclose(prices[:N], expected, rtol=1e-12)
    # The on-ramp feeds segment 2 and is not queried; the off-ramp is the end of a trip.
    np.testing.assert_allclose(prices[N:], [expected[2], PACE * BUDGET / 2.0], rtol=1e-12)


def test_slow_segments_ahead_lower_the_price_and_those_behind_do_not():
    speed = np.full(S, 80.0)
    fast = started().prices(step(NOTHING, 10.0, speed))[0]
    speed[3] = 10.0
    slow = started().prices(step(NOTHING, 10.0, speed))[0]
    assert (slow[:4] < fast[:4]).all()
    np.testing.assert_array_equal(slow[4:6], fast[4:6])


def test_queries_charge_the_tracer_where_traffic_stands():
    pacing = started()
    total = np.zeros(N)
    for queried in ([0, 2], [2], [1, 2]):
        prices = pacing.prices(step(queried, 100.0, STANDING))[0]
        total[queried] += SHARE * prices[queried]
        np.testing.assert_allclose(pacing.tracer(ONE)[0], total / BUDGET, rtol=1e-12)
    assert total[2] > total[0] > 0.0 == total[3]


def test_what_is_spent_lowers_the_price():
    pacing = started()
    before = pacing.prices(step([2], 100.0, STANDING))[0]
    spent = pacing.tracer(ONE)[0, 2] * BUDGET
    after = pacing.prices(step(NOTHING, 100.0, STANDING))[0]
    # The average of the queries has moved towards that one as well.
    rate = 0.5 * (1.0 - 1.0 / 60.0) + np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) / 60.0
    rest = 2.0 + seconds_on(STANDING) * np.cumsum(rate[::-1])[::-1]
    np.testing.assert_allclose(after[3:N], PACE * BUDGET / rest[3:], rtol=1e-12)
    assert after[2] == pytest.approx((PACE * BUDGET - spent) / rest[2], rel=1e-12)
    assert after[2] < before[2]


def test_flows_carry_the_tracer_along_and_vehicles_enter_with_nothing():
    """At 360 km/h a segment's vehicles have all moved on after a second."""
    pacing = started()
    pacing.prices(step([0, 1, 3], 100.0, STANDING))
    before = pacing.tracer(ONE)[0]
    pacing.prices(step(NOTHING, 10.0, 360.0))
    after = pacing.tracer(ONE)[0]
    # Segment 2 mixes the mainline with as many vehicles of the ramp, which have paid nothing. A
    # tenth of those on 3 leave the road, so a tenth of those on 4, who paid nothing, are not moved.
    expected = [0.0, before[0], before[1] / 2.0, before[2], 0.9 * before[3], before[4]]
    np.testing.assert_allclose(after, expected, rtol=1e-12)
    pacing.prices(step(NOTHING, 10.0, 180.0))
    behind = [0, 2, 4]
    half = 0.5 * (after[behind] + after[np.add(behind, 1)])
    np.testing.assert_allclose(pacing.tracer(ONE)[0, np.add(behind, 1)], half, rtol=1e-12)


def test_prices_stay_positive_however_much_was_spent():
    pacing = started(coverage=0.1)
    for _ in range(400):
        prices = pacing.prices(step([1], 100.0, STANDING))[0]
    assert prices.min() > 0.0
    assert prices[1] == pytest.approx(0.01 * BUDGET / (2.0 + _queried_seconds([1])[1]), rel=0.01)
    assert pacing.tracer(ONE).max() <= 1.0


def _queried_seconds(stared_at):
    rates = np.isin(np.arange(N), stared_at) * seconds_on(STANDING)
    return np.cumsum(rates[::-1])[::-1]


def test_a_policy_that_stares_is_paced_for_that():
    """The first rates are equal; after some minutes they are those of the policy."""
    staring, roving = started(coverage=1.0 / 3.0), started(coverage=1.0 / 3.0)
    for second in range(300):
        staring.prices(step([4, 5], 10.0, 300.0))
        roving.prices(step([second % 6, (second + 3) % 6], 10.0, 300.0))
    at_four, on_average = (p.prices(step(NOTHING, 10.0, 30.0))[0] for p in (staring, roving))
    assert at_four[4] < 0.6 * on_average[4]


@pytest.mark.parametrize("clear", [100.0, 30.0])
def test_a_vehicle_has_spent_about_its_pace_at_the_end_of_its_trip(clear):
    """One that is as fast as predicted, and deviates as much as is expected."""
    pacing = started(coverage=1.0 / 3.0)
    paid, place = 0.0, 0.0
    density, speed = np.full(S, 20.0), np.full(S, clear)
    speed[6] = 0.0  # nobody enters on the way
    for second in range(200):
        pacing.prices(step([second % 6, (second + 3) % 6], density, speed))
    second = 0
    while place < N * LENGTH:
        queried = [second % 6, (second + 3) % 6]
        prices = pacing.prices(step(queried, density, speed))[0]
        here = int(place / LENGTH)
        paid += SHARE * prices[here] * (here in queried)
        place, second = place + clear / 3600.0, second + 1
    assert PACE * 0.75 < paid / BUDGET < min(PACE * 1.25, 1.0)


def test_a_query_of_several_segments_has_their_mean_price_times_its_level():
    level = np.linspace(0.5, 2.0, 9)
    columns = {"first": OVERLAPPING.first, "span": OVERLAPPING.span}
    speed = np.linspace(20.0, 90.0, S)
    prices = started(**columns, level=level).prices(step(NOTHING, 10.0, speed, n_columns=9))[0]
    single = started().prices(step(NOTHING, 10.0, speed))[0]
    parts = zip(OVERLAPPING.first, OVERLAPPING.span, strict=True)
    expected = level * [single[first : first + span].mean() for first, span in parts]
    np.testing.assert_allclose(prices, expected, rtol=1e-12)


def test_overlapping_queries_charge_the_tracer_twice():
    columns = {"first": OVERLAPPING.first, "span": OVERLAPPING.span}
    pacing = started(**columns)
    prices = pacing.prices(step([1, 4], 100.0, STANDING, n_columns=9))[0]
    tracer = pacing.tracer(ONE)[0] * BUDGET / SHARE
    np.testing.assert_allclose(tracer[:3], [prices[4], prices[1] + prices[4], 0.0])


def test_sensors_are_expected_to_answer_every_second():
    without, with_sensor = (started(always=always).prices(step(NOTHING)) for always in ((), (5,)))
    rest = 2.0 + seconds_on(60.0) * (1.0 + 0.5 * np.arange(6))[::-1]
    np.testing.assert_allclose(with_sensor[0, :N], PACE * BUDGET / rest, rtol=1e-12)
    assert (with_sensor[0, :N] < without[0, :N]).all()


def test_released_boundaries_have_a_tracer_of_their_own():
    """Vehicles pay before the road begins, and bring that with them."""
    pacing = started(places=12, always=(8, 9, 10, 11))
    prices = pacing.prices(step([8, 9, 10, 11], 10.0, STANDING, n_columns=12))[0]
    assert (prices > 0.0).all()
    assert not pacing.tracer(ONE).any()
    pacing.prices(step(NOTHING, 10.0, 360.0, n_columns=12))
    assert pacing.tracer(ONE)[0, 0] == pytest.approx(SHARE * prices[8] / BUDGET)
    assert not pacing.tracer(ONE)[0, 1:].any()


def test_episodes_do_not_meet_and_a_reset_begins_anew():
    batch, single = started(n_episodes=3), started()
    for second in range(20):
        asked = [second % 6]
        together = batch.prices(step(asked, 20.0, 40.0, episodes=np.array([2, 0])))
        alone = single.prices(step(asked, 20.0, 40.0))
        np.testing.assert_array_equal(together, np.repeat(alone, 2, axis=0))
    np.testing.assert_array_equal(batch.tracer(np.arange(3))[[0, 2]], single.tracer(ONE)[[0, 0]])
    assert not batch.tracer(np.array([1])).any()
    fresh = started().prices(step(NOTHING, 20.0, 40.0))
    np.testing.assert_array_equal(
        batch.prices(step(NOTHING, 20.0, 40.0, episodes=np.array([1]))), fresh
    )
    batch.reset(np.array([2]))
    assert not batch.tracer(np.array([2])).any()
    np.testing.assert_array_equal(
        batch.prices(step(NOTHING, 20.0, 40.0, episodes=np.array([2]))), fresh
    )


def test_the_expected_price_is_that_of_half_the_way():
    pacing = started(coverage=0.4)
    expected = PACE * BUDGET / (2.0 + 0.4 * 6 * seconds_on(60.0))
    assert pacing.expected_price(np.full(S, 60.0)) == pytest.approx(expected)


def test_nothing_moves_where_predictions_have_no_traffic():
    pacing = started()
    pacing.prices(step([0, 1, 2], 0.0, 80.0))
    before = pacing.tracer(ONE)
    assert np.isfinite(pacing.prices(step(NOTHING, 0.0, 80.0))).all()
    np.testing.assert_array_equal(pacing.tracer(ONE), before)


# --- seconds with a budget of their own ------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_a_second_s_budget_covers_all_queries_of_a_segment(seed):
    generator = np.random.default_rng(seed)
    level = generator.uniform(0.2, 3.0, 9)
    pacing = EventPacing(
        setup(first=OVERLAPPING.first, span=OVERLAPPING.span, places=4, level=level)
    )
    observed = generator.random(9) < 0.5
    prices = pacing.prices(step(observed, n_columns=9))[0]
    covers = (np.arange(4) >= OVERLAPPING.first[:, None]) & (
        np.arange(4) < (OVERLAPPING.first + OVERLAPPING.span)[:, None]
    )
    whole = BUDGET / (1.0 + RATIO)
    sums = (prices * observed) @ covers
    assert sums.max() == pytest.approx(whole, rel=1e-12)
    assert (sums <= whole * (1.0 + 1e-12)).all()
    # A query that is not made has the price that it would have beside the others.
    for column in np.flatnonzero(~observed):
        with_it = observed.copy()
        with_it[column] = True
        again = pacing.prices(step(with_it, n_columns=9))[0]
        assert prices[column] == pytest.approx(again[column], rel=1e-12)


def test_single_queries_of_a_second_have_the_whole_of_it():
    pacing = EventPacing(setup())
    prices = pacing.prices(step([0, 3]))
    np.testing.assert_allclose(prices, BUDGET / (1.0 + RATIO))
    assert pacing.expected_price(np.full(S, 60.0)) == BUDGET / (1.0 + RATIO)
    assert not pacing.tracer(ONE).any()


# --- pacings of other packages ---------------------------------------------------------------


@pytest.mark.parametrize("name", ["ledgers", "counts", "truth", "traffic", "release"])
def test_a_step_shows_what_is_public_alone(name):
    shown = step([1])
    with pytest.raises(AttributeError, match=rf"^privacy\.pacing must .* got .*'{name}'$"):
        getattr(shown, name)
    fields = set(vars(shown))
    assert fields == {"episodes", "observed", "density", "speed"}


def test_good_prices_pass_and_bad_ones_are_named():
    good = np.array([[0.5, 1.0]])
    assert check_prices(good, (1, 2)) is good
    assert check_prices([[0.5, 1.0]], (1, 2)).tolist() == [[0.5, 1.0]]
    for bad in (good[0], good.astype(int), None, "high"):
        with pytest.raises(ValueError, match=r"^privacy\.pacing must return floats of shape"):
            check_prices(bad, (1, 2))
    for value in (0.0, -0.1, np.nan, np.inf):
        with pytest.raises(ValueError, match=r"^privacy\.pacing must return prices that are pos"):
            check_prices(np.array([[0.5, value]]), (1, 2))


def test_pacings_are_found_by_name():
    assert PACINGS.find("tracer") is TracerPacing
    with pytest.raises(ValueError, match=r"^privacy\.pacing must be one of tracer"):
        PACINGS.find("greedy")
    with pytest.raises(ValueError, match=r"^privacy\.pacing .* must be a subclass of .*Pacing"):
        PACINGS.find(dict)
