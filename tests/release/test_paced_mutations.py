"""Ways to get the paced ledger wrong: each must break the bound, or show in a ledger's values.

Those that leave the bound alone but look where they must not, centres and prices from the truth,
are in ``tests/test_paced_non_interference.py``.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from dptse_env.privacy import mu_of
from dptse_env.release import Paced, PacedSettings
from dptse_env.release.noise import NoiseStreams

from .paced_worlds import (
    COLUMNS,
    LIMIT,
    OVERLAPPING,
    SINGLE,
    PlainLedgers,
    T,
    collect,
    constant,
    drives,
    exhausting,
    keep_ledgers,
    square,
    standardised,
    stays,
)
from .test_mechanism import residual_faults
from .worlds import AWAY, Worlds, record

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
    sensors = (2,)

    def cost(self, price, raw, column, nth):
        return 0.0 if column in self.sensors else super().cost(price, raw, column, nth)


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

    def __init__(self, *args, budget, **keywords):
        super().__init__(*args, budget=2.0 * budget, **keywords)


def queue(first):
    """Vehicle 0, if there, stands on segment 1 for the first half; vehicle 1 for the second."""
    early = np.arange(T + 1) <= T // 2
    places = np.where([early & first, ~early], 1, AWAY)
    places[:, 0] = AWAY
    return record(places, np.zeros((2, T + 1)), COLUMNS)


MOVES = drives(np.arange(T) % 4, 0.0)
NOBODY = stays(0, 0.0, present=False)
MUTANTS = {
    "a ledger for each segment": (LedgerForEachSegment, ADD, SINGLE, MOVES, NOBODY, 3.9),
    "a ledger for each query": (LedgerForEachQuery, ADD, OVERLAPPING, MOVES, NOBODY, 2.5),
    "a ledger that vehicles share": (
        LedgerOfAllOnASegment, ADD, SINGLE, queue(True), queue(False), 1.9,
    ),
    "fixed sensors that are not charged": (
        FreeSensors, ADD, SINGLE, drives(np.repeat([2, 1], T // 2), 0.0), NOBODY, 1.9,
    ),
    "overlaps that are charged once": (
        OverlapsChargedOnce, ADD, OVERLAPPING, stays(1, 0.0), NOBODY, 4.9,
    ),
    "charged at the clipped and released at the unclipped deviation": (
        ReleasedUnclipped, ADD, SINGLE, stays(1, 0.0), NOBODY, 2.5,
    ),
    "charged for the count alone": (
        ChargedForTheCountAlone, ADD, SINGLE, stays(1, 0.0), NOBODY, 1.9,
    ),
    "the budget of add_remove under replace": (
        TwiceTheBudget, REPLACE, SINGLE, stays(1, 0.0), stays(3, 0.0), 1.9,
    ),
}  # fmt: skip


def reached(kind, asked, columns, worlds):
    """Squared distance over mu^2, at a price that uses a correct ledger up in a second."""
    public = constant(columns, exhausting(worlds, asked, columns, within=1))
    ledgers = keep_ledgers(worlds, asked, columns, kind)
    return square(collect(ledgers, public), public, asked) / MU**2


@pytest.mark.parametrize(
    ("kind", "asked", "columns", "first", "second", "least"), MUTANTS.values(), ids=MUTANTS
)
def test_wrong_ledgers_exceed_mu(kind, asked, columns, first, second, least):
    worlds = first, second
    assert reached(kind, asked, columns, worlds) > least
    assert 0.7 < reached(PlainLedgers, asked, columns, worlds) <= 1.0


def test_a_ratio_above_one_exceeds_mu_under_replace():
    """Two vehicles that deviate oppositely on one segment: 4 r of the 2 (1 + r) that they pay."""
    worlds = stays(1, LIMIT), stays(1, 0.0)
    for ratio, least, most in ((1.0, 0.999, 1.0), (2.0, 1.33, 1.34)):
        ledgers = keep_ledgers(worlds, REPLACE)
        ledgers.ratio = ratio
        public = constant(SINGLE, 0.999999 * ledgers.budget / (T * (1.0 + ratio)))
        noise = SimpleNamespace(clip=REPLACE.clip, ratio=ratio)
        assert least < square(collect(ledgers, public), public, noise) / MU**2 <= most
    with pytest.raises(ValueError, match=r"^privacy\.ratio must be at most 1"):
        PacedSettings(ratio=2.0)


def test_charging_what_is_not_released_keeps_the_bound_and_wastes_the_budget():
    """No privacy is lost; vehicles run out early, which the values of ledgers show."""
    worlds, asked = (stays(1, 0.0), NOBODY), ADD
    public = constant(SINGLE, exhausting(worlds, asked, SINGLE))
    ledgers, counted = {}, {}
    for kind in (PlainLedgers, ChargedUnclipped):
        ledgers[kind] = keep_ledgers(worlds, asked, SINGLE, kind)
        counted[kind] = sum(second.counts[0].sum() for second in collect(ledgers[kind], public))
        found = reached(kind, asked, SINGLE, worlds)
        assert found <= 1.0
    # Deviations of 51 km/h at a clip of 25: (1 + 51^2 / 25^2) / 2 of the right charge.
    assert counted == {PlainLedgers: T, ChargedUnclipped: 3}
    paid = [
        each.paid_by(0, 0)[0] / count
        for each, count in zip(ledgers.values(), counted.values(), strict=True)
    ]
    assert paid[1] / paid[0] == pytest.approx((1.0 + (51.0 / 25.0) ** 2) / 2.0)


class QuietNoise(Paced):
    def __init__(self, setup):
        super().__init__(setup)
        self.noise = NoiseStreams(setup.n_episodes, setup.n_columns, scale=1.0 / 1.41)


def test_less_noise_than_declared_shows_in_the_residuals():
    worlds = Worlds(drives(np.arange(T) % 8, 30.0))
    assert residual_faults(*standardised(worlds, PacedSettings()), 1.0) == []
    faults = residual_faults(*standardised(worlds, PacedSettings(), kind=QuietNoise), 1.0)
    assert {"variance of density", "variance of speed"} <= set(faults)
