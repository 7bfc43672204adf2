import dataclasses
import json
import math

import numpy as np
import pytest
from dp_accounting import dp_event, get_epsilon_gaussian, get_sigma_gaussian, pld

from dptse_env.privacy.calibration import PRESETS, PrivacySettings, noise_std
from dptse_env.privacy.gaussian import le_ny_kappa, mu_of
from dptse_env.privacy.sensitivity import contribution_sensitivity, paper_sensitivity

HIGHWAY = paper_sensitivity(
    n_sensors=8,
    average_dwell=8.0,
    segment_length=0.1,
    free_flow_speed=102.0,
    jam_density=333.0,
)


def test_golden_noise_as_printed():
    density, speed = noise_std(PrivacySettings("paper", 1.0, 0.05), HIGHWAY)
    assert density == pytest.approx(20.3, abs=0.05)  # veh/km
    assert speed == pytest.approx(11.2, abs=0.05)  # km/h


def test_golden_noise_corrected():
    density, speed = noise_std(PrivacySettings("corrected", 1.0, 0.05), HIGHWAY)
    assert density == pytest.approx(215.8, abs=0.1)  # veh/km
    assert speed == pytest.approx(66.1, abs=0.1)  # km/h


@pytest.mark.parametrize(("epsilon", "delta"), [(0.1, 0.05), (1.0, 0.05), (1.0, 0.001), (5, 0.05)])
def test_one_preset_scales_the_variance_and_the_other_the_deviation(epsilon, delta):
    bounds = np.array([release.bound for release in HIGHWAY.releases])
    kappa = le_ny_kappa(epsilon, delta)
    printed = noise_std(PrivacySettings("paper", epsilon, delta), HIGHWAY)
    np.testing.assert_allclose(printed**2, kappa**2 * bounds, rtol=1e-14)
    corrected = noise_std(PrivacySettings("corrected", epsilon, delta), HIGHWAY)
    np.testing.assert_allclose(corrected, kappa * bounds, rtol=1e-14)


def test_the_printed_noise_depends_on_the_units_and_the_corrected_one_does_not():
    """In metres, a density, its bound and its noise should all be a thousand times smaller."""
    density = HIGHWAY.releases[0]
    in_metres = dataclasses.replace(density, unit="veh/m", bound=density.bound / 1000.0)
    other = dataclasses.replace(HIGHWAY, releases=(in_metres,))
    for preset, factor in (("corrected", 1000.0), ("paper", math.sqrt(1000.0))):
        settings = PrivacySettings(preset)
        ratio = noise_std(settings, HIGHWAY)[0] / noise_std(settings, other)[0]
        assert ratio == pytest.approx(factor, rel=1e-12)


def test_settings_default_to_the_paper_and_survive_json():
    settings = PrivacySettings()
    assert settings == PrivacySettings("paper", 1, 0.05)
    assert PrivacySettings(**json.loads(json.dumps(dataclasses.asdict(settings)))) == settings
    assert hash(settings) == hash(PrivacySettings())
    assert type(PrivacySettings(epsilon=np.float64(2.0)).epsilon) is float
    assert type(PrivacySettings(epsilon=2).epsilon) is float


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        (
            "preset",
            "Paper",
            "privacy.preset must be one of ['paper', 'corrected', 'guaranteed'], got 'Paper'",
        ),
        (
            "preset",
            None,
            "privacy.preset must be one of ['paper', 'corrected', 'guaranteed'], got None",
        ),
        (
            "preset",
            [],
            "privacy.preset must be one of ['paper', 'corrected', 'guaranteed'], got []",
        ),
        ("epsilon", -1, "privacy.epsilon must be > 0, got -1"),
        ("epsilon", 0.0, "privacy.epsilon must be > 0, got 0.0"),
        ("epsilon", math.nan, "privacy.epsilon must be finite, got nan"),
        ("epsilon", math.inf, "privacy.epsilon must be finite, got inf"),
        ("epsilon", "1", "privacy.epsilon must be a number, got '1'"),
        ("delta", 0.5, "privacy.delta must be in (0, 0.5), got 0.5"),
        ("delta", 0, "privacy.delta must be in (0, 0.5), got 0"),
        ("delta", True, "privacy.delta must be a number, got True"),
    ],
)
def test_bad_settings_are_named_with_their_path(field, value, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 - the whole message is compared
        PrivacySettings(**{field: value})
    assert str(error.value) == message


def test_settings_are_checked_again_when_replaced():
    with pytest.raises(ValueError, match=r"privacy\.delta"):
        dataclasses.replace(PrivacySettings(), delta=0.7)


def test_every_preset_gives_finite_noise_above_zero():
    for preset in PRESETS:
        std = noise_std(PrivacySettings(preset), HIGHWAY)
        assert std.shape == (2,)
        assert std.dtype == np.float64
        assert (std > 0.0).all()
        assert np.isfinite(std).all()


# --- the guaranteed preset ------------------------------------------------------------------------


def bounded(cap=16, adjacency="replace"):
    return contribution_sensitivity(
        contributions=cap,
        adjacency=adjacency,
        segment_length=0.1,
        largest_speed=102.0,
        protects="a trip",
    )


@pytest.mark.parametrize(
    ("epsilon", "stds"), [(1.0, (53, 107, 213)), (5.0, (19, 38, 76)), (10.0, (12, 24, 49))]
)
def test_golden_noise_of_the_guaranteed_preset(epsilon, stds):
    for cap, std in zip((4, 16, 64), stds, strict=True):
        density, flow = noise_std(PrivacySettings("guaranteed", epsilon, 0.05), bounded(cap))
        assert round(density) == std  # veh/km
        assert flow == pytest.approx(51.0 * density, rel=1e-12)  # veh/h: v_0 times as much


@pytest.mark.parametrize("adjacency", ["replace", "add_remove"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("delta", [0.4, 0.05, 1e-3, 1e-6, 1e-12])
@pytest.mark.parametrize("epsilon", [0.01, 0.1, 1.0, 5.0, 10.0, 50.0])
def test_the_releases_together_are_worth_what_was_asked(epsilon, delta, share, adjacency):
    """Against dp-accounting: the sensitivity of the whole transcript in units of the noise."""
    settings = PrivacySettings("guaranteed", epsilon, delta, share=share, adjacency=adjacency)
    sensitivity = bounded(adjacency=adjacency)
    mu = sensitivity.joint_mu(noise_std(settings, sensitivity))
    assert 1.0 / mu == pytest.approx(get_sigma_gaussian(epsilon, delta, tol=1e-15), rel=1e-9)


@pytest.mark.parametrize("adjacency", ["replace", "add_remove"])
def test_step_by_step_the_releases_compose_to_what_was_asked(adjacency):
    """A vehicle that moves both releases in each of its steps, composed by dp-accounting."""
    cap, settings = 16, PrivacySettings("guaranteed", 2.0, 0.01, adjacency=adjacency)
    density, flow = noise_std(settings, bounded(cap, adjacency))
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


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("cap", 0, r"^privacy\.cap must be an integer >= 1, got 0$"),
        ("cap", 1.5, r"^privacy\.cap must be an integer >= 1, got 1\.5$"),
        ("share", 0.0, r"^privacy\.share must be in \(0, 1\), got 0\.0$"),
        ("share", 1, r"^privacy\.share must be in \(0, 1\), got 1$"),
        (
            "unit",
            "day",
            r"^privacy\.unit must be one of \['trip', 'horizon', 'event'\], got 'day'$",
        ),
        ("adjacency", "add", r"^privacy\.adjacency must be one of .*, got 'add'$"),
        ("speed_release", "sum", r"^privacy\.speed_release must be one of .*, got 'sum'$"),
        ("boundary_inputs", "none", r"^privacy\.boundary_inputs must be one of .*, got 'none'$"),
    ],
)
def test_bad_wishes_for_a_guarantee_are_named_with_their_path(field, value, message):
    with pytest.raises(ValueError, match=message):
        PrivacySettings("guaranteed", **{field: value})


def test_pairs_that_do_not_go_together_are_refused():
    with pytest.raises(
        ValueError, match=r"^privacy\.speed_release must be 'mean' with preset 'paper'"
    ):
        PrivacySettings("paper", speed_release="flow")
    for preset, release in (("guaranteed", "mean"), ("paper", None)):
        with pytest.raises(ValueError, match=r"^privacy\.adjacency must be 'replace' where mean"):
            PrivacySettings(preset, adjacency="add_remove", speed_release=release)


@pytest.mark.parametrize(
    ("unit", "contributions", "cap"), [("trip", 64, 64), ("horizon", 100, None), ("event", 1, None)]
)
def test_a_unit_says_how_often_it_can_count(unit, contributions, cap):
    settings = PrivacySettings("guaranteed", unit=unit)
    assert settings.contributions(100) == contributions
    assert settings.contribution_cap == cap
    assert PrivacySettings("guaranteed", unit="trip").contributions(10) == 10
    assert PrivacySettings("paper", unit=unit).contribution_cap is None


def test_flow_noise_covers_two_speeds_on_one_segment_whatever_the_share():
    mu = mu_of(1.0, 0.05)
    for share in (0.01, 0.3, 0.5, 0.7):
        _, flow = noise_std(PrivacySettings("guaranteed", share=share), bounded(16))
        assert flow >= 2.0 * 4.0 * 510.0 / mu * (1.0 - 1e-12)
        assert (share <= 0.5) == (flow <= 2.0 * 4.0 * 510.0 / mu * (1.0 + 1e-12))
