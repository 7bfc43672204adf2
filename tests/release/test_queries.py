"""Queries, and the channels that answer them."""

import numpy as np
import pytest

from dptse_env.release import Queries
from dptse_env.traffic import SHORT_HIGHWAY

ROAD = SHORT_HIGHWAY.replaced(fixed_sensors=(5, 7, 2))  # 6 mainline segments, 2 ramps


def flags(n, *places):
    return np.isin(np.arange(n), places)[None]


def test_options_are_in_order_of_span_and_place():
    queries = Queries.make(4, 4, (1, 3))
    assert queries.first.tolist() == [0, 1, 2, 3, 0, 1]
    assert queries.span.tolist() == [1] * 4 + [3] * 2
    assert queries.cost.tolist() == [1] * 4 + [3] * 2
    assert queries.covers.shape == (queries.n_queries, 4) == (6, 4)
    assert np.flatnonzero(queries.covers[5]).tolist() == [1, 2, 3]
    assert np.flatnonzero(queries.covered(flags(6, 0, 5))).tolist() == [0, 1, 2, 3]
    assert str(queries) == "query_spans (1, 3)"


@pytest.mark.parametrize(
    ("bandwidth", "spans", "unit", "most"),
    [
        (4, (1,), "segments", 4),
        (5, (2, 3), "segments", 2),
        (6, (6,), "sums", 1),  # there is one query
        (4, (2, 3), "sums", 4),
        (4, (1, 4), "segments", 4),
    ],
)
def test_the_bandwidth_pays_for_so_many_queries(bandwidth, spans, unit, most):
    queries = Queries.make(6, bandwidth, spans, unit=unit)
    assert queries.most_queries == most
    np.testing.assert_array_equal(queries.cost, queries.span if unit == "segments" else 1)
    assert queries.costs_differ == (unit == "segments" and len(spans) > 1)


def test_plain_options_are_the_segments():
    queries, queried = Queries.make(6, 3), flags(6, 1, 4)
    assert queries.are_segments
    assert queries.sensor_channels(ROAD) == ROAD.fixed_sensors
    np.testing.assert_array_equal(queries.covered(queried), queried)
    assert not np.shares_memory(queries.covered(queried), queried)
    assert not any(Queries.make(6, 3, spans).are_segments for spans in ((2,), (1, 2)))


@pytest.mark.parametrize(
    ("spans", "separate", "sensors"),
    [
        ((2,), False, [7, 6, 8]),
        ((1, 2), False, [5, 12, 2]),  # queries of span one
        ((1, 2), True, [13, 12, 14]),
    ],
)
def test_channels_are_options_then_ramps_then_sensors_without_an_option(spans, separate, sensors):
    queries = Queries.make(6, 4, spans, separate_sensors=separate)
    first = [*queries.first.tolist(), *queries.others(ROAD)]
    found = list(queries.sensor_channels(ROAD))
    assert found == sensors
    assert [first[channel] for channel in found] == [5, 7, 2]
    assert first[queries.n_queries :][:2] == [6, 7]
    assert len(first) == max(queries.n_queries + 2, *(channel + 1 for channel in sensors))
