"""Pacings: prices from public numbers, with which a budget lasts for a trip."""

import dataclasses

import numpy as np
import pytest

from dptse_env.release import (
    PACINGS,
    Group,
    Paced,
    PacedSettings,
    QueryOptions,
    Task,
)
from dptse_env.release.pacing import EventPacing, TracerPacing, check_prices
from dptse_env.traffic import SHORT_HIGHWAY
from tests.helpers import pairwise

from .worlds import ONE, WHOLE

BUDGET, PACE, RATIO = 2.0, 0.8, 1.0
N, S, LENGTH = SHORT_HIGHWAY.n_mainline, SHORT_HIGHWAY.n_segments, SHORT_HIGHWAY.segment_length
SHARE = 1.0 + 0.15 * RATIO
"""Expected payment over the price."""
STANDING = 0.0
NOTHING = []


def make(
    kind=TracerPacing, *, bandwidth=3, spans=(1,), levels=(1.0,), sensors=(), boundary="nominal",
    n_episodes=1, groups=WHOLE,
):  # fmt: skip
    """A pacing of half the road a second, unless another bandwidth is given."""
    road = dataclasses.replace(SHORT_HIGHWAY, fixed_sensors=sensors)
    queries = QueryOptions.make(N, bandwidth, spans, levels, separate_sensors=len(groups) > 1)
    settings = PacedSettings(pace=PACE, ratio=RATIO, boundary_inputs=boundary)
    task = Task("paced", Paced, settings, road, queries, 240, n_episodes, groups)
    shares = np.array([group.budget_share for group in groups])
    pacing = kind(task, BUDGET * shares)
    pacing.reset(np.arange(n_episodes))
    return pacing


def prices_of(pacing, observed, density=10.0, speed=60.0, episodes=ONE):
    """Prices of a second of some episodes; columns are observed by index or by flags."""
    n_columns, shape = pacing.task.n_columns, (len(episodes), S)
    flags = np.zeros((len(episodes), n_columns), dtype=bool)
    flags[:, observed] = True
    given = (np.broadcast_to(value, shape).astype(float) for value in (density, speed))
    return pacing.prices(episodes, flags, *given)


def seconds_on(speed):
    return 3600.0 * LENGTH / np.clip(speed, 8.0, 102.0)


# --- the tracer ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("speed", "bandwidth"), pairwise([2.0, 8.0, 50.0, 102.0, 110.0], [1, 6], rest=False)
)
def test_a_price_spends_the_offer_over_the_queried_rest_of_a_trip(speed, bandwidth):
    prices = prices_of(make(bandwidth=bandwidth), NOTHING, 10.0, speed)[0]
    ahead = N - np.arange(N)
    expected = PACE * BUDGET / (2.0 + bandwidth / N * seconds_on(speed) * ahead)
    np.testing.assert_allclose(prices[:N], expected, rtol=1e-12)
    # The on-ramp feeds segment 2 and is not queried; the off-ramp is the end of a trip.
    np.testing.assert_allclose(prices[N:], [expected[2], PACE * BUDGET / 2.0], rtol=1e-12)


def test_slow_segments_ahead_lower_the_price_and_those_behind_do_not():
    speed = np.full(S, 80.0)
    fast = prices_of(make(), NOTHING, 10.0, speed)[0]
    speed[3] = 10.0
    slow = prices_of(make(), NOTHING, 10.0, speed)[0]
    assert (slow[:4] < fast[:4]).all()
    np.testing.assert_array_equal(slow[4:6], fast[4:6])


def test_queries_charge_the_tracer_where_traffic_stands():
    pacing, total = make(), np.zeros(N)
    for queried in ([0, 2], [2], [1, 2]):
        prices = prices_of(pacing, queried, 100.0, STANDING)[0]
        total[queried] += SHARE * prices[queried]
        np.testing.assert_allclose(pacing.tracer(ONE)[0], total / BUDGET, rtol=1e-12)
    assert total[2] > total[0] > 0.0 == total[3]


def test_what_is_spent_lowers_the_price():
    pacing = make()
    before = prices_of(pacing, [2], 100.0, STANDING)[0]
    spent = pacing.tracer(ONE)[0, 2] * BUDGET
    after = prices_of(pacing, NOTHING, 100.0, STANDING)[0]
    # The average of the queries has moved towards that one as well.
    rate = 0.5 * (1.0 - 1.0 / 60.0) + np.isin(np.arange(N), 2) / 60.0
    rest = 2.0 + seconds_on(STANDING) * np.cumsum(rate[::-1])[::-1]
    np.testing.assert_allclose(after[3:N], PACE * BUDGET / rest[3:], rtol=1e-12)
    assert after[2] == pytest.approx((PACE * BUDGET - spent) / rest[2], rel=1e-12)
    assert after[2] < before[2]


def test_flows_carry_the_tracer_along_and_vehicles_enter_with_nothing():
    """At 360 km/h a segment's vehicles have all moved on after a second."""
    pacing = make()
    prices_of(pacing, [0, 1, 3], 100.0, STANDING)
    before = pacing.tracer(ONE)[0]
    prices_of(pacing, NOTHING, 10.0, 360.0)
    after = pacing.tracer(ONE)[0]
    # Segment 2 mixes the mainline with as many vehicles of the ramp, which have paid nothing. A
    # tenth of those on 3 leave the road, so a tenth of those on 4, who paid nothing, are not moved.
    expected = [0.0, before[0], before[1] / 2.0, before[2], 0.9 * before[3], before[4]]
    np.testing.assert_allclose(after, expected, rtol=1e-12)
    prices_of(pacing, NOTHING, 10.0, 180.0)
    behind = [0, 2, 4]
    half = 0.5 * (after[behind] + after[np.add(behind, 1)])
    np.testing.assert_allclose(pacing.tracer(ONE)[0, np.add(behind, 1)], half, rtol=1e-12)


def test_prices_stay_positive_however_much_was_spent():
    pacing = make(bandwidth=1)
    for _ in range(400):
        prices = prices_of(pacing, [1], 100.0, STANDING)[0]
    assert prices.min() > 0.0
    assert prices[1] == pytest.approx(0.01 * BUDGET / (2.0 + seconds_on(STANDING)), rel=0.01)
    assert pacing.tracer(ONE).max() <= 1.0


def test_a_policy_that_stares_is_paced_for_that():
    """The first rates are equal; after some minutes they are those of the policy."""
    staring, roving = make(bandwidth=2), make(bandwidth=2)
    for second in range(300):
        prices_of(staring, [4, 5], 10.0, 300.0)
        prices_of(roving, [second % 6, (second + 3) % 6], 10.0, 300.0)
    at_four, on_average = (prices_of(p, NOTHING, 10.0, 30.0)[0] for p in (staring, roving))
    assert at_four[4] < 0.6 * on_average[4]


@pytest.mark.parametrize("clear", [100.0, 30.0])
def test_a_vehicle_has_spent_about_its_pace_at_the_end_of_its_trip(clear):
    """One that is as fast as predicted, and deviates as much as is expected."""
    pacing = make(bandwidth=2)
    paid, place = 0.0, 0.0
    density, speed = np.full(S, 20.0), np.full(S, clear)
    speed[6] = 0.0  # nobody enters on the way
    for second in range(200):
        prices_of(pacing, [second % 6, (second + 3) % 6], density, speed)
    second = 0
    while place < N * LENGTH:
        queried = [second % 6, (second + 3) % 6]
        prices = prices_of(pacing, queried, density, speed)[0]
        here = int(place / LENGTH)
        paid += SHARE * prices[here] * (here in queried)
        place, second = place + clear / 3600.0, second + 1
    assert PACE * 0.75 < paid / BUDGET < min(PACE * 1.25, 1.0)


def test_a_query_of_several_segments_has_their_mean_price_times_its_level():
    pacing, speed = make(spans=(1, 2, 3), levels=(0.5, 1.0, 2.0)), np.linspace(20.0, 90.0, S)
    options = pacing.task.queries
    prices = prices_of(pacing, NOTHING, 10.0, speed)[0]
    single = prices_of(make(), NOTHING, 10.0, speed)[0]
    parts = zip(options.first, options.span, strict=True)
    expected = options.level * [single[first : first + span].mean() for first, span in parts]
    np.testing.assert_allclose(prices[: options.n_options], expected, rtol=1e-12)


def test_overlapping_queries_charge_the_tracer_twice():
    pacing = make(spans=(1, 2))  # six segments, then five pairs
    prices = prices_of(pacing, [1, 6], 100.0, STANDING)[0]
    tracer = pacing.tracer(ONE)[0] * BUDGET / SHARE
    np.testing.assert_allclose(tracer[:3], [prices[6], prices[1] + prices[6], 0.0])


def test_sensors_are_expected_to_answer_every_second():
    without, with_sensor = (prices_of(make(sensors=some), NOTHING) for some in ((), (5,)))
    rest = 2.0 + seconds_on(60.0) * (1.0 + 0.5 * np.arange(6))[::-1]
    np.testing.assert_allclose(with_sensor[0, :N], PACE * BUDGET / rest, rtol=1e-12)
    assert (with_sensor[0, :N] < without[0, :N]).all()


def test_released_boundaries_have_a_tracer_of_their_own():
    """Vehicles pay before the road begins, and bring that with them."""
    pacing = make(boundary="private")
    prices = prices_of(pacing, [8, 9, 10, 11], 10.0, STANDING)[0]
    assert (prices > 0.0).all()
    assert not pacing.tracer(ONE).any()
    prices_of(pacing, NOTHING, 10.0, 360.0)
    assert pacing.tracer(ONE)[0, 0] == pytest.approx(SHARE * prices[8] / BUDGET)
    assert not pacing.tracer(ONE)[0, 1:].any()


def test_each_group_is_paced_by_itself():
    """As if it were alone on the road with its part of the budget."""
    groups = Group("queries", 0.75), Group("sensors", 0.25)
    both, queries = make(sensors=(5,), groups=groups), make()
    for second, queried in enumerate(([0, 2], [2, 3], [], [5])):
        found = prices_of(both, [*queried, 8], 40.0, 30.0)[0]  # the sensor's own column
        alone = prices_of(queries, queried, 40.0, 30.0)[0]
        np.testing.assert_allclose(found[:N], 0.75 * alone[:N], rtol=1e-12)
        offered = 0.25 * PACE * BUDGET / (2.0 + seconds_on(30.0))
        assert found[8] == pytest.approx(offered) if second == 0 else found[8] < offered
    # The tracer of queries does not know of the sensor's charges.
    np.testing.assert_allclose(both.tracer(ONE), queries.tracer(ONE), rtol=1e-12)
    expected = 0.25 * PACE * BUDGET / (2.0 + seconds_on(60.0))
    assert both.expected_prices(np.full(S, 60.0))[1] == pytest.approx(expected)


def test_episodes_do_not_meet_and_a_reset_begins_anew():
    batch, single = make(n_episodes=3), make()
    for second in range(20):
        asked = [second % 6]
        together = prices_of(batch, asked, 20.0, 40.0, np.array([2, 0]))
        alone = prices_of(single, asked, 20.0, 40.0)
        np.testing.assert_array_equal(together, np.repeat(alone, 2, axis=0))
    np.testing.assert_array_equal(batch.tracer(np.arange(3))[[0, 2]], single.tracer(ONE)[[0, 0]])
    assert not batch.tracer(np.array([1])).any()
    fresh = prices_of(make(), NOTHING, 20.0, 40.0)
    np.testing.assert_array_equal(prices_of(batch, NOTHING, 20.0, 40.0, np.array([1])), fresh)
    batch.reset(np.array([2]))
    assert not batch.tracer(np.array([2])).any()
    np.testing.assert_array_equal(prices_of(batch, NOTHING, 20.0, 40.0, np.array([2])), fresh)


def test_the_expected_price_is_that_of_the_whole_way():
    expected = PACE * BUDGET / (2.0 + 0.5 * 6 * seconds_on(60.0))
    assert make().expected_prices(np.full(S, 60.0)) == pytest.approx([expected])


def test_nothing_moves_where_predictions_have_no_traffic():
    pacing = make()
    prices_of(pacing, [0, 1, 2], 0.0, 80.0)
    before = pacing.tracer(ONE)
    assert np.isfinite(prices_of(pacing, NOTHING, 0.0, 80.0)).all()
    np.testing.assert_array_equal(pacing.tracer(ONE), before)


# --- seconds with a budget of their own ------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_a_second_s_budget_covers_all_queries_of_a_segment(seed):
    pacing = make(EventPacing, spans=(1, 2, 3), levels=(0.2, 1.0, 3.0))
    observed = np.random.default_rng(seed).random(pacing.task.n_columns) < 0.3
    prices = prices_of(pacing, observed)[0]
    whole = BUDGET / (1.0 + RATIO)
    sums = (prices * observed) @ pacing.task.covers
    assert sums.max() == pytest.approx(whole, rel=1e-12)
    assert (sums <= whole * (1.0 + 1e-12)).all()
    # A query that is not made has the price that it would have beside the others.
    for column in np.flatnonzero(~observed)[::5]:
        with_it = observed.copy()
        with_it[column] = True
        assert prices[column] == pytest.approx(prices_of(pacing, with_it)[0, column], rel=1e-12)


def test_single_queries_of_a_second_have_the_whole_of_their_group_s():
    groups = Group("queries", 0.75), Group("sensors", 0.25)
    pacing = make(EventPacing, sensors=(5,), groups=groups)
    prices, whole = prices_of(pacing, [0, 3, 5, 8])[0], BUDGET / (1.0 + RATIO)
    np.testing.assert_allclose(prices, whole * np.where(np.arange(9) < N, 0.75, 0.25))
    np.testing.assert_allclose(pacing.expected_prices(np.full(S, 60.0)), [0.75, 0.25])
    assert not pacing.tracer(ONE).any()


# --- pacings of other packages ---------------------------------------------------------------


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
