import dataclasses
import json
import math

import numpy as np
import pytest

from dptse_env.privacy.calibration import PRESETS, PrivacySettings, noise_std
from dptse_env.privacy.gaussian import le_ny_kappa
from dptse_env.privacy.sensitivity import paper_sensitivity

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
        ("preset", "Paper", "privacy.preset must be one of ['paper', 'corrected', 'guaranteed'], got 'Paper'"),
        ("preset", None, "privacy.preset must be one of ['paper', 'corrected', 'guaranteed'], got None"),
        ("preset", [], "privacy.preset must be one of ['paper', 'corrected', 'guaranteed'], got []"),
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
