"""No two trips are told apart by more than mu under ledgers, whatever is public.

As in `test_sensitivity`, the property holds surely and is tested without noise: for any queries,
prices and centres, two records that differ in one vehicle have sums that are never further apart
than mu, in units of the noise.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.privacy import mu_of
from dptse_env.release import PacedSettings

from .adjacent import adjacent_trips
from .paced_worlds import (
    COLUMNS,
    LIMIT,
    OVERLAPPING,
    PLACES,
    SINGLE,
    Public,
    T,
    collect,
    constant,
    drives,
    exhausting,
    keep_ledgers,
    request,
    square,
    stays,
    streams,
)
from .worlds import AWAY, BOTH, Worlds, record

ALL_COLUMNS = {"single": SINGLE, "overlapping": OVERLAPPING}


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
    places, speeds, *others = draw(adjacent_trips(asked, 3, T, PLACES, LIMIT))
    return record(places, speeds, COLUMNS), record(*others, COLUMNS)


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


@pytest.mark.parametrize("columns", ALL_COLUMNS.values(), ids=ALL_COLUMNS)
@settings(max_examples=120, deadline=None)
@given(st.data())
def test_nothing_public_exceeds_mu(columns, data):
    asked = data.draw(wishes())
    mu = mu_of(asked.epsilon, asked.delta)
    ledgers = keep_ledgers(data.draw(pairs(asked)), asked, columns)
    public = data.draw(public_numbers(len(columns.first), PLACES, mu))
    assert square(collect(ledgers, public), public, asked) <= mu**2


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_second_exceeds_mu_where_seconds_are_protected(data):
    asked = data.draw(wishes(unit="event"))
    mu = mu_of(asked.epsilon, asked.delta)
    release = Worlds(*data.draw(pairs(asked))).release(asked)
    public = data.draw(public_numbers(COLUMNS, COLUMNS, mu))
    release.reset(BOTH, streams(0, 1))
    sums = [
        release.collect(
            request(t + 1, public.observed[t], episodes=BOTH),
            *(array[[t, t]] for array in public[1:]),
        )
        for t in range(T)
    ]
    assert square(sums, public, asked) <= mu**2


# --- made-up worst cases: nothing is wasted -------------------------------------------------------

EARLY = np.arange(T) < T // 2
PASSES, STANDS = stays(1, LIMIT), stays(1, 0.0)
WORST = {
    "opposite deviations on one segment": (SINGLE, PASSES, STANDS, {}),
    "two segments": (SINGLE, STANDS, stays(3, 0.0), {}),
    "two segments, as predicted": (SINGLE, stays(1, LIMIT / 2), stays(3, LIMIT / 2), {}),
    "opposite deviations in all overlapping queries": (OVERLAPPING, PASSES, STANDS, {}),
    "two segments, overlapping queries": (OVERLAPPING, stays(0, 0.0), stays(3, 0.0), {}),
    "one after the other": (
        SINGLE,
        drives(np.where(EARLY, 1, AWAY), 0.0),
        drives(np.where(EARLY, AWAY, 1), 0.0),
        {},
    ),
    "a lone vehicle": (SINGLE, STANDS, stays(1, 0.0, present=False), {"adjacency": "add_remove"}),
    "a lone vehicle, mostly its speed": (
        SINGLE,
        STANDS,
        stays(1, 0.0, present=False),
        {"adjacency": "add_remove", "ratio": 50.0},
    ),
}


@pytest.mark.parametrize(("columns", "first", "second", "wish"), WORST.values(), ids=WORST)
def test_made_up_trips_reach_the_whole_of_mu(columns, first, second, wish):
    asked = PacedSettings(clip=LIMIT / 2, **wish)
    worlds = first, second
    public = constant(columns, exhausting(worlds, asked, columns))
    reached = square(collect(keep_ledgers(worlds, asked, columns), public), public, asked)
    assert 0.999 < reached / mu_of(asked.epsilon, asked.delta) ** 2 <= 1.0


def test_opposite_deviations_tell_less_at_a_lower_ratio():
    """By 4 r of the 2 (1 + r) that both have paid."""
    asked = PacedSettings(clip=LIMIT / 2, ratio=0.5)
    public = constant(SINGLE, exhausting((PASSES, STANDS), asked, SINGLE))
    reached = square(collect(keep_ledgers((PASSES, STANDS), asked), public), public, asked)
    assert reached == pytest.approx(mu_of(1.0, 0.05) ** 2 * 2.0 / 3.0, rel=1e-3)
