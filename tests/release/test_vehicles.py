"""The true traffic in memory, and ledgers beside the same ledgers written out in Python."""

import dataclasses

import numpy as np
import pytest

from dptse_env.release import Traffic
from dptse_env.traffic import SHORT_HIGHWAY, Penetration, RecordLibrary
from tests.helpers import AWAY, UNEVEN, pairwise

from .worlds import (
    GROUPED,
    LIMIT,
    ONE,
    OVERLAPPING,
    PLACES,
    SINGLE,
    PlainLedgers,
    Public,
    T,
    Worlds,
    constant,
    crowd,
    drives,
    keep,
    stays,
)

# --- traffic ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def traffic():
    traffic = Traffic(SHORT_HIGHWAY, (4, 7), RecordLibrary(), [None, Penetration(0.4)])
    traffic.load(0)
    return traffic


def test_aggregates_are_counts_and_means_over_vehicles(traffic):
    record = traffic.library.get(SHORT_HIGHWAY, 4)
    rows = record.step == 120
    segments, speeds = record.segment[rows], record.speed[rows].astype(float)
    (answer,) = traffic.aggregates(np.array([0]), np.array([120]))
    occupied = 0
    for segment in range(SHORT_HIGHWAY.n_segments):
        here = speeds[segments == segment]
        assert answer[segment, 0] == pytest.approx(len(here) / 0.1)
        if len(here):
            occupied += 1
            assert answer[segment, 1] == pytest.approx(here.mean())
    assert occupied > 3


def test_an_empty_segment_has_its_own_limit_and_a_density_its_own_length():
    road = dataclasses.replace(UNEVEN, duration=T)
    n_columns = road.n_segments + road.n_boundaries
    whole = crowd(seed=3, last=n_columns, n_columns=n_columns)
    table = Traffic(road, (0,), Worlds(whole))
    table.load(0)
    lengths, limits = (
        np.array(road.with_boundaries(values))
        for values in (road.segment_lengths, road.speed_limits)
    )
    density, speed = np.moveaxis(table.complete(0), -1, 0)
    counts = whole.counts
    np.testing.assert_allclose(density * lengths, counts)
    empty = counts == 0
    assert 0 < empty.sum() < empty.size
    np.testing.assert_array_equal(speed[empty], np.broadcast_to(limits, empty.shape)[empty])


def test_missing_records_are_made_together_and_loaded_once(tmp_path, monkeypatch):
    library, ensured = RecordLibrary(), []
    monkeypatch.setattr(library, "ensure", lambda corridor, seeds: ensured.append(list(seeds)))
    traffic = Traffic(SHORT_HIGHWAY, (4, 7, 9), library)
    assert traffic.load(0) == [0]
    monkeypatch.setattr(library, "get", lambda corridor, seed: RecordLibrary().get(corridor, 4))
    assert traffic.load(np.array([2, 0, 1, 2])) == [1, 2]
    assert traffic.load([0, 1, 2]) == []
    assert ensured == [[7, 9]]


def test_vehicles_are_those_of_the_second_and_groups_see_some_of_them(traffic):
    record = traffic.library.get(SHORT_HIGHWAY, 4)
    rows = traffic.vehicles(np.array([0]), np.array([120]))
    second, own = slice(rows.start[0], rows.stop[0]), record.step == 120
    np.testing.assert_array_equal(rows.vehicle[second], record.vehicle[own])
    np.testing.assert_array_equal(rows.place[second], record.segment[own])
    np.testing.assert_array_equal(rows.speed[0, second], record.speed[own])
    connected = Penetration(0.4).connected(4, record)[record.vehicle[own]]
    expected = np.where(connected, record.speed[own], -1.0)
    np.testing.assert_array_equal(rows.speed[1, second], expected)
    assert 0 < connected.sum() < connected.size


# --- ledgers ----------------------------------------------------------------------------------


def at_random(columns, seed, budget):
    generator, shape = np.random.default_rng(seed), (T, len(columns[0]))
    prices = generator.uniform(0.0, 0.3 * budget, shape)
    centres = generator.uniform(0.0, LIMIT, (T, PLACES))
    return Public(generator.random(shape) < 0.6, prices, centres)


@pytest.mark.parametrize(
    ("columns", "seed", "ratio"),
    pairwise([SINGLE, OVERLAPPING, GROUPED], range(4), [0.0, 0.3, 1.0], rest=False),
)
def test_ledgers_count_as_they_do_when_written_out(columns, seed, ratio):
    records = [crowd(30, 10 * seed + k, last=PLACES + 2) for k in range(3)]
    given = {"ratio": ratio, "clip": 25.0 if ratio else np.inf}
    budget = np.array([0.3, 0.2])[: columns[2].max() + 1]
    made = keep(records, columns, budget, **given)
    plain = keep(records, columns, budget, PlainLedgers, **given)
    public = at_random(columns, seed, 0.3)
    for found, expected in zip(made.seconds(public), plain.seconds(public), strict=True):
        for values, wanted in zip(found, expected, strict=True):
            np.testing.assert_array_equal(values, wanted)
    paid = made.ledgers.paid
    np.testing.assert_array_equal(paid, plain.ledgers.paid)
    assert (paid <= budget[:, None]).all()
    assert (paid > 0.5 * budget[:, None]).any(axis=(0, 2)).all()


def test_a_vehicle_pays_for_its_own_clipped_deviation():
    keeping = keep([stays(1, 80.0)], SINGLE, 1.0, ratio=1.0, clip=25.0)
    centres = np.repeat([[80.0], [70.0], [105.0], [30.0]] * 2, PLACES, axis=1)
    public, before = constant(SINGLE, 0.01)._replace(centres=centres), 0.0
    for centre, (sums, _) in zip(centres[:, 0], keeping.seconds(public), strict=True):
        d = min(max(80.0 - centre, -25.0), 25.0)
        assert sums[0, :, 1].tolist() == [0.0, d, 0.0, 0.0]
        paid = keeping.ledgers.paid[0, 0, 0]
        assert paid - before == pytest.approx(0.01 * (1.0 + (d / 25.0) ** 2))
        before = paid


def test_who_cannot_pay_is_refused_and_still_pays_for_what_is_cheaper():
    keeping = keep([stays(1, LIMIT / 2)], SINGLE, 2.0, ratio=1.0, clip=25.0)
    shares = np.array([0.4, 0.7, 0.5, 0.2, 0.05, 0.2, 0.0499, 0.01])
    public = constant(SINGLE, 1.0)._replace(prices=np.tile(2.0 * shares[:, None], (1, 4)))
    sums, refused = zip(*keeping.seconds(public), strict=True)
    assert [second[0, 1, 0] for second in sums] == [1, 0, 1, 0, 1, 0, 1, 0]
    assert [int(second[0, 0]) for second in refused] == [0, 1, 0, 1, 0, 1, 0, 1]
    assert keeping.ledgers.paid[0, 0, 0] / 2.0 == pytest.approx(0.9999)


def test_a_price_of_one_and_no_ratio_is_a_cap():
    """A vehicle counts in its first steps that are observed, at any speed, and in no later one."""
    keeping = keep([stays(0, 50.0)], SINGLE, 3.0)
    observed = np.ones((T, 4), dtype=bool)
    observed[1] = False  # not asked, not charged
    seconds = keeping.seconds(constant(SINGLE, 1.0, 0.0, observed))
    assert [sums[0, 0].tolist() for sums, _ in seconds] == [
        [1.0, 50.0], [0.0, 0.0], [1.0, 50.0], [1.0, 50.0], *[[0.0, 0.0]] * 4,
    ]  # fmt: skip


def test_a_vehicle_pays_for_each_query_that_covers_it_in_the_order_of_the_columns():
    vehicle = drives(np.array([1, 0] + [AWAY] * (T - 2)), 0.0)
    keeping = keep([vehicle], OVERLAPPING, 1.0, ratio=1.0, clip=25.0)
    sums = [second[0, :, 0] for second, _ in keeping.seconds(constant(OVERLAPPING, 0.01, 10.0))]
    # Segment 1: itself, two pairs and both threes. Segment 0: itself, one pair and a three.
    assert np.flatnonzero(sums[0]).tolist() == [1, 4, 5, 7, 8]
    assert np.flatnonzero(sums[1]).tolist() == [0, 4, 7]
    assert keeping.ledgers.paid[0, 0, 0] == pytest.approx(8 * 0.01 * (1.0 + 0.16))
    few = keep([vehicle], OVERLAPPING, 2.5, ratio=1.0, clip=25.0)
    (sums, refused), *_ = few.seconds(constant(OVERLAPPING, 1.0, 0.0))
    assert np.flatnonzero(sums[0, :, 0]).tolist() == [1, 4]
    assert refused.tolist() == [[3]]


def test_a_ledger_does_not_depend_on_other_vehicles_or_groups():
    whole, public = crowd(30, 3, last=PLACES), at_random(GROUPED, 3, 0.3)
    paid = []
    for records, budget in (([whole.without(4)], 0.3), ([whole], 0.3), ([whole], [0.3, 0.1])):
        keeping = keep(records, GROUPED, budget, ratio=1.0, clip=25.0)
        for _ in keeping.seconds(public):
            pass
        paid.append(keeping.ledgers.paid[0])
    others = np.arange(whole.n_vehicles) != 4
    np.testing.assert_array_equal(paid[0][:, others], paid[1][:, others])
    assert (paid[0][:, 4] == 0.0).all()
    assert paid[1][0, 4] > 0.0
    np.testing.assert_array_equal(paid[2][0], paid[1][0])


def test_a_reset_begins_new_budgets_in_its_episodes_alone_and_a_wider_record_keeps_the_others():
    records = [crowd(20, k, last=PLACES) for k in range(2)]
    keeping = keep(records, SINGLE, 1.0)
    ledgers = keeping.ledgers
    for _ in keeping.seconds(constant(SINGLE, 0.01)):
        pass
    kept = ledgers.paid[0].copy()
    ledgers.reset(np.array([1]), np.array([20, 50]))
    assert ledgers.paid.shape == (2, 1, 50)
    np.testing.assert_array_equal(ledgers.paid[0, :, :20], kept)
    assert kept.any()
    assert not ledgers.paid[1].any()
    told = ledgers.of(ONE, np.array([20]))[0]
    np.testing.assert_array_equal(told, kept)
    told[:] = 99.0  # a copy
    np.testing.assert_array_equal(ledgers.paid[0, :, :20], kept)
