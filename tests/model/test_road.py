"""A road as arrays, and the channels that are measured on it."""

import numpy as np
import pytest

from dptse_env.model import ARZModel
from dptse_env.road import DIVERGE, EXIT, LINK, MERGE
from tests.helpers import make_channels

from .oracle import CHANNELS, HIGHWAY, PUBLISHED


def test_the_papers_highway_has_the_orders_of_state_and_input():
    road = HIGHWAY.road
    assert (road.n_segments, road.n_inputs, road.beside.size) == (19, 9, 6)
    kinds = np.full(19, LINK)
    kinds[[2, 8, 15, 16]], kinds[[5, 11]], kinds[[14, 17, 18]] = MERGE, DIVERGE, EXIT
    np.testing.assert_array_equal(road.kind, kinds)
    assert road.parties[[0, 2, 15, 5, 14]].tolist() == [
        [0, 1, -1], [2, 3, 15], [15, 3, 2], [5, 6, 17], [14, -1, -1]
    ]  # fmt: skip
    assert road.entries.tolist() == [0, 15, 16]
    assert road.entry_inputs.tolist() == [0, 3, 5]
    assert road.entry_cells.tolist() == [19, 21, 22]
    assert road.exits.tolist() == [14, 17, 18]
    assert road.exit_inputs.tolist() == [2, 7, 8]
    assert road.exit_cells.tolist() == [20, 23, 24]
    # All that leaves a cell enters others, except at exits.
    leaving = np.bincount(road.edges[:, 0], road.edge_share, minlength=19)
    np.testing.assert_allclose(leaving, ~np.isin(np.arange(19), road.exits))
    neighbours = [set(row) - {-1} for row in road.neighbours.tolist()]
    assert neighbours[1] == {0, 1, 2}
    assert neighbours[2] == {1, 2, 3, 15}  # the mainline before a merge
    assert neighbours[3] == {2, 3, 4, 15}  # the cell behind it
    assert neighbours[15] == {2, 3, 15}
    assert neighbours[6] == {5, 6, 7, 17}  # the mainline behind a diverge
    assert neighbours[17] == {5, 6, 17}


def test_a_channel_is_the_average_of_its_segments():
    values = np.random.default_rng(0).normal(size=(4, 19, 2))
    averages = ARZModel(HIGHWAY.road, PUBLISHED, 1.0, 51.0, CHANNELS).averages(values)
    for m, (first, span) in enumerate(zip(CHANNELS.first, CHANNELS.span, strict=True)):
        np.testing.assert_allclose(averages[:, m], values[:, first : first + span].mean(axis=1))
    single = ARZModel(HIGHWAY.road, PUBLISHED, 1.0, 51.0)
    np.testing.assert_array_equal(single.averages(values), values)


@pytest.mark.parametrize(("first", "span"), [(-1, 1), (18, 2), (3, 0), (19, 1)])
def test_a_channel_off_the_road_is_refused(first, span):
    channels = make_channels((0, first), (1, span))
    with pytest.raises(ValueError, match=r"model\.channels must cover segments in 0\.\.18"):
        ARZModel(HIGHWAY.road, PUBLISHED, 1.0, 51.0, channels)
