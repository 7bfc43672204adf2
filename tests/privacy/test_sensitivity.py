"""Sensitivities: the paper's, and those of bounded contributions beside a search for the worst."""

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dptse_env.privacy import contribution_sensitivity, paper_sensitivity

PAPER = {
    "n_sensors": 8, "average_dwell": 8.0, "segment_length": 0.1, "free_flow_speed": 102.0,
    "jam_density": 333.0,
}  # fmt: skip
BOUNDED = {
    "contributions": 4, "adjacency": "replace", "segment_length": 0.1, "largest_speed": 102.0,
}  # fmt: skip


def test_golden_values_of_the_paper_highway():
    sensitivity = paper_sensitivity(**PAPER)
    density, speed = sensitivity.releases
    assert (density.quantity, density.unit) == ("density", "veh/km")
    assert (speed.quantity, speed.unit) == ("speed", "km/h")
    assert density.bound == pytest.approx(113.1, abs=0.05)
    assert speed.bound == pytest.approx(density.bound * 102 / 333, rel=1e-15)
    assert sensitivity.assumptions == (("n_sensors", 8), ("average_dwell_steps", 8.0))


# --- bounded contributions -------------------------------------------------------------------


def largest_distance(adjacency, stds, *, length, v_0):
    """The largest distance of a step's sums in units of the noise, over all places and speeds."""
    alone = [None, *itertools.product((0, 1), (-v_0, -0.3 * v_0, 0.0, v_0))]
    squares = []
    for one, other in itertools.product(alone, alone if adjacency == "replace" else [None]):
        change = {(place, quantity): 0.0 for place in (0, 1) for quantity in (0, 1)}
        for vehicle, sign in ((one, 1.0), (other, -1.0)):
            if vehicle is not None:
                place, deviation = vehicle
                change[place, 0] += sign / length
                change[place, 1] += sign * deviation / length
        squares.append(sum((d / stds[quantity]) ** 2 for (_, quantity), d in change.items()))
    return math.sqrt(max(squares))


@pytest.mark.parametrize("adjacency", ["replace", "add_remove"])
@settings(max_examples=40)
@given(
    contributions=st.integers(1, 100),
    length=st.floats(0.05, 1.0),
    v_0=st.floats(10.0, 100.0),
    ratio=st.floats(-2.0, 2.0).map(lambda power: 10.0**power),
)
def test_no_neighbours_are_further_apart_and_some_are_as_far(
    adjacency, contributions, length, v_0, ratio
):
    sensitivity = contribution_sensitivity(
        contributions=contributions, adjacency=adjacency, segment_length=length,
        largest_speed=2.0 * v_0,
    )  # fmt: skip
    given = {"length": length, "v_0": v_0}
    for stds in ((20.0, 20.0 * v_0 * ratio), (20.0, math.inf), (math.inf, 20.0)):
        found = math.sqrt(contributions) * largest_distance(adjacency, stds, **given)
        assert sensitivity.joint_mu(stds) == pytest.approx(found, rel=1e-9)
    # Each by itself, as a report states them.
    alone = [largest_distance(adjacency, stds, **given) for stds in ((1, math.inf), (math.inf, 1))]
    assert [release.bound for release in sensitivity.releases] == pytest.approx(
        [math.sqrt(contributions) * each for each in alone]
    )


def test_what_is_bounded_is_told():
    flows = contribution_sensitivity(**BOUNDED)
    assert [r.unit for r in flows.releases] == ["veh/km", "veh/h"]
    assert flows.contributions == 4
    assert dict(flows.assumptions) == {
        "contributions": 4, "segment_length_km": 0.1, "largest_speed_km_h": 102.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("sensitivity", "good", "whole"),
    [
        (paper_sensitivity, PAPER, "n_sensors"),
        (contribution_sensitivity, BOUNDED, "contributions"),
    ],
)
def test_bad_numbers_are_named(sensitivity, good, whole):
    bad = [(name, value) for name in good for value in (0, -1.0, math.nan, math.inf, "8")]
    for name, value in [*bad, (whole, 7.5)]:
        if name != "adjacency":
            with pytest.raises(ValueError, match=rf"^{name} must be .*, got {value!r}$"):
                sensitivity(**{**good, name: value})
