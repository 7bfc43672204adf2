import json
from dataclasses import asdict

import pytest

from dptse_env.estimators.settings import (
    REFUSED_SOLVERS,
    BlendSettings,
    EnsembleSettings,
    EstimatorSettings,
    HorizonSettings,
    SigmaPointSettings,
)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("process_noise", (-1.0, 0.0), r"process_noise\[0\] must be .*, got -1\.0"),
        ("process_noise", (0.1,), r"process_noise must have 2 items, got 1: \(0\.1,\)"),
        ("walk_noise", (float("nan"), 0.0), r"walk_noise\[0\] must be .*, got nan"),
        ("bounds", "ball", r"bounds must be one of 'cone', 'box', got 'ball'"),
        ("mhe", {"arrival_noise": [0.1, 0.0]}, r"mhe\.arrival_noise\[1\] must be .*, got 0\.0"),
    ],
)
def test_a_bad_setting_is_named(field, value, message):
    with pytest.raises(ValueError, match=r"^estimator_settings\." + message):
        EstimatorSettings(**{field: value})


def test_solvers_that_return_false_optima_are_refused():
    for solver in ("highs", *REFUSED_SOLVERS):
        with pytest.raises(ValueError, match=rf"mhe\.solver must not be '{solver}'"):
            EstimatorSettings(mhe={"solver": solver})


def test_nested_settings_may_be_given_as_dicts():
    settings = EstimatorSettings(
        ukf={"kappa": 1.0}, enkf={"n_members": 50, "taper": 2.0}, mhe={"arrival_noise": [0.1, 0.2]}
    )
    assert settings.ukf == SigmaPointSettings(kappa=1.0)
    assert settings.enkf == EnsembleSettings(n_members=50, taper=2.0)
    assert settings.mhe == HorizonSettings(arrival_noise=(0.1, 0.2))
    with pytest.raises(ValueError, match=r"enkf\.n_member is unknown; allowed: n_members"):
        EstimatorSettings(enkf={"n_member": 50})


def test_settings_survive_json():
    settings = EstimatorSettings(
        process_noise=(0.1, 0.2),
        walk_noise=(0.3, 0.4),
        speed_cap=1.05,
        noise_scale=(1.5, 2.5),
        bounds="box",
        ukf=SigmaPointSettings(alpha=0.5),
        enkf=EnsembleSettings(inflation=1.1),
        mhe=HorizonSettings(horizon=4, arrival_noise=(0.1, 0.2), solver="quadprog"),
        blend=BlendSettings(density_weight=0.3, speed_weight=0.9),
    )
    again = EstimatorSettings(**json.loads(json.dumps(asdict(settings))))
    assert again == settings
    assert hash(again) == hash(settings)
