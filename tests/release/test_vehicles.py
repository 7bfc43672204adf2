"""The true traffic in memory, and ledgers beside the same ledgers written out in Python."""

import numpy as np
import pytest

from dptse_env.model import Channels
from dptse_env.release import Group, PacedSettings, Traffic
from dptse_env.release.vehicles import Ledgers, Terms, require_exact_sums
from dptse_env.traffic import SHORT_HIGHWAY, Penetration, RecordLibrary
from tests.helpers import UNEVEN, pairwise

from .worlds import (
    BOTH,
    COLUMNS,
    LIMIT,
    ONE,
    TWO_GROUPS,
    WHOLE,
    PlainLedgers,
    Public,
    T,
    Worlds,
    collected,
    crowd,
)

# --- traffic ----------------------------------------------------------------------------------


def test_aggregates_and_vehicles_are_those_of_the_second_and_groups_see_some_of_them():
    some = Penetration((0.2, 0.6), misreporting=0.5, misreport_factor=0.5)
    traffic = Traffic(SHORT_HIGHWAY, (4, 7), RecordLibrary(), [None, some])
    traffic.load([0, 1])
    record = traffic.library.get(SHORT_HIGHWAY, 7)
    own, second = record.step == 120, (np.array([1]), np.array([120]))
    (answer,) = traffic.aggregates(*second)
    for segment in range(SHORT_HIGHWAY.geometry.n_segments):
        here = record.speed[own & (record.segment == segment)].astype(float)
        mean = here.mean() if len(here) else LIMIT
        assert answer[segment] == pytest.approx([len(here) / 0.1, mean])
    assert np.count_nonzero(answer[:, 0]) > 3
    rows = traffic.vehicles(*second)
    seen = slice(rows.start[0], rows.stop[0])
    np.testing.assert_array_equal(rows.vehicle[seen], record.vehicle[own])
    np.testing.assert_array_equal(rows.cell[seen], record.segment[own])
    np.testing.assert_array_equal(rows.speed[0, seen], record.speed[own])
    np.testing.assert_array_equal(rows.speed[1, seen], some.speeds(7, record)[own])


def test_an_empty_segment_has_its_own_limit_and_a_density_its_own_length():
    road = UNEVEN.replaced(duration=T)
    n_columns = road.geometry.n_cells
    whole = crowd(seed=3, last=n_columns, n_columns=n_columns)
    table = Traffic(road, (0,), Worlds(whole))
    table.load(0)
    lengths, limits = road.road.lengths, road.road.limits
    density, speed = np.moveaxis(table.complete(0), -1, 0)
    np.testing.assert_allclose(density * np.array(lengths), whole.counts)
    empty = whole.counts == 0
    assert 0 < empty.sum() < empty.size
    np.testing.assert_array_equal(speed[empty], np.broadcast_to(limits, empty.shape)[empty])


def test_missing_records_are_made_together_and_loaded_once(monkeypatch):
    library, ensured, read, record = RecordLibrary(), [], [], RecordLibrary().get(SHORT_HIGHWAY, 4)
    monkeypatch.setattr(library, "ensure", lambda corridor, seeds: ensured.append(list(seeds)))
    monkeypatch.setattr(library, "get", lambda corridor, seed: read.append(seed) or record)
    traffic = Traffic(SHORT_HIGHWAY, (4, 7, 9), library)
    for indices in (0, np.array([2, 0, 1, 2]), [0, 1, 2]):
        traffic.load(indices)
    assert ensured == [[7, 9]]
    assert read == [4, 7, 9]


# --- ledgers ----------------------------------------------------------------------------------


SOME_CONNECTED = Group("queries", 0.6, Penetration(0.5)), Group("sensors", 0.4)


@pytest.mark.parametrize(
    ("spans", "groups", "ratio"),
    pairwise([(1,), (1, 2, 3)], [WHOLE, TWO_GROUPS, SOME_CONNECTED], [0.3, 1.0], rest=False),
)
def test_ledgers_count_as_they_do_when_written_out(spans, groups, ratio):
    """Three episodes at random prices and centres; some contributions are refused."""
    worlds = Worlds(*(crowd(30, seed) for seed in range(3)))
    given = {"groups": groups, "spans": spans, "bandwidth": 6}
    made, plain = (
        worlds.started(PacedSettings(ratio=ratio, clip=25.3), ledgers=kind, **given)
        for kind in (None, PlainLedgers)
    )
    budget, generator, shape = made.budget, np.random.default_rng(0), (T, made.task.n_channels)
    public = Public(
        generator.random(shape) < 0.6,
        generator.uniform(0.0, 0.3, shape) * budget[made.task.channels.group],
        generator.uniform(0.0, LIMIT, (T, COLUMNS)),
    )
    seconds = zip(collected(made, public), collected(plain, public), strict=True)
    for (found, refused), (expected, expected_refused) in seconds:
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(refused, expected_refused)
    paid = made.ledgers.paid
    np.testing.assert_array_equal(paid, plain.ledgers.paid)
    assert (paid <= budget[:, None]).all()
    assert (paid > 0.5 * budget[:, None]).any(axis=(0, 2)).all()
    assert refused.any()


def test_a_reset_begins_new_budgets_in_its_episodes_alone_and_a_wider_record_keeps_the_others():
    ledgers = Ledgers(Channels(ONE, ONE + 1, ONE, np.ones(1)), 2, Terms(np.ones(1)))
    ledgers.reset(BOTH, np.array([20, 10]))
    ledgers.paid += np.arange(1.0, 41.0).reshape(2, 1, 20)
    kept = ledgers.paid[0].copy()
    ledgers.reset(np.array([1]), np.array([20, 50]))
    assert ledgers.paid.shape == (2, 1, 50)
    np.testing.assert_array_equal(ledgers.paid[0], np.pad(kept, [(0, 0), (0, 30)]))
    assert not ledgers.paid[1].any()
    (told,) = ledgers.of(ONE, np.array([20]))
    np.testing.assert_array_equal(told, kept)
    assert not np.shares_memory(told, ledgers.paid)


@pytest.mark.parametrize(("sigma", "clip"), [((1e-7, 1.0), 25.0), ((1.0, 1e-6), 25.0)])
def test_noise_too_small_for_exact_sums_is_refused(sigma, clip):
    require_exact_sums(np.ones(2), clip)
    with pytest.raises(ValueError, match=r"^privacy\.epsilon must be smaller: sums of 1048576"):
        require_exact_sums(np.array(sigma), clip)
