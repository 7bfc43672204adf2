import dataclasses
import json
import math

import numpy as np
import pytest
from dp_accounting import get_epsilon_gaussian

from dptse_env.privacy.accountant import STRICT_DELTA, Accountant
from dptse_env.privacy.calibration import PrivacySettings
from dptse_env.privacy.gaussian import epsilon_of, mu_of
from dptse_env.privacy.sensitivity import contribution_sensitivity, paper_sensitivity

SENSITIVITY_REASONS = ("average_dwell", "adaptive_queries", "speed_sensitivity")


def highway(n_sensors=8, average_dwell=8.0):
    return paper_sensitivity(
        n_sensors=n_sensors,
        average_dwell=average_dwell,
        segment_length=0.1,
        free_flow_speed=102.0,
        jam_density=333.0,
    )


def report(preset="paper", epsilon=1.0, delta=0.05, sensitivity=None, boundary_inputs="true"):
    settings = PrivacySettings(preset, epsilon, delta, boundary_inputs=boundary_inputs)
    return Accountant(settings, sensitivity or highway()).report


# --- what the releases cost ------------------------------------------------------------------


def test_the_printed_noise_gives_thirty_where_one_is_claimed():
    found = report("paper")
    assert found.claimed_epsilon == 1.0
    assert found.epsilon == pytest.approx(29.9, abs=0.05)


@pytest.mark.parametrize(
    ("n_sensors", "average_dwell", "epsilon"), [(8, 4.0, 22), (8, 8.0, 30), (14, 8.0, 38)]
)
def test_golden_range_of_the_printed_noise(n_sensors, average_dwell, epsilon):
    """From few sensors and brisk traffic to the most sensors of the paper's figures."""
    found = report("paper", sensitivity=highway(n_sensors, average_dwell))
    assert round(found.epsilon) == epsilon
    assert found.epsilon == pytest.approx(get_epsilon_gaussian(1.0 / found.mu, 0.05), rel=1e-10)


def test_the_corrected_noise_stays_below_its_claim_at_one():
    assert report("corrected").epsilon == pytest.approx(0.982, abs=5e-4)


def test_the_corrected_cost_does_not_depend_on_the_sensitivities():
    assert report("corrected", sensitivity=highway(14, 12.0)).mu == pytest.approx(
        report("corrected").mu, rel=1e-14
    )


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_the_numbers_of_a_report_follow_from_one_another(preset):
    found = report(preset)
    for release, bound in zip(found.releases, highway().releases, strict=True):
        assert (release.quantity, release.unit) == (bound.quantity, bound.unit)
        assert release.sensitivity == bound.bound
        assert release.mu == pytest.approx(release.sensitivity / release.noise_std, rel=1e-15)
    assert found.mu == pytest.approx(math.hypot(*(r.mu for r in found.releases)), rel=1e-14)
    assert found.epsilon == epsilon_of(found.mu, 0.05)
    assert found.epsilon_strict == epsilon_of(found.mu, STRICT_DELTA)
    assert found.epsilon_strict > found.epsilon
    assert found.strict_delta == 1e-4
    assert ("average_dwell_steps", 8.0) in found.assumptions


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_the_whole_episode_is_charged_from_the_first_step(preset):
    accountant = Accountant(PrivacySettings(preset), highway())
    mu, epsilon = accountant.spent(np.array([0, 1, 350, 700]))
    assert mu.shape == epsilon.shape == (4,)
    assert mu.tolist() == [accountant.report.mu] * 4
    assert epsilon.tolist() == [accountant.report.epsilon] * 4


# --- what may be claimed ---------------------------------------------------------------------


def test_the_paper_preset_lists_every_way_in_which_it_fails():
    found = report("paper")
    assert found.guarantee == "none"
    assert found.void_reasons == (
        "literal_variance",
        *SENSITIVITY_REASONS,
        "boundary_inputs",
        "releases_not_composed",
    )


def test_the_corrected_preset_mends_the_variance_only():
    found = report("corrected")
    assert found.guarantee == "none"
    assert found.void_reasons == (*SENSITIVITY_REASONS, "boundary_inputs")


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_nominal_boundary_inputs_lift_one_reason_and_no_other(preset):
    true, nominal = (report(preset, boundary_inputs=where) for where in ("true", "nominal"))
    assert set(true.void_reasons) - set(nominal.void_reasons) == {"boundary_inputs"}
    assert set(nominal.void_reasons) < set(true.void_reasons)
    assert nominal.guarantee == "none"


@pytest.mark.parametrize("epsilon", [0.1, 0.5, 1.0, 2.0, 5.0, 10.0])
@pytest.mark.parametrize("delta", [0.05, 0.001, 1e-6])
def test_composition_is_a_reason_just_where_two_releases_exceed_the_claim(epsilon, delta):
    found = report("corrected", epsilon, delta)
    assert ("releases_not_composed" in found.void_reasons) == (found.epsilon > epsilon)


def test_composition_fails_at_a_large_epsilon():
    assert "releases_not_composed" in report("corrected", epsilon=5.0).void_reasons


def test_a_claim_is_made_only_when_nothing_voids_it():
    sound = dataclasses.replace(highway(), void_reasons=())
    found = report("corrected", sensitivity=sound, boundary_inputs="nominal")
    assert found.void_reasons == ()
    assert found.guarantee == (
        "(1, 0.05)-differential privacy of density and speed together, "
        "for one vehicle's trip, replaced by another"
    )
    assert report("corrected", sensitivity=sound).guarantee == "none"
    assert report("paper", sensitivity=sound, boundary_inputs="nominal").guarantee == "none"


# --- the form it takes in info ---------------------------------------------------------------


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_the_dict_is_its_own_json_and_fresh_each_time(preset):
    found = report(preset, sensitivity=highway(average_dwell=np.float64(8.0)))
    first = found.to_dict()
    assert json.loads(json.dumps(first, allow_nan=False)) == first
    assert set(first) == {field.name for field in dataclasses.fields(found)}
    first["void_reasons"].clear()
    first["releases"][0]["mu"] = 0.0
    first["assumptions"].clear()
    assert found.to_dict() != first
    assert found.to_dict()["assumptions"] == {"n_sensors": 8, "average_dwell_steps": 8.0}


# --- the guaranteed preset ------------------------------------------------------------------------


def guaranteed(cap=16, horizon=100, **wishes):
    settings = PrivacySettings("guaranteed", 5.0, 0.05, cap=cap, **wishes)
    slope = 0.3 if settings.speed == "mean" else None
    sensitivity = contribution_sensitivity(
        contributions=settings.contributions(horizon),
        adjacency=settings.adjacency,
        segment_length=0.1,
        largest_speed=102.0,
        protects=settings.protected(),
        mean_speed_slope=slope,
    )
    return Accountant(settings, sensitivity)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.7])
@pytest.mark.parametrize("adjacency", ["replace", "add_remove"])
@pytest.mark.parametrize("unit", ["trip", "horizon", "event"])
@pytest.mark.parametrize("boundary_inputs", [None, "nominal", "private"])
def test_a_guarantee_is_claimed_for_its_unit(unit, adjacency, share, boundary_inputs):
    found = guaranteed(
        unit=unit, adjacency=adjacency, share=share, boundary_inputs=boundary_inputs
    ).report
    assert found.void_reasons == ()
    assert found.guarantee == (
        f"(5, 0.05)-differential privacy of density and flow together, for {found.protects}"
    )
    assert (found.unit, found.adjacency, found.share) == (unit, adjacency, share)
    assert found.cap == (16 if unit == "trip" else None)
    assert found.speed_release == "flow"
    assert found.boundary_inputs == (boundary_inputs or "nominal")
    assert found.mu == pytest.approx(mu_of(5.0, 0.05), rel=1e-12)
    assert found.epsilon == pytest.approx(5.0, rel=1e-9)
    assert found.epsilon_strict > 9.0


@pytest.mark.parametrize(
    ("wishes", "reasons"),
    [
        ({"boundary_inputs": "true"}, ("boundary_inputs",)),
        ({"speed_release": "mean"}, ("speed_sensitivity",)),
        (
            {"speed_release": "mean", "boundary_inputs": "true"},
            ("speed_sensitivity", "boundary_inputs"),
        ),
    ],
)
def test_what_voids_a_guarantee_is_listed(wishes, reasons):
    found = guaranteed(**wishes).report
    assert found.guarantee == "none"
    assert found.void_reasons == reasons


@pytest.mark.parametrize(("unit", "whole"), [("trip", 16), ("horizon", 100), ("event", 1)])
def test_an_episode_is_charged_step_by_step_until_the_cap(unit, whole):
    accountant = guaranteed(unit=unit)
    mu, epsilon = accountant.spent(np.arange(101))
    counted = np.minimum(np.arange(101), whole)
    np.testing.assert_allclose(mu, accountant.report.mu * np.sqrt(counted / whole), rtol=1e-14)
    assert (mu[0], epsilon[0]) == (0.0, 0.0)
    assert epsilon[-1] == pytest.approx(5.0, rel=1e-9)
    assert (np.diff(epsilon[: whole + 1]) >= 0.0).all()
    expected = [epsilon_of(one, 0.05) for one in mu[1:]]
    np.testing.assert_array_equal(epsilon[1:], expected)


def test_making_an_account_takes_no_root_for_every_step(monkeypatch):
    calls = []
    monkeypatch.setattr(
        "dptse_env.privacy.accountant.epsilon_of", lambda *given: calls.append(given) or 1.0
    )
    accountant = guaranteed(unit="horizon", horizon=700)
    assert len(calls) == 2
    for _ in range(3):
        accountant.spent(np.array([5]))
    assert len(calls) == 702


def test_the_account_of_a_guarantee_is_plain_json():
    for wishes in ({}, {"unit": "event"}, {"speed_release": "mean"}):
        found = guaranteed(**wishes).report.to_dict()
        assert json.loads(json.dumps(found, allow_nan=False)) == found


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_presets_that_bound_nothing_name_no_unit(preset):
    found = report(preset)
    assert (found.unit, found.cap, found.share) == (None, None, None)
    assert (found.adjacency, found.speed_release) == ("replace", "mean")
