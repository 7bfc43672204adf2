"""Ledgers beside the same ledgers written out in Python, and the rules that users rely on."""

import numpy as np
import pytest

from dptse_env.release import PacedSettings
from dptse_env.release.ledgers import Columns
from tests.cases import pairwise

from .paced_worlds import (
    COLUMNS,
    LIMIT,
    OVERLAPPING,
    SINGLE,
    PlainLedgers,
    Public,
    T,
    budget_of,
    collect,
    constant,
    drives,
    keep_ledgers,
    stays,
)
from .worlds import AWAY, record

REPLACE = PacedSettings(clip=25.0)


def crowd(seed, n_vehicles=30):
    """A record of vehicles that jump about, also to segments that no column covers."""
    generator = np.random.default_rng(seed)
    places = generator.integers(AWAY, 6, (n_vehicles, T + 1))
    speeds = generator.uniform(0.0, 1.3 * LIMIT, (n_vehicles, T + 1))
    return record(places, speeds, COLUMNS)


def at_random(columns, seed, budget):
    generator, shape = np.random.default_rng(seed), (T, len(columns.first))
    prices = generator.uniform(0.0, 0.3 * budget, shape)
    centres = generator.uniform(0.0, LIMIT, (T, columns.n_places))
    return Public(generator.random(shape) < 0.6, prices, centres)


@pytest.mark.parametrize(
    ("columns", "seed", "ratio"), pairwise([SINGLE, OVERLAPPING], range(5), [0.3, 1.0])
)
def test_ledgers_count_as_they_do_when_written_out(columns, seed, ratio):
    asked = PacedSettings(clip=25.0, ratio=ratio)
    records, episodes = [crowd(10 * seed + k) for k in range(3)], np.arange(3)
    made, plain = (
        keep_ledgers(records, asked, columns, **kind) for kind in ({}, {"kind": PlainLedgers})
    )
    public = at_random(columns, seed, made.budget)
    for found, expected in zip(
        collect(made, public, episodes), collect(plain, public, episodes), strict=True
    ):
        for values, wanted in zip(found, expected, strict=True):
            np.testing.assert_array_equal(values, wanted)
    for k in range(3):
        np.testing.assert_array_equal(made.paid_by(k, k), plain.paid_by(k, k))
    assert made.paid.max() <= made.budget
    assert (made.paid > 0.5 * made.budget).any()


def test_a_vehicle_pays_for_its_own_clipped_deviation():
    ledgers = keep_ledgers([stays(1, 80.0)], REPLACE)
    # Centres of which the speed is 0, 10, 25 and more than 25 away.
    for step, centre in enumerate([80.0, 70.0, 105.0, 30.0]):
        public = constant(SINGLE, 0.01, centre)
        before = ledgers.paid[0, 0]
        sums = ledgers.collect(
            np.array([0]), np.array([0]), np.array([step + 1]), *(array[:1] for array in public)
        )
        d = min(max(80.0 - centre, -25.0), 25.0)
        assert sums.deviations[0].tolist() == [0.0, d, 0.0, 0.0]
        assert ledgers.paid[0, 0] - before == pytest.approx(0.01 * (1.0 + (d / 25.0) ** 2))


def test_who_cannot_pay_is_refused_and_still_pays_for_what_is_cheaper():
    ledgers = keep_ledgers([stays(1, LIMIT / 2)], REPLACE)
    shares = np.array([0.4, 0.7, 0.5, 0.2, 0.05, 0.2, 0.0499, 0.01])
    public = constant(SINGLE, 1.0)._replace(
        prices=np.tile(ledgers.budget * shares[:, None], (1, 4))
    )
    sums = list(collect(ledgers, public, np.array([0])))
    assert [second.counts[0, 1] for second in sums] == [1, 0, 1, 0, 1, 0, 1, 0]
    assert [int(second.refused[0]) for second in sums] == [0, 1, 0, 1, 0, 1, 0, 1]
    assert [second.deviations.any() for second in sums] == [False] * T
    assert ledgers.paid_by(0, 0) / ledgers.budget == pytest.approx([0.9999])


def test_a_vehicle_pays_for_each_query_that_covers_it():
    ledgers = keep_ledgers([drives(np.array([1, 0] + [AWAY] * (T - 2)), 0.0)], REPLACE, OVERLAPPING)
    sums = list(collect(ledgers, constant(OVERLAPPING, 0.01, centre=10.0), np.array([0])))
    # Segment 1: itself, two pairs and both threes. Segment 0: itself, one pair and a three.
    assert np.flatnonzero(sums[0].counts[0]).tolist() == [1, 4, 5, 7, 8]
    assert np.flatnonzero(sums[1].counts[0]).tolist() == [0, 4, 7]
    assert ledgers.paid[0, 0] == pytest.approx(8 * 0.01 * (1.0 + 0.16))


def test_a_budget_is_spent_in_the_order_of_the_columns():
    ledgers = keep_ledgers([stays(1, LIMIT / 2)], REPLACE, OVERLAPPING)
    public = constant(OVERLAPPING, ledgers.budget / 2.5)
    first, second, *_ = collect(ledgers, public, np.array([0]))
    assert np.flatnonzero(first.counts[0]).tolist() == [1, 4]
    assert first.refused.tolist() == [3]
    assert not second.counts.any()


def test_nobody_pays_where_nothing_is_asked():
    ledgers = keep_ledgers([crowd(0)], REPLACE)
    for second in collect(ledgers, constant(SINGLE, 0.1, observed=False), np.array([0])):
        assert not second.counts.any()
        assert second.refused.tolist() == [0]
    assert not ledgers.paid.any()


def test_a_ledger_does_not_depend_on_other_vehicles():
    whole = crowd(3)
    public = at_random(SINGLE, 3, budget_of(REPLACE))
    alone, together = keep_ledgers([whole.without(4)], REPLACE), keep_ledgers([whole], REPLACE)
    for ledgers in (alone, together):
        for _ in collect(ledgers, public, np.array([0])):
            pass
    others = np.arange(whole.n_vehicles) != 4
    np.testing.assert_array_equal(alone.paid[0, others], together.paid[0, others])
    assert alone.paid[0, 4] == 0.0 < together.paid[0, 4]


def test_a_reset_begins_new_budgets_in_its_episodes_alone():
    ledgers = keep_ledgers([crowd(0), crowd(1)], REPLACE)
    for _ in collect(ledgers, constant(SINGLE, 0.01)):
        pass
    kept = ledgers.paid_by(0, 0)
    ledgers.reset(np.array([1]))
    np.testing.assert_array_equal(ledgers.paid_by(0, 0), kept)
    assert kept.any()
    assert not ledgers.paid_by(1, 1).any()


def test_columns_say_what_they_cover():
    ledgers = keep_ledgers([crowd(0)], REPLACE, OVERLAPPING)
    np.testing.assert_array_equal(
        ledgers.covers[[0, 5, 8]], [[1, 0, 0, 0], [0, 1, 1, 0], [0, 1, 1, 1]]
    )
    assert not ledgers.are_single
    assert keep_ledgers([crowd(0)], REPLACE, SINGLE).are_single
    halves = Columns(np.array([0, 2]), np.array([2, 2]), 4)
    assert keep_ledgers([crowd(0)], REPLACE, halves).are_single
