import dataclasses
import json
import math

import numpy as np
import pytest

from dptse_env.release import CappedSettings, PacedSettings, PrivacySettings
from dptse_env.release.pacing import TracerPacing


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
        ("epsilon", 0.0, "privacy.epsilon must be a number in [0.0001, 10000], got 0.0"),
        ("epsilon", math.nan, "privacy.epsilon must be a number in [0.0001, 10000], got nan"),
        ("epsilon", "1", "privacy.epsilon must be a number in [0.0001, 10000], got '1'"),
        ("delta", 0.5, "privacy.delta must be a number in [1e-12, 0.5), got 0.5"),
        ("delta", 0, "privacy.delta must be a number in [1e-12, 0.5), got 0"),
        ("delta", True, "privacy.delta must be a number in [1e-12, 0.5), got True"),
    ],
)
def test_bad_settings_are_named_with_their_path(field, value, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 - the whole message is compared
        PrivacySettings(**{field: value})
    assert str(error.value) == message


def test_settings_are_checked_again_when_replaced():
    with pytest.raises(ValueError, match=r"privacy\.delta"):
        dataclasses.replace(PrivacySettings(), delta=0.7)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("cap", 0, r"^privacy\.cap must be an integer in 1\.\.1000000, got 0$"),
        ("cap", 2**63, r"^privacy\.cap must be an integer .*, got 9223372036854775808$"),
        ("share", 0.0, r"^privacy\.share must be a number in \[0\.001, 0\.999\], got 0\.0$"),
        ("unit", "day", r"^privacy\.unit must be one of 'trip', 'horizon', 'event', got 'day'$"),
        ("unit", np.zeros(2), r"^privacy\.unit must be one of .*, got array"),
        ("adjacency", "add", r"^privacy\.adjacency must be one of .*, got 'add'$"),
        ("speed_release", "sum", r"^privacy\.speed_release must be one of .*, got 'sum'$"),
    ],
)  # fmt: skip
def test_bad_settings_of_capped_contributions_are_named_with_their_path(field, value, message):
    with pytest.raises(ValueError, match=message):
        CappedSettings(**{field: value})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"pace": 0.0}, r"^privacy\.pace must be a number in \[0\.05, 1\], got 0\.0$"),
        ({"clip": math.inf}, r"^privacy\.clip must be a number in \[1, 200\], got inf$"),
        ({"ratio": 1.0001}, r"^privacy\.ratio must be at most 1 for .*, got 1\.0001$"),
        ({"unit": "horizon"}, r"^privacy\.unit must be one of 'trip', 'event', got 'horizon'$"),
        ({"pacing": "fast"}, r"^privacy\.pacing must be one of tracer, .*got 'fast'"),
        ({"pacing": dict}, r"^privacy\.pacing .* must be a subclass of .*release\.Pacing"),
        ({"pacing": "numpy:nothing"}, r"^privacy\.pacing"),
    ],
)  # fmt: skip
def test_bad_settings_of_the_paced_ledger_are_named_with_their_path(fields, message):
    with pytest.raises(ValueError, match=message):
        PacedSettings(**fields)


def test_a_ratio_above_one_is_fine_where_no_vehicle_takes_the_place_of_another():
    assert PacedSettings(adjacency="add_remove", ratio=50).ratio == 50.0
    assert PacedSettings(ratio=1).ratio == 1.0


@pytest.mark.parametrize(
    "pacing", ["tracer", TracerPacing, "dptse_env.release.pacing:TracerPacing"]
)
def test_a_pacing_is_a_name_a_path_or_a_class(pacing):
    assert PacedSettings(pacing=pacing).pacing == pacing


def test_mean_speeds_of_a_segment_have_no_neighbour_without_its_one_vehicle():
    with pytest.raises(ValueError, match=r"^privacy\.adjacency must be 'replace' where mean"):
        CappedSettings(adjacency="add_remove", speed_release="mean")


@pytest.mark.parametrize(
    ("unit", "contributions", "cap"), [("trip", 64, 64), ("horizon", 100, None), ("event", 1, None)]
)
def test_a_unit_bounds_how_often_it_can_count(unit, contributions, cap):
    settings = CappedSettings(unit=unit)
    assert settings.contributions(100) == contributions
    assert settings.contribution_cap == cap
    assert CappedSettings(unit="trip").contributions(10) == 10


@pytest.mark.parametrize(
    ("settings", "boundary"),
    [
        (PrivacySettings(), "true"),
        (PrivacySettings(boundary_inputs="private"), "private"),
        (CappedSettings(), "nominal"),
        (CappedSettings(boundary_inputs="true"), "true"),
        (PacedSettings(), "nominal"),
    ],
)
def test_the_boundary_is_the_model_s_default_unless_given(settings, boundary):
    assert settings.boundary == boundary
