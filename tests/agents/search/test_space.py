import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution

from agents.search.space import (
    DEMAND_START,
    SPACE,
    at_bound,
    evenly,
    holds,
    nested,
    rounded,
    search_space,
    values_of,
)
from dptse_env.estimators import (
    ESTIMATORS,
    BlendSettings,
    DemandSettings,
    EnsembleSettings,
    EstimatorSettings,
    HorizonSettings,
    SigmaPointSettings,
)
from dptse_env.estimators.settings import available_settings, load_settings
from dptse_env.utils.fields import from_mapping


def test_every_estimator_that_has_settings_can_be_tuned():
    assert {*SPACE, "open_loop", "recurrent"} == set(ESTIMATORS)
    with pytest.raises(ValueError, match=r"'recurrent' has nothing to tune: .*train_estimator"):
        search_space("recurrent")
    with pytest.raises(ValueError, match=r"'open_loop' has nothing to tune.*tunable are ekf, ukf"):
        search_space("open_loop")
    with pytest.raises(ValueError, match=r"estimator must be one of ekf, .*, got 'kf'"):
        search_space("kf")


@pytest.mark.parametrize("estimator", SPACE)
def test_the_search_holds_the_defaults_and_the_shipped_sets(estimator):
    names = [name for name in available_settings() if name.startswith(f"{estimator}-")]
    shipped = [load_settings(name) for name in names]
    with_demand = [settings for settings in shipped if settings.demand is not None]
    if estimator == "ekf":
        assert with_demand
    for settings in (EstimatorSettings(), *shipped):
        has_demand = settings.demand is not None
        space = search_space(
            estimator,
            with_noise_scale=has_demand,
            with_demand=has_demand,
        )
        values = values_of(settings, space)
        assert list(values) == list(space)
        assert all(holds(knob, values[path]) for path, knob in space.items())
        assert from_mapping(EstimatorSettings, nested(values), "settings") == settings


def test_demand_states_and_the_speed_cap_are_searched_where_they_are_asked_for():
    space = search_space("ekf", with_demand=True, with_speed_cap=True)
    settings = EstimatorSettings(
        process_noise=(0.02, 0.03), speed_cap=1.0, demand=DemandSettings(),
        density_growth=0.01, count_noise=0.1,
    )  # fmt: skip
    for one in (settings, DEMAND_START):
        values = values_of(one, space)
        assert all(holds(knob, values[path]) for path, knob in space.items())
    for name in SPACE:
        assert {*search_space(name, with_speed_cap=True)} - {*search_space(name)} == {"speed_cap"}


def test_paths_become_nested_settings():
    settings = EstimatorSettings(
        process_noise=(0.1, 0.2),
        walk_noise=(0.3, 0.4),
        noise_scale=(1.5, 2.5),
        ukf=SigmaPointSettings(alpha=1.0),
        enkf=EnsembleSettings(inflation=1.02, taper=0.5),
        mhe=HorizonSettings(arrival_noise=(0.5, 0.6), linearisation="trajectory", bounds="cone"),
        blend=BlendSettings(density_weight=0.3, speed_weight=0.9),
    )
    everything = {path: knob for name in SPACE for path, knob in search_space(name, True).items()}
    values = values_of(settings, everything)
    assert values["process_noise.1"] == 0.2
    assert values["mhe.arrival_noise.0"] == 0.5
    assert nested(values) == {
        "process_noise": [0.1, 0.2],
        "walk_noise": [0.3, 0.4],
        "noise_scale": [1.5, 2.5],
        "ukf": {"alpha": 1.0},
        "enkf": {"inflation": 1.02, "taper": 0.5},
        "mhe": {"arrival_noise": [0.5, 0.6], "linearisation": "trajectory", "bounds": "cone"},
        "blend": {"density_weight": 0.3, "speed_weight": 0.9},
    }


def test_values_are_rounded_to_four_digits():
    assert rounded(0.0123456) == 0.01235
    assert [rounded(option) for option in (None, "cone", 0.5)] == [None, "cone", 0.5]
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    values = [study.ask({"x": evenly(0.001, 0.1)}).params["x"] for _ in range(200)]
    assert 60 < sum(value < 0.01 for value in values) < 140  # even in the logarithm


def test_bounds_of_the_search_are_seen():
    knob, options = evenly(1e-3, 1e-1), CategoricalDistribution((1, 2))
    assert [at_bound(knob, value) for value in (1e-3, 1.09e-3, 1.2e-3, 8e-2, 9.2e-2, 1e-1)] == [
        True, True, False, False, True, True,
    ]  # fmt: skip
    assert [at_bound(FloatDistribution(1.0, 1.1), value) for value in (1.001, 1.05)] == [
        True,
        False,
    ]
    assert [holds(knob, value) for value in (9e-4, 1e-2, 0.2)] == [False, True, False]
    assert [holds(options, value) for value in (1, 3)] == [True, False]
    assert not at_bound(options, 1)
