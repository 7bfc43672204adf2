"""The true traffic in memory, and ledgers beside the same ledgers written out in Python."""

import dataclasses

import numpy as np
import pytest

from dptse_env.release import Traffic
from dptse_env.traffic import SHORT_HIGHWAY, Penetration, RecordLibrary
from tests.cases import pairwise
from tests.model.roads import UNEVEN

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
    keep,
    stays,
)

# --- traffic ----------------------------------------------------------------------------------


def test_aggregates_and_vehicles_are_those_of_the_second_and_groups_see_some_of_them():
    traffic = Traffic(SHORT_HIGHWAY, (4, 7), RecordLibrary(), [None, Penetration(0.4)])
    traffic.load(0)
    record = traffic.library.get(SHORT_HIGHWAY, 4)
    own, second = record.step == 120, (np.array([0]), np.array([120]))
    (answer,) = traffic.aggregates(*second)
    for segment in range(SHORT_HIGHWAY.n_segments):
        here = record.speed[own & (record.segment == segment)].astype(float)
        mean = here.mean() if len(here) else LIMIT
        assert answer[segment] == pytest.approx([len(here) / 0.1, mean])
    assert np.count_nonzero(answer[:, 0]) > 3
    rows = traffic.vehicles(*second)
    seen = slice(rows.start[0], rows.stop[0])
    np.testing.assert_array_equal(rows.vehicle[seen], record.vehicle[own])
    np.testing.assert_array_equal(rows.place[seen], record.segment[own])
    np.testing.assert_array_equal(rows.speed[0, seen], record.speed[own])
    connected = Penetration(0.4).connected(4, record)[record.vehicle[own]]
    expected = np.where(connected, record.speed[own], -1.0)
    np.testing.assert_array_equal(rows.speed[1, seen], expected)
    assert 0 < connected.sum() < connected.size


def test_an_empty_segment_has_its_own_limit_and_a_density_its_own_length():
    road = dataclasses.replace(UNEVEN, duration=T)
    n_columns = road.n_segments + road.n_boundaries
    whole = crowd(seed=3, last=n_columns, n_columns=n_columns)
    table = Traffic(road, (0,), Worlds(whole))
    table.load(0)
    lengths, limits = map(road.with_boundaries, (road.segment_lengths, road.speed_limits))
    density, speed = np.moveaxis(table.complete(0), -1, 0)
    np.testing.assert_allclose(density * np.array(lengths), whole.counts)
    empty = whole.counts == 0
    assert 0 < empty.sum() < empty.size
    np.testing.assert_array_equal(speed[empty], np.broadcast_to(limits, empty.shape)[empty])


def test_missing_records_are_made_together_and_loaded_once(monkeypatch):
    library, ensured = RecordLibrary(), []
    monkeypatch.setattr(library, "ensure", lambda corridor, seeds: ensured.append(list(seeds)))
    traffic = Traffic(SHORT_HIGHWAY, (4, 7, 9), library)
    assert traffic.load(0) == [0]
    monkeypatch.setattr(library, "get", lambda corridor, seed: RecordLibrary().get(corridor, 4))
    assert traffic.load(np.array([2, 0, 1, 2])) == [1, 2]
    assert traffic.load([0, 1, 2]) == []
    assert ensured == [[7, 9]]


# --- ledgers ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("columns", "seed", "ratio"),
    pairwise([SINGLE, OVERLAPPING, GROUPED], range(4), [0.0, 0.3, 1.0], rest=False),
)
def test_ledgers_count_as_they_do_when_written_out(columns, seed, ratio):
    """Three episodes at random prices and centres; some contributions are refused."""
    records = [crowd(30, 10 * seed + k, last=PLACES + 2) for k in range(3)]
    given = {"ratio": ratio, "clip": 25.0 if ratio else np.inf}
    budget = np.array([0.3, 0.2])[: columns[2].max() + 1]
    made = keep(records, columns, budget, **given)
    plain = keep(records, columns, budget, PlainLedgers, **given)
    generator, shape = np.random.default_rng(seed), (T, len(columns[0]))
    public = Public(
        generator.random(shape) < 0.6,
        generator.uniform(0.0, 0.09, shape),
        generator.uniform(0.0, LIMIT, (T, PLACES)),
    )
    for found, expected in zip(made.seconds(public), plain.seconds(public), strict=True):
        for values, wanted in zip(found, expected, strict=True):
            np.testing.assert_array_equal(values, wanted)
    paid = made.ledgers.paid
    np.testing.assert_array_equal(paid, plain.ledgers.paid)
    assert (paid <= budget[:, None]).all()
    assert (paid > 0.5 * budget[:, None]).any(axis=(0, 2)).all()


def test_a_price_of_one_and_no_ratio_is_a_cap():
    """A vehicle counts in its first steps that are observed, at any speed, and in no later one."""
    keeping = keep([stays(0, 50.0)], SINGLE, 3.0)
    observed = np.ones((T, 4), dtype=bool)
    observed[1] = False  # not asked, not charged
    seconds = keeping.seconds(constant(SINGLE, 1.0, 0.0, observed))
    assert [sums[0, 0].tolist() for sums, _ in seconds] == [
        [1.0, 50.0], [0.0, 0.0], [1.0, 50.0], [1.0, 50.0], *[[0.0, 0.0]] * 4,
    ]  # fmt: skip


def test_a_reset_begins_new_budgets_in_its_episodes_alone_and_a_wider_record_keeps_the_others():
    keeping = keep([crowd(20, k, last=PLACES) for k in range(2)], SINGLE, 1.0)
    ledgers = keeping.ledgers
    for _ in keeping.seconds(constant(SINGLE, 0.01)):
        pass
    kept = ledgers.paid[0].copy()
    ledgers.reset(np.array([1]), np.array([20, 50]))
    assert ledgers.paid.shape == (2, 1, 50)
    np.testing.assert_array_equal(ledgers.paid[0, :, :20], kept)
    assert kept.any()
    assert not ledgers.paid[1].any()
    (told,) = ledgers.of(ONE, np.array([20]))
    np.testing.assert_array_equal(told, kept)
    assert not np.shares_memory(told, ledgers.paid)
