import json
from dataclasses import asdict

import pytest

from dptse_env.estimators.base import EstimatorSettings


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("process_noise", (-1.0, 0.0), r"estimator\.process_noise\[0\] must be >= 0, got -1"),
        (
            "process_noise",
            (0.1,),
            r"estimator\.process_noise must be a sequence of 2, got \(0\.1,\)",
        ),
        ("process_noise", 0.1, r"estimator\.process_noise must be a sequence of 2, got 0\.1"),
        ("walk_noise", (0.0, "a"), r"estimator\.walk_noise\[1\] must be a number, got 'a'"),
        ("walk_noise", (float("nan"), 0.0), r"walk_noise\[0\] must be finite, got nan"),
        ("initial_variance", 0.0, r"estimator\.initial_variance must be > 0, got 0\.0"),
        ("initial_variance", True, r"estimator\.initial_variance must be a number"),
        ("bounds", "ball", r"estimator\.bounds must be 'cone' or 'box', got 'ball'"),
    ],
)
def test_bad_setting_is_named(field, value, message):
    with pytest.raises(ValueError, match=message):
        EstimatorSettings(**{field: value})


def test_settings_survive_json():
    settings = EstimatorSettings(process_noise=(0.1, 0.2), bounds="box")
    assert EstimatorSettings(**json.loads(json.dumps(asdict(settings)))) == settings
