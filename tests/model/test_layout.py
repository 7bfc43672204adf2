from dataclasses import dataclass, replace

import numpy as np
import pytest

from dptse_env.model.network import make_layout

from .roads import HIGHWAY, Road


def test_paper_highway_has_the_orders_of_state_and_input():
    layout = make_layout(HIGHWAY)
    assert layout.n_segments == 19
    assert layout.n_inputs == 9
    assert layout.n_boundaries == 6
    assert layout.merges.tolist() == [[2, 8], [15, 16], [3, 9]]
    assert layout.diverges.tolist() == [[5, 11], [6, 12], [17, 18]]
    assert layout.entries.tolist() == [0, 15, 16]
    assert layout.entry_inputs.tolist() == [0, 3, 5]
    assert layout.exits.tolist() == [14, 17, 18]
    assert layout.exit_inputs.tolist() == [2, 7, 8]
    assert layout.entry_boundaries.tolist() == [0, 2, 3]
    assert layout.exit_boundaries.tolist() == [1, 4, 5]


def test_every_cell_flows_somewhere_exactly_once():
    layout = make_layout(HIGHWAY)
    leaving = layout.routing.sum(axis=0)
    expected = np.ones(19)
    expected[layout.exits] = 0.0
    np.testing.assert_allclose(leaving, expected)


def test_a_row_depends_on_four_cells_at_most_on_the_paper_highway():
    assert make_layout(HIGHWAY).sparsity().sum(axis=1).max() == 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_mainline": 0}, r"network.n_mainline must be >= 1, got 0"),
        ({"on_ramps": (0, 9)}, r"network.on_ramps\[0\] must be in 1..14, got 0"),
        ({"off_ramps": (9, 12)}, r"off_ramps\[0\] must be a face without another ramp, got 9"),
        ({"exit_shares": (0.1,)}, r"network.exit_shares must have 2 entries"),
        ({"exit_shares": (0.1, 1.0)}, r"network.exit_shares\[1\] must be in \[0, 1\), got 1.0"),
        ({"ramp_lanes": 0}, r"network.segment_lanes\[15\] must be finite and > 0, got 0"),
    ],
)
def test_impossible_geometry_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        make_layout(replace(HIGHWAY, **changes))


def test_lanes_must_be_given_for_every_segment():
    @dataclass(frozen=True)
    class Short(Road):
        segment_lanes: tuple[int, ...] = (3,)

    with pytest.raises(ValueError, match=r"network\.segment_lanes must have 15 entries, got 1"):
        make_layout(Short())
