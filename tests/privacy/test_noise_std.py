import dataclasses
import math

import numpy as np
import pytest
from dp_accounting import dp_event, get_epsilon_gaussian, get_sigma_gaussian, pld
from hypothesis import given, settings
from hypothesis import strategies as st

from dptse_env.privacy import (
    contribution_sensitivity,
    joint_noise_std,
    le_ny_kappa,
    mu_of,
    paper_sensitivity,
    printed_noise_std,
    single_noise_std,
)

HIGHWAY = paper_sensitivity(
    n_sensors=8,
    average_dwell=8.0,
    segment_length=0.1,
    free_flow_speed=102.0,
    jam_density=333.0,
)


def bounded(cap=16, adjacency="replace"):
    return contribution_sensitivity(
        contributions=cap, adjacency=adjacency, segment_length=0.1, largest_speed=102.0
    )


def test_golden_noise_as_printed():
    density, speed = printed_noise_std(HIGHWAY, 1.0, 0.05)
    assert density == pytest.approx(20.3, abs=0.05)  # veh/km
    assert speed == pytest.approx(11.2, abs=0.05)  # km/h


def test_golden_noise_corrected():
    density, speed = single_noise_std(HIGHWAY, 1.0, 0.05)
    assert density == pytest.approx(215.8, abs=0.1)  # veh/km
    assert speed == pytest.approx(66.1, abs=0.1)  # km/h


@pytest.mark.parametrize(("epsilon", "delta"), [(0.1, 0.05), (1.0, 0.05), (1.0, 0.001), (5, 0.05)])
def test_kappa_scales_the_variance_as_printed_and_the_deviation_as_corrected(epsilon, delta):
    bounds = np.array([release.bound for release in HIGHWAY.releases])
    kappa = le_ny_kappa(epsilon, delta)
    printed = np.array(printed_noise_std(HIGHWAY, epsilon, delta))
    np.testing.assert_allclose(printed**2, kappa**2 * bounds, rtol=1e-14)
    corrected = single_noise_std(HIGHWAY, epsilon, delta)
    np.testing.assert_allclose(corrected, kappa * bounds, rtol=1e-14)


def test_the_printed_noise_depends_on_the_units_and_the_corrected_one_does_not():
    """In metres, a density, its bound and its noise should all be a thousand times smaller."""
    density = HIGHWAY.releases[0]
    in_metres = dataclasses.replace(density, unit="veh/m", bound=density.bound / 1000.0)
    other = dataclasses.replace(HIGHWAY, releases=(in_metres,))
    for noise_std, factor in ((single_noise_std, 1000.0), (printed_noise_std, math.sqrt(1000.0))):
        ratio = noise_std(HIGHWAY, 1.0, 0.05)[0] / noise_std(other, 1.0, 0.05)[0]
        assert ratio == pytest.approx(factor, rel=1e-12)


@pytest.mark.parametrize(
    ("epsilon", "stds"), [(1.0, (53, 107, 213)), (5.0, (19, 38, 76)), (10.0, (12, 24, 49))]
)
def test_golden_noise_of_capped_contributions(epsilon, stds):
    for cap, std in zip((4, 16, 64), stds, strict=True):
        density, flow = joint_noise_std(bounded(cap), epsilon, 0.05, 0.5)
        assert round(density) == std  # veh/km
        assert flow == pytest.approx(51.0 * density, rel=1e-12)  # veh/h: v_0 times as much


@settings(max_examples=40)
@given(
    epsilon=st.floats(0.01, 50.0),
    delta=st.floats(-12.0, -0.4).map(lambda power: 10.0**power),
    share=st.floats(0.1, 0.9),
    adjacency=st.sampled_from(["replace", "add_remove"]),
)
def test_the_releases_together_cost_the_requested_epsilon(epsilon, delta, share, adjacency):
    """Against dp-accounting: the sensitivity of the whole transcript in units of the noise."""
    sensitivity = bounded(adjacency=adjacency)
    mu = sensitivity.joint_mu(joint_noise_std(sensitivity, epsilon, delta, share))
    assert 1.0 / mu == pytest.approx(get_sigma_gaussian(epsilon, delta, tol=1e-15), rel=1e-9)


@pytest.mark.parametrize("adjacency", ["replace", "add_remove"])
def test_step_by_step_the_releases_compose_to_the_requested_epsilon(adjacency):
    """A vehicle that moves both releases in each of its steps, composed by dp-accounting."""
    cap = 16
    density, flow = joint_noise_std(bounded(cap, adjacency), 2.0, 0.01, 0.5)
    times = 2 if adjacency == "replace" else 1
    each = (
        dp_event.GaussianDpEvent(density / 10.0),
        dp_event.GaussianDpEvent(flow / 510.0),
    )
    accountant = pld.PLDAccountant()
    for event in each:
        accountant.compose(event, times * cap)
    # It rounds privacy losses up to a grid; the closed form above has no grid.
    assert accountant.get_epsilon(0.01) == pytest.approx(2.0, rel=1e-3)
    inverse = sum(times * cap / event.noise_multiplier**2 for event in each)
    found = get_epsilon_gaussian(1.0 / math.sqrt(inverse), 0.01, tol=1e-15)
    assert found == pytest.approx(2.0, rel=1e-9)


def test_flow_noise_covers_two_speeds_on_one_segment_whatever_the_share():
    mu = mu_of(1.0, 0.05)
    for share in (0.01, 0.3, 0.5, 0.7):
        _, flow = joint_noise_std(bounded(16), 1.0, 0.05, share)
        assert flow >= 2.0 * 4.0 * 510.0 / mu * (1.0 - 1e-12)
        assert (share <= 0.5) == (flow <= 2.0 * 4.0 * 510.0 / mu * (1.0 + 1e-12))
