"""Settings, the tuned sets that ship, and files of them."""

import itertools
import json
import re

import pytest

from dptse_env.estimators import ESTIMATORS
from dptse_env.estimators.settings import (
    EstimatorSettings,
    HorizonSettings,
)
from dptse_env.estimators.tuned import (
    available_settings,
    load_settings,
    read_settings,
    settings_name,
    tuned_estimator,
    write_settings,
)
from dptse_env.model import available_parameters
from dptse_env.release import RELEASE_MODELS
from dptse_env.traffic import CORRIDORS

GOOD = {
    "estimator": "mhe",
    "parameters": "published",
    "privacy": "corrected",
    "settings": {"process_noise": [0.01, 0.02], "mhe": {"arrival_noise": [0.1, 0.2]}},
    "provenance": {"source": "a test"},
}
ENTRY = {key: GOOD[key] for key in ("estimator", "settings", "provenance")}
FILE = {"mhe-published-corrected": ENTRY}


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("process_noise", (-1.0, 0.0), r"process_noise\[0\] must be .*, got -1\.0"),
        ("walk_noise", (float("nan"), 0.0), r"walk_noise\[0\] must be .*, got nan"),
        ("bounds", "ball", r"bounds must be one of cone, box, got 'ball'"),
        ("mhe", {"arrival_noise": [0.1, 0.0]}, r"mhe\.arrival_noise\[1\] must be .*, got 0\.0"),
        ("enkf", {"n_member": 50}, r"enkf\.n_member is unknown; allowed: n_members"),
    ],
)
def test_a_bad_setting_is_named(field, value, message):
    with pytest.raises(ValueError, match=r"^estimator_settings\." + message):
        EstimatorSettings(**{field: value})


def test_shipped_sets_are_named_after_what_they_are_for():
    cells = itertools.product(ESTIMATORS, available_parameters(), RELEASE_MODELS)
    names = {settings_name(*cell, v) for cell in cells for v in ("", "published", *CORRIDORS)}
    assert "ekf-w99-3lane-printed" in available_settings()
    assert set(available_settings()) <= names
    for name in available_settings():
        assert load_settings(name) != EstimatorSettings()
    with pytest.raises(ValueError, match=r"^estimator_settings must be .*, got 'Published'$"):
        load_settings("Published")


def test_a_written_set_reads_back_over_the_defaults(tmp_path):
    path = tmp_path / "x.json"
    write_settings(path, **GOOD)
    assert read_settings(path) == EstimatorSettings(
        process_noise=(0.01, 0.02), mhe=HorizonSettings(arrival_noise=(0.1, 0.2))
    )
    assert json.loads(path.read_text()) == FILE
    assert tuned_estimator(path) == "mhe"


def test_bad_settings_are_neither_written_nor_read(tmp_path):
    path, settings = tmp_path / "x.json", {"mhe": {"horizons": 3}}
    message = rf"^{re.escape(str(path))}: estimator_settings\.mhe\.horizons is unknown"
    with pytest.raises(ValueError, match=message):
        write_settings(path, **{**GOOD, "settings": settings})
    assert not path.exists()
    path.write_text(json.dumps({"mhe-published-corrected": {**ENTRY, "settings": settings}}))
    with pytest.raises(ValueError, match=message):
        read_settings(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", " must be JSON: "),
        ("[" * 100_000, " must be JSON: "),
        ("[]", r" must be .*, got \[\]"),
        (json.dumps({**FILE, "x": ENTRY}), " must be .*, got {"),
        ('{"x": 1}', ": x must be .*, got 1"),
        (json.dumps({"x": {**ENTRY, "settings": 1}}), ": x: settings must be .*, got 1"),
    ],
)
def test_a_file_of_another_shape_is_refused_by_its_path(text, message, tmp_path):
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"^{re.escape(str(path))}{message}"):
        read_settings(path)
