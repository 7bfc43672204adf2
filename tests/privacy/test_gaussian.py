"""Gaussian relations in many digits and beside dp-accounting; noise, and accounts of its use."""

import math
from statistics import NormalDist

import mpmath
import numpy as np
import pytest
from dp_accounting import get_epsilon_gaussian, get_sigma_gaussian
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dptse_env.privacy import (
    DELTAS,
    ROUNDING,
    EpsilonTable,
    ReleaseAccount,
    contribution_sensitivity,
    delta_of,
    epsilon_of,
    joint_noise_std,
    le_ny_kappa,
    mu_of,
    over_trips,
    paper_sensitivity,
    printed_noise_std,
    require_covered,
    rounded_up,
    single_noise_std,
)

few = settings(max_examples=30)


def close(expected, rel):
    """Equal to a relative tolerance only: pytest's own absolute one hides any small delta."""
    return pytest.approx(expected, rel=rel, abs=0.0)


def logarithmic(low, high):
    return st.floats(math.log(low), math.log(high)).map(math.exp)


mus = logarithmic(1e-4, 1e3)
epsilons = logarithmic(1e-3, 1e3)
deltas = logarithmic(1e-30, 0.499)


def exact_delta(mu, epsilon):
    """The definition as it stands, in 60 digits."""
    with mpmath.workdps(60):
        mu, epsilon = mpmath.mpf(mu), mpmath.mpf(epsilon)
        first = mpmath.ncdf(mu / 2 - epsilon / mu)
        return first - mpmath.exp(epsilon) * mpmath.ncdf(-mu / 2 - epsilon / mu)


# --- relations -------------------------------------------------------------------------------


@given(mu=logarithmic(1e-9, 1e3), deviations=st.floats(-20.0, 37.0))
@example(mu=1e-9, deviations=0.0)
@example(mu=9.9e-4, deviations=1e-3)  # on either side of where the formula changes
@example(mu=1.01e-3, deviations=37.0)
@example(mu=1e3, deviations=37.0)
@example(mu=1e3, deviations=-20.0)
def test_delta_matches_the_definition_in_many_digits(mu, deviations):
    """Over the whole of its range: `deviations` is minus the argument of the leading term."""
    epsilon = max(mu * (deviations + mu / 2.0), 0.0)
    assert delta_of(mu, epsilon) == close(float(exact_delta(mu, epsilon)), 2e-11)


@given(epsilon=logarithmic(1e-4, 1e4), delta=logarithmic(1e-12, 0.4999))
@example(epsilon=5.0, delta=1e-12)
@example(epsilon=20.0, delta=0.05)
@example(epsilon=1e-4, delta=0.05)
@example(epsilon=1e4, delta=1e-12)
@example(epsilon=1.759694e-4, delta=3.201763e-4)  # a mu just above where the formula changes
@example(epsilon=3.147896e-4, delta=3.339089e-4)
def test_mu_is_exact_to_twice_ten_to_the_minus_twelve_wherever_a_guarantee_may_be(epsilon, delta):
    """By Newton's step from it, whose slope is the density of the leading term, in 60 digits."""
    mu = mu_of(epsilon, delta)
    with mpmath.workdps(60):
        excess = exact_delta(mu, epsilon) - mpmath.mpf(delta)
        slope = mpmath.npdf(mpmath.mpf(mu) / 2 - mpmath.mpf(epsilon) / mu)
        assert abs(excess / slope / mu) < 2e-12
    # That of dp-accounting has an error of its own, where epsilon is small.
    assert 1.0 / mu == close(get_sigma_gaussian(epsilon, delta, 1e-15), 1e-10)


def test_no_more_payments_are_allowed_than_the_reserve_covers():
    """Each is off by 2^-53 of the budget, deviations of the noise by 2^-49, mu by 2e-12."""
    too_many = (ROUNDING - 2.0**-49 - 2.0 * 2e-12) * 2.0**53
    require_covered(2**22)
    with pytest.raises(ValueError, match=r"^horizon must be shorter: .* 4194304 times"):
        require_covered(int(too_many))


@given(epsilon=epsilons, delta=deltas)
@example(epsilon=1e-12, delta=0.49)
@example(epsilon=1e-12, delta=1e-12)
@example(epsilon=1e6, delta=1e-300)
def test_mu_is_the_largest_that_keeps_delta_and_le_ny_s_noise_is_more(epsilon, delta):
    mu, kappa = mu_of(epsilon, delta), le_ny_kappa(epsilon, delta)
    assert delta_of(mu, epsilon) == close(delta, 1e-9)
    assert kappa * mu >= 1.0 - 1e-12
    assert delta_of(1.0 / kappa, epsilon) <= delta * (1.0 + 1e-9)


@given(mu=mus, delta=deltas)
def test_epsilon_is_the_smallest_that_keeps_delta(mu, delta):
    epsilon = epsilon_of(mu, delta)
    if epsilon == 0.0:
        assert delta_of(mu, 0.0) <= delta
    else:
        assert delta_of(mu, epsilon) == close(delta, 1e-8)


def test_no_overflow_where_the_exponential_of_epsilon_would():
    assert delta_of(1e3, 4e5) == pytest.approx(1.0, abs=1e-12)
    assert delta_of(1.0, 1e6) == delta_of(1e-4, 1e300) == 0.0
    # Large mu: epsilon = mu^2 / 2 + O(mu).
    assert epsilon_of(1e3, 1e-300) == pytest.approx(5e5, rel=0.08)
    assert epsilon_of(1e6, 0.05) == close(5e11, 1e-5)
    with pytest.raises(OverflowError, match=r"^epsilon .* at mu 1e\+160$"):
        epsilon_of(1e160, 0.05)


def test_epsilon_is_zero_from_where_the_total_variation_allows_it():
    edge = 2.0 * NormalDist().inv_cdf(0.525)
    assert delta_of(edge, 0.0) == close(0.05, 1e-12)
    assert epsilon_of(0.99 * edge, 0.05) == 0.0 < epsilon_of(1.01 * edge, 0.05)


def test_arguments_out_of_range_are_named():
    for relation in (mu_of, le_ny_kappa):
        for epsilon in (0, -1, math.inf):
            with pytest.raises(ValueError, match=rf"^epsilon must be .*, got {epsilon}$"):
                relation(epsilon, 0.05)
    for relation in (mu_of, le_ny_kappa, epsilon_of):
        for delta in (0.0, 0.5, math.nan):
            with pytest.raises(ValueError, match=rf"^delta must be .* in \(0, 0\.5\), got {delta}"):
                relation(1.0, delta)
    for relation in (delta_of, epsilon_of):
        for mu in (0.0, math.inf):
            with pytest.raises(ValueError, match=rf"^mu must be .* > 0, got {mu}$"):
                relation(mu, 0.05)
    with pytest.raises(ValueError, match=r"^epsilon must be .*, got -0\.1$"):
        delta_of(1.0, -0.1)


# --- noise -----------------------------------------------------------------------------------

HIGHWAY = paper_sensitivity(
    n_sensors=8, average_dwell=8.0, segment_length=0.1, free_flow_speed=102.0, jam_density=333.0
)


def bounded(cap=16, adjacency="replace"):
    return contribution_sensitivity(
        contributions=cap, adjacency=adjacency, segment_length=0.1, largest_speed=102.0
    )


def test_golden_noise_as_printed_and_corrected():
    """In [veh/km] and [km/h]; kappa scales the variance in the first, the deviation after that."""
    printed = printed_noise_std(HIGHWAY, 1.0, 0.05)
    corrected = single_noise_std(HIGHWAY, 1.0, 0.05)
    assert printed == pytest.approx((20.3, 11.2), abs=0.05)
    assert corrected == pytest.approx((215.8, 66.1), abs=0.1)
    for epsilon, delta in ((0.1, 0.05), (1.0, 0.001), (5, 0.05)):
        bounds = np.array([release.bound for release in HIGHWAY.releases])
        kappa = le_ny_kappa(epsilon, delta)
        printed = np.array(printed_noise_std(HIGHWAY, epsilon, delta))
        np.testing.assert_allclose(printed**2, kappa**2 * bounds, rtol=1e-14)
        corrected = single_noise_std(HIGHWAY, epsilon, delta)
        np.testing.assert_allclose(corrected, kappa * bounds, rtol=1e-14)


@pytest.mark.parametrize(("epsilon", "stds"), [(1.0, (53, 107, 213)), (10.0, (12, 24, 49))])
def test_golden_noise_of_capped_contributions(epsilon, stds):
    for cap, std in zip((4, 16, 64), stds, strict=True):
        density, flow = joint_noise_std(bounded(cap), epsilon, 0.05, 0.5)
        assert round(density) == std  # veh/km
        assert flow == pytest.approx(51.0 * density, rel=1e-12)  # veh/h: v_0 times as much


@few
@given(
    epsilon=st.floats(0.01, 50.0),
    delta=logarithmic(1e-12, 0.4),
    share=st.floats(0.1, 0.9),
    adjacency=st.sampled_from(["replace", "add_remove"]),
)
def test_the_releases_together_cost_the_requested_epsilon(epsilon, delta, share, adjacency):
    sensitivity = bounded(adjacency=adjacency)
    density, flow = joint_noise_std(sensitivity, epsilon, delta, share)
    mu = sensitivity.joint_mu((density, flow))
    assert 1.0 / mu == pytest.approx(get_sigma_gaussian(epsilon, delta, tol=1e-15), rel=1e-9)
    # Step by step: a vehicle of 1 / 0.1 km and 51 / 0.1 km/h on two segments, or on one.
    squares = (10.0 / density) ** 2 + (510.0 / flow) ** 2
    assert (2 if adjacency == "replace" else 1) * 16 * squares <= mu**2 * (1.0 + 1e-12)


def test_flow_noise_covers_two_speeds_on_one_segment_whatever_the_share():
    needed = 2.0 * 4.0 * 510.0 / mu_of(1.0, 0.05)
    for share in (0.01, 0.3, 0.5, 0.7):
        _, flow = joint_noise_std(bounded(16), 1.0, 0.05, share)
        assert flow >= needed * (1.0 - 1e-12)
        assert (share <= 0.5) == (flow <= needed * (1.0 + 1e-12))


# --- accounts --------------------------------------------------------------------------------


def test_a_table_rounds_epsilon_up_to_a_level_of_mu_and_holds_mu_to_the_largest():
    table, mus = EpsilonTable(2.0, 0.05), np.array([0.0, 1e-9, 0.3, 1.0, 2.0, 5.0])
    mu, epsilon = table.bounds(mus)
    np.testing.assert_array_equal(mu, np.minimum(mus, 2.0))
    exact = np.array([0.0, *(epsilon_of(value, 0.05) for value in mu[1:].tolist())])
    assert (epsilon >= exact).all()
    np.testing.assert_allclose(epsilon, exact, atol=0.04)
    assert epsilon[3:].tolist() == exact[3:].tolist()  # levels themselves


def test_an_account_charges_a_step_for_each_contribution_and_the_paper_s_all_at_once():
    account, whole = ReleaseAccount(2.0, 0.05, 4), ReleaseAccount(2.0, 0.05, None)
    mu, epsilon = account.spent(np.array([0, 1, 4, 9]))
    np.testing.assert_allclose(mu, [0.0, 1.0, 2.0, 2.0])
    assert epsilon.tolist() == [0.0, *(epsilon_of(value, 0.05) for value in (1.0, 2.0, 2.0))]
    assert whole.spent(np.array([0, 7]))[0].tolist() == [2.0, 2.0]
    found = account.epsilons(np.array([0.0, 1.0, 4.0, 9.0]))
    assert found == pytest.approx(epsilon.tolist())


@few
@given(loss=logarithmic(1e-6, 1e6), form=st.sampled_from([".5g", ".2f"]))
@example(loss=139.793097, form=".5g")
def test_a_loss_as_text_states_no_less_than_there_is_and_little_more(loss, form):
    text = rounded_up(loss, form)
    assert text == format(float(text), form)
    assert loss <= float(text) < loss + max(1e-4 * loss, 0.01 * (form == ".2f"))
    assert rounded_up(float(text), form) == text


def test_trips_of_one_vehicle_compose():
    for n, row in over_trips(1.02, (1, 4, 250)).items():
        mu = row.pop("mu")
        assert mu == pytest.approx(math.hypot(*[1.02] * n), rel=1e-14)
        assert list(row) == list(DELTAS)
        for delta, epsilon in row.items():
            assert epsilon == close(get_epsilon_gaussian(1.0 / mu, float(delta)), 1e-9)
    for mu, trips in ((0.0, 1), (1.0, 0), (1.0, 1.5)):
        with pytest.raises(ValueError, match=r"^(mu|trips) must be"):
            over_trips(mu, (trips,))
