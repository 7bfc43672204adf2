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
        ("process_noise", 0.1, r"process_noise must be a sequence, got 0\.1"),
        ("walk_noise", (0.0, "a"), r"walk_noise\[1\] must be a number in \[0, 10\], got 'a'"),
        ("walk_noise", (float("nan"), 0.0), r"walk_noise\[0\] must be .*, got nan"),
        ("noise_scale", (0.0, 1.0), r"noise_scale\[0\] must be .* \[1e-06, 1000\], got 0\.0"),
        ("noise_scale", (1.0, float("inf")), r"noise_scale\[1\] must be .*, got inf"),
        ("noise_scale", 1.0, r"noise_scale must be a sequence, got 1\.0"),
        ("initial_variance", 0.0, r"initial_variance must be a number in \(0, 100\], got 0\.0"),
        ("initial_variance", True, r"initial_variance must be a number"),
        ("speed_cap", 0.0, r"speed_cap must be .*, got 0\.0"),
        ("speed_cap", float("nan"), r"speed_cap must be .*, got nan"),
        ("bounds", "ball", r"bounds must be one of 'cone', 'box', got 'ball'"),
        ("band", 0, r"band must be an integer in 1\.\.1000( or None)?, got 0"),
        ("band", 2.5, r"band must be .*, got 2\.5"),
        ("ukf", {"alpha": 2.0}, r"ukf\.alpha must be a number in \[0\.001, 1\], got 2\.0"),
        ("ukf", {"alpha": 0.0}, r"ukf\.alpha must be a number in \[0\.001, 1\], got 0\.0"),
        ("ukf", {"beta": -1.0}, r"ukf\.beta must be a number in \[0, 100\], got -1\.0"),
        ("ukf", {"kappa": "a"}, r"ukf\.kappa must be a number in \[-10000, 10000\], got 'a'"),
        ("process_noise_in", "v", r"process_noise_in must be one of 'psi', 'w', got 'v'"),
        ("blend", {"density_weight": 1.1}, r"blend\.density_weight must be .*, got 1\.1"),
        ("blend", {"speed_weight": -0.1}, r"blend\.speed_weight must be .*, got -0\.1"),
        ("enkf", {"n_members": 1}, r"enkf\.n_members must be an integer in 2\.\.10000, got 1"),
        ("enkf", {"inflation": 0.9}, r"enkf\.inflation must be a number in \[1, 10\], got 0\.9"),
        ("enkf", {"taper": 0.0}, r"enkf\.taper must be .*, got 0\.0"),
        ("mhe", {"horizon": 0}, r"mhe\.horizon must be an integer in 1\.\.1000, got 0"),
        ("mhe", {"horizon": 2.5}, r"mhe\.horizon must be an integer in 1\.\.1000, got 2\.5"),
        ("mhe", {"arrival_noise": [0.1, 0.0]}, r"mhe\.arrival_noise\[1\] must be .*, got 0\.0"),
        (
            "mhe",
            {"linearisation": "none"},
            r"mhe\.linearisation must be one of 'paper', 'trajectory', got 'none'",
        ),
        ("mhe", {"bounds": "ball"}, r"mhe\.bounds must be one of 'cone', 'box', got 'ball'"),
        *[("mhe", {"solver": s}, rf"mhe\.solver must not be '{s}'") for s in REFUSED_SOLVERS],
    ],
)
def test_a_bad_setting_is_named(field, value, message):
    with pytest.raises(ValueError, match=r"^estimator_settings\." + message):
        EstimatorSettings(**{field: value})


def test_highs_is_refused():
    assert "highs" in REFUSED_SOLVERS


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
        process_noise_in="w",
        speed_cap=1.05,
        noise_scale=(1.5, 2.5),
        bounds="box",
        band=12,
        ukf=SigmaPointSettings(alpha=0.5),
        enkf=EnsembleSettings(inflation=1.1),
        mhe=HorizonSettings(horizon=4, arrival_noise=(0.1, 0.2), solver="quadprog"),
        blend=BlendSettings(density_weight=0.3, speed_weight=0.9),
    )
    again = EstimatorSettings(**json.loads(json.dumps(asdict(settings))))
    assert again == settings
    assert hash(again) == hash(settings)
