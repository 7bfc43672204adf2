import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dptse_env.privacy.sensitivity import contribution_sensitivity, paper_sensitivity
from tests.helpers import pairwise

NOMINAL = {
    "n_sensors": 8,
    "average_dwell": 8.0,
    "segment_length": 0.1,
    "free_flow_speed": 102.0,
    "jam_density": 333.0,
}


def bounds(**changes):
    density, speed = paper_sensitivity(**{**NOMINAL, **changes}).releases
    return density.bound, speed.bound


def test_golden_values_of_the_paper_highway():
    density, speed = bounds()
    assert density == pytest.approx(113.1, abs=0.05)  # veh/km
    assert speed == pytest.approx(density * 102 / 333, rel=1e-15)  # km/h


def test_releases_are_named_in_the_order_of_the_last_axis():
    density, speed = paper_sensitivity(**NOMINAL).releases
    assert (density.quantity, density.unit) == ("density", "veh/km")
    assert (speed.quantity, speed.unit) == ("speed", "km/h")


def test_the_assumptions_are_kept():
    sensitivity = paper_sensitivity(**NOMINAL)
    assert sensitivity.assumptions == (("n_sensors", 8), ("average_dwell_steps", 8.0))


@given(
    n_sensors=st.integers(1, 40),
    average_dwell=st.floats(1.0, 60.0),
    segment_length=st.floats(0.05, 1.0),
)
def test_density_bound_equals_a_count_of_what_one_vehicle_changes(
    n_sensors, average_dwell, segment_length
):
    """Twice per sensor (once in either record) for the dwell, 1 / length each time."""
    density, _ = bounds(
        n_sensors=n_sensors, average_dwell=average_dwell, segment_length=segment_length
    )
    squares = sum(2.0 * average_dwell * (1.0 / segment_length) ** 2 for _ in range(n_sensors))
    assert density == pytest.approx(math.sqrt(squares), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "value"), pairwise(NOMINAL, [0, -1.0, math.nan, math.inf, "8"], rest=False)
)
def test_bad_arguments_are_named(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be .*, got {value!r}$"):
        bounds(**{name: value})


def test_a_fraction_of_a_sensor_is_refused():
    with pytest.raises(ValueError, match=r"^n_sensors must be an integer >= 1, got 7\.5$"):
        bounds(n_sensors=7.5)


# --- bounded contributions ------------------------------------------------------------------------


def bounded(contributions=4, adjacency="replace", **changes):
    numbers = {"segment_length": 0.1, "largest_speed": 102.0, **changes}
    return contribution_sensitivity(contributions=contributions, adjacency=adjacency, **numbers)


def test_one_vehicle_more_adds_one_term_a_step():
    sensitivity = bounded(adjacency="add_remove")
    assert [r.bound for r in sensitivity.releases] == pytest.approx([2 * 10.0, 2 * 510.0])
    assert [r.unit for r in sensitivity.releases] == ["veh/km", "veh/h"]
    assert sensitivity.joint_mu((20.0, 1020.0)) == pytest.approx(math.sqrt(2.0))
    assert sensitivity.contributions == 4


def test_one_vehicle_replaced_is_on_two_segments_or_on_one_at_opposite_speeds():
    sensitivity = bounded()
    density, flow = sensitivity.releases
    assert density.bound == pytest.approx(math.sqrt(8.0) * 10.0)
    assert flow.bound == pytest.approx(2.0 * 1020.0)
    # Not both at once: with little noise on one quantity, that one counts alone.
    apart = math.hypot(density.bound / 100.0, math.sqrt(8.0) * 510.0 / 5100.0)
    assert sensitivity.joint_mu((100.0, 5100.0)) == pytest.approx(apart)
    assert sensitivity.joint_mu((1e9, 5100.0)) == pytest.approx(flow.bound / 5100.0)


def test_mean_speeds_keep_the_papers_relation():
    sensitivity = bounded(mean_speed_slope=0.3)
    density, speed = sensitivity.releases
    assert (speed.quantity, speed.unit) == ("speed", "km/h")
    assert speed.bound == pytest.approx(0.3 * density.bound)


def test_the_numbers_behind_a_bound_are_public():
    assert dict(bounded().assumptions) == {
        "contributions": 4, "segment_length_km": 0.1, "largest_speed_km_h": 102.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value"),
    pairwise(["contributions", "segment_length", "largest_speed"], [0, -1.0, math.nan], rest=False),
)
def test_bad_numbers_of_a_bound_are_named(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be .*, got {value!r}$"):
        bounded(**{name: value})
