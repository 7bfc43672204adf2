import dataclasses
import math
from statistics import NormalDist

import mpmath
import numpy as np
import pytest
from dp_accounting import dp_event, get_epsilon_gaussian, get_sigma_gaussian, pld
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from dptse_env.privacy import (
    EpsilonTable,
    ReleaseAccount,
    contribution_sensitivity,
    delta_of,
    epsilon_of,
    joint_noise_std,
    le_ny_kappa,
    mu_of,
    paper_sensitivity,
    printed_noise_std,
    single_noise_std,
)

relaxed = settings(deadline=None)


def close(expected: float, rel: float):
    """Equal to a relative tolerance only: pytest's own absolute one hides any small delta."""
    return pytest.approx(expected, rel=rel, abs=0.0)


def logarithmic(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(math.log(low), math.log(high)).map(math.exp)


mus = logarithmic(1e-4, 1e3)
epsilons = logarithmic(1e-3, 1e3)
deltas = logarithmic(1e-30, 0.499)


def exact_delta(mu: float, epsilon: float) -> mpmath.mpf:
    """The definition as it stands, in 60 digits."""
    with mpmath.workdps(60):
        mu, epsilon = mpmath.mpf(mu), mpmath.mpf(epsilon)
        first = mpmath.ncdf(mu / 2 - epsilon / mu)
        return first - mpmath.exp(epsilon) * mpmath.ncdf(-mu / 2 - epsilon / mu)


# --- known numbers ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("epsilon", "delta", "kappa", "analytic", "rounding"),
    [
        (0.1, 0.05, 16.75, 4.487, 5e-3),
        (0.5, 0.05, 3.570, 2.033, 5e-4),
        (1.0, 0.05, 1.907, 1.333, 5e-4),
        (1.0, 0.001, 3.244, 2.575, 5e-4),
        (2.0, 0.05, 1.059, 0.855, 5e-4),
        (5.0, 0.05, 0.521, 0.472, 5e-4),
    ],
)
def test_golden_multipliers(epsilon, delta, kappa, analytic, rounding):
    assert le_ny_kappa(epsilon, delta) == pytest.approx(kappa, abs=rounding)
    assert 1.0 / mu_of(epsilon, delta) == pytest.approx(analytic, abs=5e-4)


def test_golden_multiplier_in_nine_digits():
    assert 1.0 / mu_of(1.0, 0.05) == pytest.approx(1.33277831, abs=5e-9)


def test_golden_composition_of_two_releases():
    le_ny = 1.0 / le_ny_kappa(1.0, 0.05)
    assert epsilon_of(math.sqrt(2.0) * le_ny, 0.05) == pytest.approx(0.982, abs=5e-4)
    analytic = mu_of(1.0, 0.05)
    assert epsilon_of(math.sqrt(2.0) * analytic, 0.05) == pytest.approx(1.720, abs=5e-4)


@pytest.mark.parametrize(
    ("epsilon", "stds"), [(1.0, (53, 107, 213)), (5.0, (19, 38, 76)), (10.0, (12, 24, 49))]
)
def test_golden_joint_calibration_at_equal_shares(epsilon, stds):
    """Density noise [veh/km] of two releases that share mu, a vehicle in 4, 16 or 64 steps."""
    for exposures, std in zip((4, 16, 64), stds, strict=True):
        sensitivity = math.sqrt(2.0 * exposures) / 0.1
        found = sensitivity / mu_of(epsilon, 0.05) / math.sqrt(0.5)
        assert found == pytest.approx(std, abs=0.5)


# --- against independent computations --------------------------------------------------------


@relaxed
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


@settings(deadline=None, max_examples=30)
@given(epsilon=logarithmic(0.01, 50.0), delta=logarithmic(1e-12, 0.4))
def test_multiplier_matches_dp_accounting(epsilon, delta):
    oracle = get_sigma_gaussian(epsilon, delta, tol=1e-15)
    assert 1.0 / mu_of(epsilon, delta) == close(oracle, 1e-11)


@settings(deadline=None, max_examples=30)
@given(mu=logarithmic(0.01, 20.0), delta=logarithmic(1e-12, 0.4))
def test_epsilon_matches_dp_accounting(mu, delta):
    oracle = get_epsilon_gaussian(1.0 / mu, delta, tol=1e-15)
    assert epsilon_of(mu, delta) == pytest.approx(oracle, rel=1e-11, abs=1e-13)


# --- properties ------------------------------------------------------------------------------


@relaxed
@given(epsilon=epsilons, delta=deltas)
def test_delta_of_inverts_mu_of(epsilon, delta):
    assert delta_of(mu_of(epsilon, delta), epsilon) == close(delta, 1e-9)


@relaxed
@given(epsilon=epsilons, delta=deltas)
def test_epsilon_of_inverts_mu_of(epsilon, delta):
    # Near the total variation distance delta hardly depends on epsilon: nothing to invert there.
    mu = mu_of(epsilon, delta)
    assume(delta < 0.99 * delta_of(mu, 0.0))
    assert epsilon_of(mu, delta) == close(epsilon, 1e-8)


@relaxed
@given(mu=mus, delta=deltas)
def test_epsilon_is_the_smallest_that_keeps_delta(mu, delta):
    epsilon = epsilon_of(mu, delta)
    if epsilon == 0.0:
        assert delta_of(mu, 0.0) <= delta
    else:
        assert delta_of(mu, epsilon) == close(delta, 1e-8)


@relaxed
@given(mu=mus, epsilon=epsilons, factor=st.floats(1.001, 10.0))
def test_delta_rises_with_mu_and_falls_with_epsilon(mu, epsilon, factor):
    delta = delta_of(mu, epsilon)
    assert 0.0 <= delta <= 1.0
    assert delta_of(mu * factor, epsilon) >= delta
    assert delta_of(mu, epsilon * factor) <= delta
    if 1e-300 < delta < 0.999:
        assert delta_of(mu * factor, epsilon) > delta


@relaxed
@given(mu=mus, delta=deltas, factor=st.floats(1.001, 10.0))
def test_epsilon_rises_with_mu_and_falls_with_delta(mu, delta, factor):
    epsilon = epsilon_of(mu, delta)
    assert 0.0 <= epsilon < math.inf
    assert epsilon_of(mu / factor, delta) <= epsilon
    assert epsilon_of(mu, delta / factor) >= epsilon
    if epsilon > 0.0:
        assert epsilon_of(mu * factor, delta) > epsilon


@relaxed
@given(epsilon=epsilons, delta=deltas)
def test_le_ny_is_enough_and_more_than_the_analytic_noise(epsilon, delta):
    kappa = le_ny_kappa(epsilon, delta)
    assert kappa * mu_of(epsilon, delta) >= 1.0 - 1e-12
    assert delta_of(1.0 / kappa, epsilon) <= delta * (1.0 + 1e-9)


# --- the far ends ----------------------------------------------------------------------------


def test_no_overflow_where_the_exponential_of_epsilon_would():
    assert delta_of(1e3, 4e5) == pytest.approx(1.0, abs=1e-12)
    assert delta_of(1.0, 1e6) == 0.0
    assert delta_of(1e-4, 1e300) == 0.0
    # Large mu: epsilon = mu^2 / 2 + O(mu).
    assert epsilon_of(1e3, 1e-300) == pytest.approx(5e5, rel=0.08)
    assert epsilon_of(1e6, 0.05) == close(5e11, 1e-5)


def test_an_epsilon_beyond_the_floats_is_an_error():
    with pytest.raises(OverflowError, match=r"^epsilon is beyond the largest float at mu 1e\+160$"):
        epsilon_of(1e160, 0.05)


def test_epsilon_zero_from_where_the_total_variation_allows_it():
    edge = 2.0 * NormalDist().inv_cdf(0.525)
    assert delta_of(edge, 0.0) == close(0.05, 1e-12)
    assert epsilon_of(0.99 * edge, 0.05) == 0.0
    assert epsilon_of(1.01 * edge, 0.05) > 0.0


@pytest.mark.parametrize(("epsilon", "delta"), [(1e-12, 0.49), (1e-12, 1e-12), (1e6, 1e-300)])
def test_calibration_at_extreme_settings(epsilon, delta):
    assert delta_of(mu_of(epsilon, delta), epsilon) == close(delta, 1e-9)


# --- bad input -------------------------------------------------------------------------------


@pytest.mark.parametrize("relation", [mu_of, le_ny_kappa])
def test_settings_out_of_range_are_named(relation):
    with pytest.raises(ValueError, match=r"^epsilon must be a finite number > 0, got -1$"):
        relation(-1, 0.05)
    with pytest.raises(ValueError, match=r"^epsilon must be a finite number > 0, got 0$"):
        relation(0, 0.05)
    for delta in (0.0, 0.5, 1.0, math.nan):
        with pytest.raises(ValueError, match=r"^delta must be a number in \(0, 0\.5\), got "):
            relation(1.0, delta)


def test_arguments_out_of_range_are_named():
    for relation in (lambda mu: delta_of(mu, 1.0), lambda mu: epsilon_of(mu, 0.05)):
        with pytest.raises(ValueError, match=r"^mu must be a finite number > 0, got 0\.0$"):
            relation(0.0)
        with pytest.raises(ValueError, match=r"^mu must be a finite number > 0, got inf$"):
            relation(math.inf)
    with pytest.raises(ValueError, match=r"^epsilon must be a finite number > 0, got -0\.1$"):
        delta_of(1.0, -0.1)
    with pytest.raises(ValueError, match=r"^delta must be a number in \(0, 0\.5\), got 0\.5$"):
        epsilon_of(1.0, 0.5)


# --- calibrations of noise -------------------------------------------------------------------

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
    delta=logarithmic(1e-12, 0.4),
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
