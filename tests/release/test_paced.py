"""The paced ledger: what it releases, what it says of it, and what nobody can tell from it.

No two trips are told apart by more than mu under ledgers, whatever is public. That holds surely and
is tested without noise: for any queries, prices and centres, two records that differ in one vehicle
have sums that are never further apart than mu, in units of the noise. Each way of getting it wrong
is kept as a mutant that breaks the bound; those that look where they must not are in
``tests/test_paced_non_interference.py``.
"""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.config import resolve
from dptse_env.parts import privacy_report
from dptse_env.privacy import epsilon_of, mu_of
from dptse_env.release import Group, Paced, PacedSettings, Pacing, QueryOptions, Task, Traffic
from dptse_env.release.noise import Noise
from dptse_env.release.pacing import TracerPacing
from tests.helpers import AWAY, UNEVEN, pairwise, record

from .test_noise import residual_faults
from .worlds import (
    BOTH,
    COLUMNS,
    LENGTH,
    LIMIT,
    ONE,
    OVERLAPPING,
    PLACES,
    SEGMENTS,
    SINGLE,
    PlainLedgers,
    Public,
    T,
    Worlds,
    adjacent_trips,
    constant,
    crowd,
    drives,
    exhausting,
    keep_for,
    predicting,
    request,
    square,
    stays,
    streams,
)

WANDERER = Worlds(drives(np.arange(T) % 6, 40.0))


def started(settings=None, worlds=WANDERER, **keywords):
    return worlds.started(settings or PacedSettings(), **keywords)


# --- what is released ------------------------------------------------------------------------


def standardised(worlds, settings, kind=None, rounds=80, seed=3):
    """True sums and releases of all columns in units of the declared noise, (seconds, C, 2).

    A twin at the same prices and centres says what is true, as an adversary works it out.
    """
    release, twin = (worlds.started(settings, seed, kind=each) for each in (kind, None))
    true, released = [], []
    for second in np.tile(np.arange(1, T + 1), rounds).tolist():
        asked = request(second, prediction=predicting(np.linspace(5.0, 90.0, 8)))
        found = release.release(asked)
        sums, _ = twin.collect(asked, release.prices, found.centre)
        true.append((sums / LENGTH / found.sigma)[0])
        released.append((found.values / found.sigma)[0])
    return np.array(true), np.array(released)


class QuietNoise(Paced):
    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.noise = Noise(task.n_episodes, task.n_columns, scale=1.0 / 1.41)


@pytest.mark.parametrize(
    ("wish", "seed"),
    pairwise([{}, {"clip": 10.0, "ratio": 0.25}, {"unit": "event"}], range(3), n=3),
)
def test_residuals_are_white_and_of_the_stated_size(wish, seed):
    worlds = Worlds(crowd(seed=seed))
    assert residual_faults(*standardised(worlds, PacedSettings(**wish), seed=seed), 1.0) == []


def test_less_noise_than_declared_shows_in_the_residuals():
    faults = residual_faults(*standardised(WANDERER, PacedSettings(), QuietNoise), 1.0)
    assert {"variance of density", "variance of speed"} <= set(faults)


def test_noise_is_that_of_the_prices_on_a_grid_that_is_as_public():
    release = started(PacedSettings(clip=20.0, ratio=0.25), Worlds(crowd()))
    for second in range(1, T + 1):
        released = release.release(request(second, second % 3))
        deviations = released.sigma * LENGTH
        np.testing.assert_allclose(deviations[..., 0], release.prices**-0.5, rtol=1e-12)
        np.testing.assert_allclose(deviations[..., 1], 40.0 * release.prices**-0.5, rtol=1e-12)
        grid = np.exp2(np.floor(np.log2(deviations / 1024.0)))
        steps = released.values * LENGTH / grid
        np.testing.assert_allclose(steps, np.rint(steps), rtol=1e-12, atol=0.0)
    release.reset(ONE, streams(0))
    assert not release.prices.any()


def test_policies_meet_the_same_noise():
    """In units of its deviation, but for the rounding: the deviation depends on the policy."""
    worlds = Worlds(crowd())
    (everything, few), twins = ([started(worlds=worlds) for _ in range(2)] for _ in range(2))
    sigmas = []
    for second in range(1, T + 1):
        residuals = []
        asked = np.isin(np.arange(COLUMNS), [second % SEGMENTS, 5, 7])
        for release, twin, flags in ((everything, twins[0], True), (few, twins[1], asked)):
            found = release.release(request(second, flags))
            sums, _ = twin.collect(request(second, flags), release.prices, found.centre)
            residuals.append((found.values * LENGTH - sums) / (found.sigma * LENGTH))
            sigmas.append(found.sigma)
        np.testing.assert_allclose(*residuals, rtol=0.0, atol=2.0**-10)
    assert not np.allclose(*sigmas[-2:])


def test_a_copy_of_an_episode_in_a_batch_is_released_alike():
    one, two = crowd(seed=1), crowd(n_vehicles=9, seed=2)
    batch, single = started(worlds=Worlds(one, two), seed=4), started(worlds=Worlds(two), seed=5)
    for second in range(1, T + 1):
        together = batch.release(request(second, second % 2 == 0, episodes=BOTH))
        alone = single.release(request(second, second % 2 == 0))
        for name in ("values", "sigma", "centre"):
            np.testing.assert_array_equal(getattr(together, name)[1], getattr(alone, name)[0])


def test_a_second_episode_is_released_like_the_first():
    """No ledger, price or account outlasts a reset."""
    release = started(PacedSettings(epsilon=0.5), Worlds(crowd()))
    told = []
    for _ in range(2):
        release.reset(ONE, streams(3))
        rounds = [release.release(request(second)) for second in np.tile(np.arange(1, T + 1), 3)]
        values = [np.concatenate([each.values, each.sigma]) for each in rounds]
        told.append((np.array(values), release.ledgers.paid.copy(), release.spent(ONE, ONE)))
    for first, second in zip(*told, strict=True):
        np.testing.assert_array_equal(first, second)
    assert told[0][1].any()


# --- centres and prices ----------------------------------------------------------------------


def test_centres_are_predicted_speeds_within_the_limits():
    speed = np.array([-5.0, 0.0, 30.0, 60.0, 101.0, 140.0, 20.0, 10.0])
    released = started().release(request(1, prediction=predicting(10.0, speed)))
    own = np.clip(speed, 0.0, LIMIT)
    # The ends of the road, the on-ramp and the off-ramp, each as the segment beside it.
    np.testing.assert_array_equal(released.centre, [[*own, *own[[0, 5, 6, 7]]]])


@pytest.mark.parametrize(
    ("bad", "quantity"), [(np.nan, "density"), (np.inf, "speed"), (-np.inf, "density")]
)
def test_without_a_finite_prediction_centres_fall_back_and_releases_go_on(bad, quantity):
    release = started()
    values = {"density": np.full(SEGMENTS, 20.0), "speed": np.full(SEGMENTS, 40.0)}
    values[quantity][3] = bad
    told = [release.public(ONE)["centre_fallback"][0]]
    released = release.release(request(1, prediction=predicting(**values)))
    assert released.centre[0, :SEGMENTS].tolist() == [40.0] * 3 + [LIMIT] + [40.0] * 4
    for array in (released.values, released.sigma, release.prices):
        assert np.isfinite(array).all()
    told.append(release.public(ONE)["centre_fallback"][0])
    release.release(request(2, prediction=predicting(20.0, 40.0)))
    told.append(release.public(ONE)["centre_fallback"][0])
    release.release(request(3, prediction=predicting(**values)))
    release.reset(ONE, streams(0))
    assert [*told, release.public(ONE)["centre_fallback"][0]] == [0.0, 1.0, 0.0, 0.0]


def returning(prices):
    def answer(self, episodes, observed, density, speed):
        return prices(observed.shape)

    return type("Other", (Pacing,), {"prices": answer})


BAD_PRICES = {
    "negative": (lambda shape: np.full(shape, -1.0), "positive and finite"),
    "zero": (np.zeros, "positive and finite"),
    "infinite": (lambda shape: np.full(shape, np.inf), "positive and finite"),
    "not a number": (lambda shape: np.full(shape, np.nan), "positive and finite"),
    "one short": (lambda shape: np.ones(shape[1] - 1), r"of shape \(1, 12\), got .* \(11,\)"),
    "integers": (lambda shape: np.ones(shape, dtype=int), "floats of shape"),
}


@pytest.mark.parametrize(("prices", "message"), BAD_PRICES.values(), ids=BAD_PRICES)
def test_bad_prices_of_another_pacing_are_refused_by_path(prices, message):
    release = started(PacedSettings(pacing=returning(prices)))
    with pytest.raises(ValueError, match=rf"^privacy\.pacing must return .*{message}"):
        release.release(request(1))


def test_another_pacing_sets_the_prices():
    release = started(PacedSettings(pacing=returning(lambda shape: np.full(shape, 0.04))))
    assert release.release(request(1)).sigma[0, 0, 0] == pytest.approx(5.0 / LENGTH)


def test_expected_deviations_are_those_of_free_traffic():
    release = started()
    release.release(request(1, prediction=predicting(10.0, LIMIT)))
    (price,) = release.pacing.expected_prices(np.full(SEGMENTS, LIMIT))
    sigma = 1.0 / np.sqrt(price) / LENGTH
    np.testing.assert_allclose(release.sigma, [sigma, PacedSettings().clip * sigma])
    assert 0.5 < sigma * LENGTH * np.sqrt(release.prices[0, 2]) < 2.0


def test_on_an_uneven_road_prices_follow_the_lengths_ahead():
    road = dataclasses.replace(UNEVEN, fixed_sensors=tuple(range(7, 15)))
    settings = PacedSettings(epsilon=5.0, boundary_inputs="private")
    task = Task(
        "paced", Paced, settings, road, QueryOptions.make(road.n_mainline, 3), road.duration
    )
    traffic = Traffic(road, (0,), Worlds(stays(0, 1.0), road=road), [None])
    prices = Paced(task, traffic).pacing.prices(
        ONE, np.ones((1, task.n_columns), bool), *np.full((2, 1, road.n_segments), 60.0)
    )[0]
    assert np.all(np.diff(prices[: road.n_mainline]) > 0.0)
    for segments in (*road.on_ramp_segments, *road.off_ramp_segments):
        assert np.all(np.diff(prices[list(segments)]) > 0.0)
    # A vehicle on an on-ramp has its part of the mainline still ahead.
    for face, segments in zip(road.on_ramps, road.on_ramp_segments, strict=True):
        assert prices[segments[-1]] < prices[face]


# --- who pays --------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.3, 1.0])
def test_for_an_event_each_second_has_a_budget_and_nobody_is_refused(ratio):
    """Not even who deviates by the clip or more, which costs the whole of the budget."""
    still, passing = stays(1, 0.0), stays(2, LIMIT)
    for traffic, centre in ((still, LIMIT), (passing, 0.0), (crowd(), 0.0), (crowd(), LIMIT)):
        release = started(PacedSettings(unit="event", ratio=ratio), Worlds(traffic))
        for second in range(1, T + 1):
            release.release(request(second, prediction=predicting(10.0, centre)))
            info = release.private(ONE, ONE)
            here = traffic.vehicle[traffic.step == second]
            assert np.flatnonzero(info["ledgers"][0]).tolist() == sorted(here.tolist())
            assert max(info["ledgers"][0]) <= 1.0
            assert info["n_refused"] == [0]
        if traffic in (still, passing):
            assert max(info["ledgers"][0]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("place", "is_charged"), [(5, True), (7, True), (8, True), (11, True), (1, False)]
)
def test_fixed_sensors_and_boundaries_charge_without_a_query(place, is_charged):
    """Segments 5 and 7 have sensors, and 8 to 11 are boundary segments, which are released."""
    release = started(worlds=Worlds(stays(place, 10.0)))
    flags = release.task.observed(np.zeros((1, 6), dtype=bool))[0]
    for second in range(1, T + 1):
        release.release(request(second, flags))
    assert (release.private(ONE, ONE)["ledgers"][0][0] > 0.0) == is_charged


def test_refusals_and_ledgers_are_told_as_private_lists():
    release = started(PacedSettings(epsilon=0.5), Worlds(crowd(3)))
    told = []
    for second in np.tile(np.arange(1, T + 1), 6).tolist():
        release.release(request(second))
        told.append(release.private(ONE, ONE))
    for info in told:
        assert [type(info[key][0]) for key in ("ledgers", "individual_epsilon")] == [list, list]
    assert sum(int(info["n_refused"][0]) for info in told) > 0
    ledgers, epsilons = (np.array(told[-1][key][0]) for key in ("ledgers", "individual_epsilon"))
    budget = mu_of(0.5, 0.05) ** 2 / 2.0
    np.testing.assert_allclose(ledgers * budget, release.ledgers.paid[0, 0], rtol=1e-14)
    assert release.budgets_spent(ONE) == pytest.approx([ledgers.sum()])
    exact = [epsilon_of(np.sqrt(2.0 * budget * part), 0.05) for part in ledgers]
    assert (epsilons >= exact).all()  # rounded up to a level of mu
    np.testing.assert_allclose(epsilons, exact, atol=0.01)


@pytest.mark.parametrize("adjacency", ["replace", "add_remove"])
def test_a_part_of_the_budget_is_kept_back_for_rounding(adjacency):
    """A vehicle that pays in exactly representable parts is refused the last of them."""
    release = started(PacedSettings(adjacency=adjacency), Worlds(stays(1, 60.0)))
    asked, centre = request(1), np.full((1, COLUMNS), 60.0)
    prices = np.full((1, COLUMNS), release.budget[0] / 4.0)
    counts = [release.collect(asked, prices, centre)[0][0, 1, 0] for _ in range(4)]
    assert counts == [1.0, 1.0, 1.0, 0.0]
    (offered,) = release.pacing.budget
    assert offered < release.ledgers.budget[0] < release.budget[0]


# --- the account, and the report ---------------------------------------------------------------


@settings(max_examples=40)
@given(st.data())
def test_the_account_bounds_every_ledger_and_never_decreases(data):
    asked = PacedSettings(
        adjacency=data.draw(st.sampled_from(["replace", "add_remove"])),
        unit=data.draw(st.sampled_from(["trip", "event"])),
        epsilon=data.draw(st.sampled_from([0.5, 5.0])),
    )
    release = started(asked, Worlds(crowd(15)), seed=1)
    squares = 2.0 if asked.adjacency == "replace" else 1.0
    mu, epsilon = 0.0, 0.0
    assert [array.tolist() for array in release.spent(ONE, ONE)] == [[0.0], [0.0]]
    for second in np.tile(np.arange(1, T + 1), 3).tolist():
        asking = data.draw(st.lists(st.integers(0, 5), max_size=3))
        speed = data.draw(st.sampled_from([0.0, 20.0, LIMIT]))
        asked_for = np.isin(np.arange(COLUMNS), asking)
        release.release(request(second, asked_for, predicting(30.0, speed)))
        (spent,), (loss,) = release.spent(ONE, ONE)
        assert mu <= spent <= mu_of(asked.epsilon, asked.delta)
        assert epsilon <= loss <= asked.epsilon * (1.0 + 1e-9)
        assert squares * release.ledgers.paid.max() <= spent**2 * (1.0 + 1e-9)
        assert spent == 0.0 or loss >= epsilon_of(spent, asked.delta) * (1.0 - 1e-9)
        mu, epsilon = spent, loss


def test_where_queries_overlap_the_account_adds_what_a_vehicle_pays_for_all_of_them():
    """A vehicle that deviates by the clip pays exactly what the account says, query by query."""
    settings = PacedSettings(epsilon=5.0, pace=0.2)
    keywords = {"query_spans": (1, 2), "privacy": settings, "traffic_seeds": (0,), "horizon": T}
    config = resolve("short-highway", keywords)
    road, worlds = config.corridor, Worlds(stays(1, 0.0, config.corridor.duration))
    task = Task("paced", Paced, settings, road, config.queries, T)
    traffic = Traffic(road, (0,), worlds, [None])
    traffic.load(0)
    release = Paced(task, traffic)
    release.reset(ONE, streams(0))
    # Segment 1, and the pairs that begin on 0 and on 1; others cover other segments.
    observed = np.isin(np.arange(task.n_columns), [1, 6, 7, 3])
    for second in range(1, 4):
        asked = request(second, observed, predicting(10.0, 80.0), n_columns=task.n_columns)
        release.release(asked)
        spent = release.spent(ONE, ONE)[0][0]
        assert spent**2 == pytest.approx(2.0 * release.ledgers.paid[0, 0, 0])
    assert 0.0 < spent < release.mu[0]


def test_all_of_mu_is_spent_in_the_end():
    release = started(PacedSettings(epsilon=0.5))
    for second in np.tile(np.arange(1, T + 1), 40).tolist():
        release.release(request(second))
    mu, epsilon = release.spent(ONE, ONE)
    assert mu == pytest.approx(release.mu, rel=1e-15)
    assert epsilon == pytest.approx([0.5])


@pytest.mark.parametrize(("unit", "adjacency"), [("trip", "replace"), ("event", "add_remove")])
def test_the_report_says_what_is_guaranteed(unit, adjacency):
    privacy = {"unit": unit, "adjacency": adjacency, "pace": 0.7, "clip": 25.0}
    found = privacy_report(resolve("private-highway-v1", {"privacy": privacy}))
    mu = mu_of(5.0, 0.05)
    part = {"trip": "whole trip", "event": "second of a trip"}[unit]
    change = {"replace": "replaced by another", "add_remove": "added or removed"}[adjacency]
    assert found.protects == f"one vehicle's {part}, {change}"
    assert found.guarantee == (
        f"(5, 0.05)-differential privacy of count and flow together, for {found.protects}"
    )
    assert found.void_reasons == ()
    assert (found.preset, found.speed_release) == ("paced", "flow")
    assert found.boundary_inputs == "nominal"
    assert found.mu == pytest.approx(mu, rel=1e-12)
    assert found.epsilon == pytest.approx(5.0, rel=1e-9)
    assert found.epsilon_strict == pytest.approx(epsilon_of(mu, 1e-4))
    squares = 2.0 if adjacency == "replace" else 1.0
    assert found.assumptions == {"budget": pytest.approx(mu**2 / squares)}
    assert found.details == {**privacy, "ratio": 1.0}
    shown = found.to_dict()
    assert json.loads(json.dumps(shown, allow_nan=False)) == shown
    assert None not in shown.values()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"pace": 0.0}, r"^privacy\.pace must be a number in \[0\.05, 1\], got 0\.0$"),
        ({"clip": math.inf}, r"^privacy\.clip must be a number in \[1, 200\], got inf$"),
        ({"ratio": 1.0001}, r"^privacy\.ratio must be at most 1 for .*, got 1\.0001$"),
        ({"unit": "horizon"}, r"^privacy\.unit must be one of 'trip', 'event', got 'horizon'$"),
        ({"pacing": "fast"}, r"^privacy\.pacing must be one of tracer, .*got 'fast'"),
        ({"pacing": dict}, r"^privacy\.pacing .* must be a subclass of .*release\.Pacing"),
    ],
)  # fmt: skip
def test_bad_settings_are_named_with_their_path(fields, message):
    with pytest.raises(ValueError, match=message):
        PacedSettings(**fields)


def test_other_settings_are_fine():
    assert PacedSettings(adjacency="add_remove", ratio=50).ratio == 50.0
    for pacing in ("tracer", TracerPacing, "dptse_env.release.pacing:TracerPacing"):
        assert PacedSettings(pacing=pacing).pacing == pacing


# --- nothing public exceeds mu -------------------------------------------------------------------


@st.composite
def wishes(draw, **fixed):
    adjacency = draw(st.sampled_from(["replace", "add_remove"]))
    ratios = [0.1, 0.7, 1.0] + ([2.0, 50.0] if adjacency == "add_remove" else [])
    return PacedSettings(
        epsilon=draw(st.sampled_from([0.5, 5.0])),
        adjacency=adjacency,
        clip=draw(st.sampled_from([5.0, 25.0, 51.0, 150.0])),
        ratio=draw(st.sampled_from(ratios)),
        **fixed,
    )


@st.composite
def pairs(draw, asked):
    """Two records that differ in vehicle 0 as `asked` protects."""
    places, speeds, *others = draw(adjacent_trips(asked, 3, T, PLACES))
    return record(places, speeds), record(*others)


@st.composite
def public_numbers(draw, n_columns, n_places, mu):
    """Queries, prices and centres of any kind, also such as no sensible pacing would choose."""
    # A price from so small that no vehicle runs out to so large that none can ever pay.
    price = st.floats(1e-3, 1.0).map(lambda part: part * mu**2)
    centre = st.sampled_from([0.0, LIMIT / 2, LIMIT]) | st.floats(0.0, LIMIT)
    return Public(
        draw(arrays(bool, (T, n_columns))),
        draw(arrays(float, (T, n_columns), elements=price)),
        draw(arrays(float, (T, n_places), elements=centre)),
    )


@pytest.mark.parametrize("columns", [SINGLE, OVERLAPPING], ids=["single", "overlapping"])
@settings(max_examples=120, deadline=None)
@given(st.data())
def test_nothing_public_exceeds_mu(columns, data):
    asked = data.draw(wishes())
    mu = mu_of(asked.epsilon, asked.delta)
    keeping = keep_for(data.draw(pairs(asked)), asked, columns)
    public = data.draw(public_numbers(len(columns[0]), PLACES, mu))
    assert square(keeping.seconds(public), public, asked) <= mu**2


TWO_GROUPS = Group("queries", 0.7), Group("sensors", 0.3)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_neither_a_second_nor_both_groups_together_exceed_mu(data):
    """Of the whole release model, where seconds are protected, or columns are two groups."""
    unit = data.draw(st.sampled_from(["event", "trip"]))
    asked = data.draw(wishes(unit=unit))
    mu = mu_of(asked.epsilon, asked.delta)
    groups = TWO_GROUPS if unit == "trip" else (Group("queries"),)
    release = started(asked, Worlds(*data.draw(pairs(asked))), groups=groups)
    n_columns = release.task.n_columns
    public = data.draw(public_numbers(n_columns, COLUMNS, mu))
    seconds = [
        release.collect(
            request(t + 1, public.observed[t], episodes=BOTH, n_columns=n_columns),
            *(array[[t, t]] for array in public[1:]),
        )
        for t in range(T)
    ]
    assert square(seconds, public, asked) <= mu**2


EARLY = np.arange(T) < T // 2
PASSES, STANDS, NOBODY = stays(1, LIMIT), stays(1, 0.0), stays(1, 0.0, present=False)
ALONE = {"adjacency": "add_remove"}
WORST = {
    "opposite deviations on one segment": (SINGLE, PASSES, STANDS, {}),
    "two segments": (SINGLE, STANDS, stays(3, 0.0), {}),
    "two segments, as predicted": (SINGLE, stays(1, LIMIT / 2), stays(3, LIMIT / 2), {}),
    "opposite deviations in all overlapping queries": (OVERLAPPING, PASSES, STANDS, {}),
    "one after the other": (
        SINGLE, drives(np.where(EARLY, 1, AWAY), 0.0), drives(np.where(EARLY, AWAY, 1), 0.0), {},
    ),
    "a lone vehicle, mostly its speed": (SINGLE, STANDS, NOBODY, {**ALONE, "ratio": 50.0}),
}  # fmt: skip


@pytest.mark.parametrize(("columns", "first", "second", "wish"), WORST.values(), ids=WORST)
def test_made_up_trips_reach_the_whole_of_mu(columns, first, second, wish):
    asked, worlds = PacedSettings(clip=LIMIT / 2, **wish), (first, second)
    public = constant(columns, exhausting(worlds, asked, columns))
    reached = square(keep_for(worlds, asked, columns).seconds(public), public, asked)
    assert 0.999 < reached / mu_of(asked.epsilon, asked.delta) ** 2 <= 1.0


# --- mutants -------------------------------------------------------------------------------------

MU = mu_of(1.0, 0.05)
REPLACE, ADD = (PacedSettings(clip=25.0, adjacency=which) for which in ("replace", "add_remove"))


class LedgerForEachSegment(PlainLedgers):
    def account(self, vehicle, place, column):
        return vehicle, place


class LedgerForEachQuery(PlainLedgers):
    def account(self, vehicle, place, column):
        return vehicle, column


class LedgerOfAllOnASegment(PlainLedgers):
    def account(self, vehicle, place, column):
        return place


class FreeSensors(PlainLedgers):
    def cost(self, price, raw, column, nth):
        return 0.0 if column == 2 else super().cost(price, raw, column, nth)


class OverlapsChargedOnce(PlainLedgers):
    def cost(self, price, raw, column, nth):
        return 0.0 if nth else super().cost(price, raw, column, nth)


class ReleasedUnclipped(PlainLedgers):
    """Charged at the clipped deviation."""

    def cost(self, price, raw, column, nth):
        return super().cost(price, min(max(raw, -self.clip), self.clip), column, nth)

    def told(self, raw):
        return raw


class ChargedUnclipped(PlainLedgers):
    """Released at the clipped deviation."""

    def cost(self, price, raw, column, nth):
        return price * (1.0 + self.ratio * (raw / self.clip) ** 2)


class ChargedForTheCountAlone(PlainLedgers):
    def cost(self, price, raw, column, nth):
        return price


class TwiceTheBudget(PlainLedgers):
    """The budget against removal, under replacement."""

    def __init__(self, columns, n_episodes, budget, **keywords):
        super().__init__(columns, n_episodes, 2.0 * budget, **keywords)


def queue(first):
    """Vehicle 0, if there, stands on segment 1 for the first half; vehicle 1 for the second."""
    early = np.arange(T + 1) <= T // 2
    places = np.where([early & first, ~early], 1, AWAY)
    places[:, 0] = AWAY
    return record(places, np.zeros((2, T + 1)))


MOVES, SENSED = drives(np.arange(T) % 4, 0.0), drives(np.repeat([2, 1], T // 2), 0.0)
MUTANTS = {
    "a ledger for each segment": (LedgerForEachSegment, ADD, SINGLE, MOVES, NOBODY, 3.9),
    "a ledger for each query": (LedgerForEachQuery, ADD, OVERLAPPING, MOVES, NOBODY, 2.5),
    "a ledger that vehicles share": (
        LedgerOfAllOnASegment, ADD, SINGLE, queue(True), queue(False), 1.9,
    ),
    "sensors that are not charged": (FreeSensors, ADD, SINGLE, SENSED, NOBODY, 1.9),
    "overlaps charged once": (OverlapsChargedOnce, ADD, OVERLAPPING, STANDS, NOBODY, 4.9),
    "released at the unclipped deviation": (ReleasedUnclipped, ADD, SINGLE, STANDS, NOBODY, 2.5),
    "charged for the count alone": (ChargedForTheCountAlone, ADD, SINGLE, STANDS, NOBODY, 1.9),
    "the budget of add_remove under replace": (
        TwiceTheBudget, REPLACE, SINGLE, STANDS, stays(3, 0.0), 1.9,
    ),
}  # fmt: skip


def reached(kind, asked, columns, worlds):
    """Squared distance over mu^2, at a price that uses a correct ledger up in a second."""
    public = constant(columns, exhausting(worlds, asked, columns, within=1))
    keeping = keep_for(worlds, asked, columns, kind)
    return square(keeping.seconds(public), public, asked) / MU**2


@pytest.mark.parametrize(
    ("kind", "asked", "columns", "first", "second", "least"), MUTANTS.values(), ids=MUTANTS
)
def test_wrong_ledgers_exceed_mu(kind, asked, columns, first, second, least):
    worlds = first, second
    assert reached(kind, asked, columns, worlds) > least
    assert 0.7 < reached(PlainLedgers, asked, columns, worlds) <= 1.0


def test_a_ratio_above_one_exceeds_mu_under_replace():
    """Two vehicles that deviate oppositely on one segment: 4 r of the 2 (1 + r) that they pay."""
    for ratio, least, most in ((1.0, 0.999, 1.0), (2.0, 1.33, 1.34)):
        keeping = keep_for((PASSES, STANDS), REPLACE)
        keeping.ledgers.ratio = ratio
        price = 0.999999 * keeping.ledgers.budget[0] / (T * (1.0 + ratio))
        public, noise = constant(SINGLE, price), SimpleNamespace(clip=REPLACE.clip, ratio=ratio)
        assert least < square(keeping.seconds(public), public, noise) / MU**2 <= most


def test_charging_what_is_not_released_keeps_the_bound_and_wastes_the_budget():
    """No privacy is lost; vehicles run out early, which the values of ledgers show."""
    worlds, counted, paid = (STANDS, NOBODY), {}, {}
    public = constant(SINGLE, exhausting(worlds, ADD))
    for kind in (PlainLedgers, ChargedUnclipped):
        keeping = keep_for(worlds, ADD, SINGLE, kind)
        counted[kind] = sum(sums[0, :, 0].sum() for sums, _ in keeping.seconds(public))
        paid[kind] = keeping.ledgers.paid[0, 0, 0] / counted[kind]
        assert reached(kind, ADD, SINGLE, worlds) <= 1.0
    # Deviations of 51 km/h at a clip of 25: (1 + 51^2 / 25^2) / 2 of the right charge.
    assert counted == {PlainLedgers: T, ChargedUnclipped: 3}
    share = paid[ChargedUnclipped] / paid[PlainLedgers]
    assert share == pytest.approx((1.0 + (51.0 / 25.0) ** 2) / 2.0)
