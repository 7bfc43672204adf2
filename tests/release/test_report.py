"""Reports of release models: what the releases cost, and what may be claimed."""

import dataclasses
import json
import math

import numpy as np
import pytest
from dp_accounting import get_epsilon_gaussian

from dptse_env.config import resolve
from dptse_env.parts import make_release, privacy_report
from dptse_env.privacy import epsilon_of, mu_of
from dptse_env.release import VOID_REASONS, GaussianMechanism
from dptse_env.release.report import STRICT_DELTA, in_order
from tests.cases import pairwise

SENSITIVITY_REASONS = ("average_dwell", "adaptive_queries", "speed_sensitivity")


def config(preset="paper", epsilon=1.0, delta=0.05, n_sensors=8, dwell=8.0, **keywords):
    """The paper's highway, three of whose sensors are fixed."""
    privacy = {"preset": preset, "epsilon": epsilon, "delta": delta, **keywords}
    corridor = {"average_dwell": dwell}
    values = {"privacy": privacy, "corridor": corridor, "bandwidth": n_sensors - 3}
    return resolve("paper-highway", values)


def report(*args, **keywords):
    return privacy_report(config(*args, **keywords))


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
    found = report("paper", n_sensors=n_sensors, dwell=average_dwell)
    assert round(found.epsilon) == epsilon
    assert found.epsilon == pytest.approx(get_epsilon_gaussian(1.0 / found.mu, 0.05), rel=1e-10)


def test_the_corrected_noise_stays_below_its_claim_at_one():
    assert report("corrected").epsilon == pytest.approx(0.982, abs=5e-4)


def test_the_corrected_cost_does_not_depend_on_the_sensitivities():
    assert report("corrected", n_sensors=14, dwell=12.0).mu == pytest.approx(
        report("corrected").mu, rel=1e-14
    )


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_the_numbers_of_a_report_follow_from_one_another(preset):
    found, release = report(preset), make_release(config(preset))
    for quantity, bound in zip(found.releases, release.sensitivity.releases, strict=True):
        assert (quantity.quantity, quantity.unit) == (bound.quantity, bound.unit)
        assert quantity.sensitivity == bound.bound
        assert quantity.mu == pytest.approx(quantity.sensitivity / quantity.noise_std, rel=1e-15)
    assert [quantity.noise_std for quantity in found.releases] == release.sigma.tolist()
    assert found.mu == pytest.approx(math.hypot(*(q.mu for q in found.releases)), rel=1e-14)
    assert found.epsilon == epsilon_of(found.mu, 0.05)
    assert found.epsilon_strict == epsilon_of(found.mu, STRICT_DELTA)
    assert found.epsilon_strict > found.epsilon
    assert found.strict_delta == 1e-4
    assert found.assumptions == {"n_sensors": 8, "average_dwell_steps": 8.0}


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_the_whole_episode_is_charged_from_the_first_step(preset):
    release = make_release(config(preset))
    mu, epsilon = release.spent(np.arange(4), np.array([0, 1, 350, 700]))
    assert mu.tolist() == [release.report().mu] * 4
    assert epsilon.tolist() == [release.report().epsilon] * 4


# --- what may be claimed ---------------------------------------------------------------------


def test_the_paper_s_model_lists_every_way_in_which_it_fails():
    found = report("paper")
    assert found.guarantee == "none"
    assert found.void_reasons == (
        "literal_variance",
        *SENSITIVITY_REASONS,
        "boundary_inputs",
        "releases_not_composed",
    )


def test_the_corrected_model_mends_the_variance_only():
    found = report("corrected")
    assert found.guarantee == "none"
    assert found.void_reasons == (*SENSITIVITY_REASONS, "boundary_inputs")


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_nominal_boundary_inputs_lift_one_reason_and_no_other(preset):
    true, nominal = (report(preset, boundary_inputs=kind) for kind in ("true", "nominal"))
    assert set(true.void_reasons) - set(nominal.void_reasons) == {"boundary_inputs"}
    assert set(nominal.void_reasons) < set(true.void_reasons)
    assert nominal.guarantee == "none"


@pytest.mark.parametrize("epsilon", [0.1, 0.5, 1.0, 2.0, 5.0, 10.0])
def test_composition_is_a_reason_just_where_two_releases_exceed_the_claim(epsilon):
    for delta in (0.05, 0.001, 1e-6):
        found = report("corrected", epsilon, delta)
        assert ("releases_not_composed" in found.void_reasons) == (found.epsilon > epsilon)


def test_composition_fails_at_a_large_epsilon():
    assert "releases_not_composed" in report("corrected", epsilon=5.0).void_reasons


def test_truth_in_info_voids_a_guarantee():
    values = {"truth_in_info": True}
    found = privacy_report(resolve("private-highway", values))
    assert (found.guarantee, found.void_reasons) == ("none", ("truth_in_info",))
    assert privacy_report(resolve("private-highway", {})).void_reasons == ()


# --- the form it takes in info ---------------------------------------------------------------


@pytest.mark.parametrize("preset", ["paper", "corrected", "capped"])
def test_the_dict_is_its_own_json_and_fresh_each_time(preset):
    found = report(preset)
    first = found.to_dict()
    assert json.loads(json.dumps(first, allow_nan=False)) == first
    fields = {field.name for field in dataclasses.fields(found)} - {"details"}
    own = {"adjacency"} if preset != "capped" else {"unit", "cap", "adjacency", "share"}
    assert set(first) == fields | own
    # Gymnasium's vector form would be a column of None, which libraries stumble over.
    assert None not in first.values()
    again = found.to_dict()
    first["void_reasons"].append("more")
    first["releases"][0]["mu"] = 0.0
    first["assumptions"].clear()
    assert found.to_dict() == again


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_models_that_bound_no_contributions_name_no_unit(preset):
    found = report(preset).to_dict()
    assert not {"unit", "cap", "share"} & set(found)
    assert (found["adjacency"], found["speed_release"]) == ("replace", "mean")


# --- capped contributions ---------------------------------------------------------------------


def capped(cap=16, horizon=100, **settings):
    privacy = {"preset": "capped", "epsilon": 5.0, "cap": cap, **settings}
    return resolve("paper-highway", {"privacy": privacy, "horizon": horizon})


@pytest.mark.parametrize(
    ("unit", "adjacency", "share", "boundary_inputs"),
    pairwise(
        ["trip", "horizon", "event"],
        ["replace", "add_remove"],
        [0.2, 0.5, 0.7],
        [None, "nominal", "private"],
    ),
)
def test_a_guarantee_is_claimed_for_its_unit(unit, adjacency, share, boundary_inputs):
    found = privacy_report(
        capped(unit=unit, adjacency=adjacency, share=share, boundary_inputs=boundary_inputs)
    )
    assert found.void_reasons == ()
    assert found.guarantee == (
        f"(5, 0.05)-differential privacy of density and flow together, for {found.protects}"
    )
    cap = {"cap": 16} if unit == "trip" else {}
    assert found.details == {"unit": unit, "adjacency": adjacency, "share": share, **cap}
    assert found.speed_release == "flow"
    assert found.boundary_inputs == (boundary_inputs or "nominal")
    assert found.mu == pytest.approx(mu_of(5.0, 0.05), rel=1e-12)
    assert found.epsilon == pytest.approx(5.0, rel=1e-9)
    assert found.epsilon_strict > 9.0


@pytest.mark.parametrize(
    ("settings", "reasons"),
    [
        ({"boundary_inputs": "true"}, ("boundary_inputs",)),
        ({"speed_release": "mean"}, ("speed_sensitivity",)),
        (
            {"speed_release": "mean", "boundary_inputs": "true"},
            ("speed_sensitivity", "boundary_inputs"),
        ),
    ],
)
def test_reasons_that_void_a_guarantee_are_listed(settings, reasons):
    found = privacy_report(capped(**settings))
    assert found.guarantee == "none"
    assert found.void_reasons == reasons


@pytest.mark.parametrize(("unit", "whole"), [("trip", 16), ("horizon", 100), ("event", 1)])
def test_an_episode_is_charged_step_by_step_until_the_cap(unit, whole):
    release = make_release(capped(unit=unit))
    mu, epsilon = release.spent(np.arange(101), np.arange(101))
    counted = np.minimum(np.arange(101), whole)
    np.testing.assert_allclose(mu, release.report().mu * np.sqrt(counted / whole), rtol=1e-14)
    assert (mu[0], epsilon[0]) == (0.0, 0.0)
    assert epsilon[-1] == pytest.approx(5.0, rel=1e-9)
    assert (np.diff(epsilon[: whole + 1]) >= 0.0).all()
    expected = [epsilon_of(value, 0.05) for value in mu[1:]]
    np.testing.assert_array_equal(epsilon[1:], expected)


def test_the_report_describes_the_mechanism_in_force():
    """Noise that is smaller than declared voids the guarantee instead of hiding behind it."""
    release = make_release(capped())
    assert release.report().guarantee != "none"
    weaker = release.sigma / 1.41
    release.mechanism = GaussianMechanism(weaker, n_episodes=1, n_segments=release.setup.n_columns)
    found = release.report()
    assert (found.guarantee, found.void_reasons) == ("none", ("releases_not_composed",))
    assert [quantity.noise_std for quantity in found.releases] == weaker.tolist()
    assert found.epsilon > 5.0
    assert release.spent(np.array([0]), np.array([100]))[0][0] == pytest.approx(found.mu)


def test_reasons_come_in_the_order_of_the_table_and_unknown_ones_last():
    names = list(VOID_REASONS)
    assert in_order(["z", names[3], "a", names[0]]) == (names[0], names[3], "a", "z")
