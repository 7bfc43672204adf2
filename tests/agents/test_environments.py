"""Environments of command lines: their ids, keywords and headings."""

import pytest

from agents.environments import heading, parse_env, settings_of

PRIVATE = "dptse_env:dptse/PrivateHighway-v1"


def headed(text):
    env, keywords = parse_env(text)
    return heading(env, keywords)


def test_a_heading_names_what_is_in_force():
    assert headed(PRIVATE) == (
        "PrivateHighway-v1, parameters w99-3lane, release model paced (epsilon 5, delta 0.05), "
        "penetration 1, bandwidth 1, query_every 1, fixed sensors 14, 17, 18, no loops"
    )


@pytest.mark.parametrize(
    ("keywords", "named"),
    [
        ('{"penetration": [0.1, 0.3]}', "penetration 0.1 to 0.3"),
        ('{"penetration": {"misreporting": 0.1}}', "penetration.misreporting 0.1"),
        ('{"corridor": {"fixed_sensors": []}}', "no fixed sensors"),
        ('{"sensor_settings": {"absolute": 2}}', "sensor_settings.absolute 2.0"),
        ('{"epsilon": 1}', "release model paced (epsilon 1, delta 0.05)"),
        ('{"privacy": {"preset": "capped", "cap": 16}}', "privacy.cap 16"),
        ('{"horizon": 300}', "horizon 300"),
        ('{"loops": {"positions": [0, 0.5]}}', "loops at 0 km, 0.5 km every 20 s"),
        (
            '{"loops": {"ramps": [3], "interval": 60, "least_count": 5}}',
            "loops at ramp 3 every 60 s (least count 5)",
        ),
        ('{"demand": {"base": {"mainline": [[0, 900]]}}}', "another corridor.demand"),
        ('{"corridor": "short-highway", "bandwidth": 2}', "road short-highway, parameters"),
        (
            '{"corridor": "short-highway", "bandwidth": 2, "incident": "none"}',
            "corridor.incident None",
        ),
    ],
)
def test_a_heading_names_each_condition(keywords, named):
    said = headed(f"{PRIVATE} {keywords}")
    assert f", {named}" in said
    assert said.count(named) == 1


@pytest.mark.parametrize(
    ("keywords", "settings"),
    [
        (
            {"estimator": "ekf"},
            "tuned with the parameters w99-3lane for paced (ekf-w99-3lane-paced)",
        ),
        (
            {"estimator": "ekf", "estimator_settings": "ekf-w99-3lane-paced-long-highway"},
            "tuned with the parameters w99-3lane for paced on long-highway "
            "(ekf-w99-3lane-paced-long-highway)",
        ),
        ({"estimator": "recurrent"}, "weights highway-flows"),
        ({"estimator": "recurrent", "privacy": "corrected"}, "weights highway-speeds"),
        ({"estimator": "asm"}, "defaults"),
        (
            {"estimator": "ekf", "estimator_settings": "published"},
            "as the paper has them, for paced (ekf-w99-3lane-paced-published)",
        ),
        ({"estimator": "ekf", "estimator_settings": {"noise_scale": [2.0, 2.0]}}, "its own"),
    ],
)
def test_settings_in_force_have_a_name(keywords, settings):
    assert settings_of(PRIVATE, keywords) == settings


def test_a_module_that_raises_is_refused(tmp_path, monkeypatch):
    (tmp_path / "broken_module.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="'broken_module' cannot be imported: ZeroDivision"):
        parse_env("broken_module:dptse/ShortHighway-v0")
