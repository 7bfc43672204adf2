"""A road as arrays, and the rows that a measurement may have on it."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.model import MeasurementRows
from dptse_env.model.network import DIVERGE, EXIT, LINK, MERGE, make_layout
from tests.helpers import Road

from .oracle import HIGHWAY, ROWS


def test_the_papers_highway_has_the_orders_of_state_and_input():
    layout = make_layout(HIGHWAY)
    assert (layout.n_segments, layout.n_inputs, layout.n_boundaries) == (19, 9, 6)
    kinds = np.full(19, LINK)
    kinds[[2, 8, 15, 16]], kinds[[5, 11]], kinds[[14, 17, 18]] = MERGE, DIVERGE, EXIT
    np.testing.assert_array_equal(layout.kind, kinds)
    assert layout.parties[[0, 2, 15, 5, 14]].tolist() == [
        [0, 1, -1], [2, 3, 15], [15, 3, 2], [5, 6, 17], [14, -1, -1]
    ]  # fmt: skip
    assert layout.entries.tolist() == [0, 15, 16]
    assert layout.entry_inputs.tolist() == [0, 3, 5]
    assert layout.entry_boundaries.tolist() == [0, 2, 3]
    assert layout.exits.tolist() == [14, 17, 18]
    assert layout.exit_inputs.tolist() == [2, 7, 8]
    assert layout.exit_boundaries.tolist() == [1, 4, 5]
    # All that leaves a cell enters others, except at exits.
    leaving = np.bincount(layout.edges[:, 0], layout.edge_shares, minlength=19)
    np.testing.assert_allclose(leaving, ~np.isin(np.arange(19), layout.exits))
    neighbours = [set(row) - {-1} for row in layout.neighbours().tolist()]
    assert neighbours[1] == {0, 1, 2}
    assert neighbours[2] == {1, 2, 3, 15}  # the mainline before a merge
    assert neighbours[3] == {2, 3, 4, 15}  # the cell behind it
    assert neighbours[15] == {2, 3, 15}
    assert neighbours[6] == {5, 6, 7, 17}  # the mainline behind a diverge
    assert neighbours[17] == {5, 6, 17}


class Short(Road):
    segment_lanes = (3,)


@pytest.mark.parametrize(
    ("road", "message"),
    [
        (replace(HIGHWAY, n_mainline=0), r"network.n_mainline must be >= 1, got 0"),
        (replace(HIGHWAY, on_ramps=(0, 9)), r"network.on_ramps\[0\] must be in 1..14, got 0"),
        (replace(HIGHWAY, off_ramps=(9, 12)), r"network.off_ramps\[0\] must be .*, got 9"),
        (replace(HIGHWAY, exit_shares=(0.1,)), r"network.exit_shares must have 2 entries"),
        (replace(HIGHWAY, exit_shares=(0.1, 1.0)), r"network.exit_shares\[1\] must .*, got 1.0"),
        (replace(HIGHWAY, ramp_lanes=0), r"network.segment_lanes\[15\] must be .* > 0, got 0"),
        (Short(), r"network\.segment_lanes must have 15 entries, got 1"),
    ],
)
def test_impossible_geometry_is_named(road, message):
    with pytest.raises(ValueError, match=message):
        make_layout(road)


def test_a_row_is_the_average_of_its_segments():
    values = np.random.default_rng(0).normal(size=(4, 19, 2))
    averages = ROWS.averages(values)
    for m, (first, span) in enumerate(zip(ROWS.first, ROWS.span, strict=True)):
        np.testing.assert_allclose(averages[:, m], values[:, first : first + span].mean(axis=1))
    single = MeasurementRows.single(19)
    assert (single.are_single, ROWS.are_single) == (True, False)
    np.testing.assert_array_equal(single.averages(values), values)


@pytest.mark.parametrize(("first", "span"), [(-1, 1), (18, 2), (3, 0), (19, 1)])
def test_a_row_off_the_road_is_refused(first, span):
    with pytest.raises(ValueError, match=r"rows\[1\] must cover segments in 0\.\.18, got"):
        MeasurementRows(np.array([0, first]), np.array([1, span]), 19)
