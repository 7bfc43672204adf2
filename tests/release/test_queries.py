import dataclasses

import numpy as np
import pytest

from dptse_env.release import QueryOptions
from dptse_env.traffic import SHORT_HIGHWAY

ROAD = dataclasses.replace(SHORT_HIGHWAY, fixed_sensors=(5, 7, 2))  # 6 mainline segments, 2 ramps


def flags(n, *places):
    return np.isin(np.arange(n), places)[None]


def test_options_are_in_order_of_span_level_and_place():
    options = QueryOptions.make(4, 4, (1, 3), (2.0, 0.5))
    assert options.first.tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 0, 1]
    assert options.span.tolist() == [1] * 8 + [3] * 4
    assert options.level.tolist() == [2.0] * 4 + [0.5] * 4 + [2.0] * 2 + [0.5] * 2
    assert options.cost.tolist() == [1] * 8 + [3] * 4
    assert options.covers.shape == (options.n_options, 4) == (12, 4)
    assert np.flatnonzero(options.covers[9]).tolist() == [1, 2, 3]
    assert (options.covers.sum(axis=1) == options.span).all()
    assert str(options) == "query_spans (1, 3) and price_levels (2.0, 0.5)"


@pytest.mark.parametrize(
    ("bandwidth", "spans", "unit", "most"),
    [
        (4, (1,), "segments", 4),
        (4, (2,), "segments", 2),
        (5, (2, 3), "segments", 2),
        (6, (6,), "sums", 1),  # there is one option
        (4, (2, 3), "sums", 4),
        (4, (1, 4), "segments", 4),
    ],
)
def test_the_bandwidth_pays_for_so_many_queries(bandwidth, spans, unit, most):
    assert QueryOptions.make(6, bandwidth, spans, unit=unit).most_queries == most


def test_sums_cost_one_each():
    options = QueryOptions.make(6, 4, (1, 4), unit="sums")
    assert not options.costs_differ
    assert (options.cost == 1).all()
    assert QueryOptions.make(6, 4, (1, 4)).costs_differ


@pytest.mark.parametrize(
    ("levels", "standard"),
    [((1.0,), 1.0), ((0.25, 3.0), 3.0), ((2.0, 0.5), 0.5), ((5.0, 0.9), 0.9)],
)
def test_the_standard_level_is_nearest_to_one(levels, standard):
    assert QueryOptions.make(4, 4, levels=levels).standard_level == standard


def test_plain_options_are_the_segments():
    options = QueryOptions.make(6, 3)
    assert options.are_plain
    assert options.rows(ROAD).are_single
    assert options.sensor_rows(ROAD) == ROAD.fixed_sensors
    queried = flags(6, 1, 4)
    covered = options.covered(queried)
    np.testing.assert_array_equal(covered, queried)
    assert not np.shares_memory(covered, queried)
    for changed in ({"levels": (2.0,)}, {"spans": (2,)}, {"levels": (1.0, 2.0)}):
        assert not QueryOptions.make(6, 3, **changed).are_plain


def test_rows_are_options_then_ramps_then_sensors_without_an_option():
    options = QueryOptions.make(6, 4, (2,))
    rows = options.rows(ROAD)
    assert rows.first.tolist() == [0, 1, 2, 3, 4, 6, 7, 5, 2]
    assert rows.span.tolist() == [2] * 5 + [1] * 4
    assert rows.n_segments == 8
    assert options.sensor_rows(ROAD) == (7, 6, 8)


def test_sensors_share_the_option_of_span_and_level_one():
    options = QueryOptions.make(6, 4, (1, 2), (0.5, 1.0))
    rows, sensors = options.rows(ROAD), options.sensor_rows(ROAD)
    assert rows.n_rows == options.n_options + 2
    assert rows.first[list(sensors)].tolist() == [5, 7, 2]
    assert (rows.span[list(sensors)] == 1).all()
    assert [options.level[row] for row in sensors if row < options.n_options] == [1.0, 1.0]


def test_covered_is_what_queries_cover():
    options = QueryOptions.make(6, 4, (1, 3))
    assert np.flatnonzero(options.covered(flags(10, 0, 7, 8))).tolist() == [0, 1, 2, 3, 4]
