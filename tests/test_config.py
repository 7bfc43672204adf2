import dataclasses
import itertools
import json

import gymnasium as gym
import pytest

from dptse_env.config import (
    PRESETS,
    TEST_SEEDS,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    parse_seeds,
    resolve,
)
from dptse_env.estimators import EstimatorSettings, HorizonSettings
from dptse_env.estimators.settings import available_settings, load_settings
from dptse_env.parts import make_release, make_task, privacy_report, warn_where_void
from dptse_env.release import MOST_OPTIONS, CappedSettings, PrivacySettings
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY, DemandDistribution, IncidentDistribution
from tests.helpers import MeanRelease, SumRelease


def test_seeds_of_training_validation_and_test_are_disjoint():
    assert not set(TRAINING_SEEDS) & set(VALIDATION_SEEDS)
    assert not set(TRAINING_SEEDS) & set(TEST_SEEDS)
    assert not set(VALIDATION_SEEDS) & set(TEST_SEEDS)
    for preset in PRESETS.values():
        assert set(preset.traffic_seeds) <= set(TRAINING_SEEDS)


def test_a_whole_configuration_survives_json():
    config = resolve("paper-highway", {"incident": "random", "demand": "random"})
    plain = json.loads(json.dumps(dataclasses.asdict(config)))
    assert resolve("short-highway", plain) == config


def test_partial_overrides_keep_the_rest():
    config = resolve("paper-highway", {"corridor": {"duration": 650}, "privacy": "corrected"})
    assert config.corridor == dataclasses.replace(PAPER_HIGHWAY, duration=650)
    assert (config.privacy.preset, config.privacy.epsilon) == ("corrected", 1.0)
    config = resolve("paper-highway", {"privacy": {"delta": 0.01}, "epsilon": 2})
    assert (config.privacy.epsilon, config.privacy.delta) == (2.0, 0.01)
    config = resolve("paper-highway", {"corridor": "short-highway", "bandwidth": 2})
    assert config.corridor == SHORT_HIGHWAY


def test_incident_and_demand_by_name():
    config = resolve("paper-highway", {"incident": "random", "demand": "random"})
    assert isinstance(config.corridor.incident, IncidentDistribution)
    assert isinstance(config.corridor.demand, DemandDistribution)
    assert resolve("paper-highway", {"incident": "none"}).corridor.incident is None
    assert resolve("paper-highway", {"incident": "preset"}).corridor == PAPER_HIGHWAY
    moved = resolve("paper-highway", {"incident": {"segment": 3}})
    assert moved.corridor.incident.segment == 3
    assert moved.corridor.incident.phases == PAPER_HIGHWAY.incident.phases


def test_tuned_settings_are_found_by_estimator_parameters_and_privacy():
    for estimator, parameters, privacy in itertools.product(
        ("ekf", "open_loop"), ("paper", "w99-3lane"), ("paper", "corrected")
    ):
        keywords = {"estimator": estimator, "parameters": parameters, "privacy": privacy}
        settings = resolve("paper-highway", keywords).settings()
        name = f"{estimator}-{parameters}-{privacy}"
        known = name in available_settings()
        assert settings == (load_settings(name) if known else EstimatorSettings())
    assert "ekf-w99-3lane-paper" in available_settings()


@pytest.mark.parametrize("estimator", ["random_walk", "open_loop", "recurrent"])
def test_demand_states_without_a_traffic_model_are_refused_by_the_configuration(estimator):
    keywords = {"estimator": estimator, "estimator_settings": "ekf-w99-3lane-paced"}
    with pytest.raises(
        ValueError, match=rf"^estimator_settings.demand must be None for '{estimator}'"
    ):
        resolve("paper-highway", keywords)


@pytest.mark.parametrize(
    ("estimator", "settings", "message"),
    [
        ("mhe", {"process_noise": [0.01, 0.0]}, r"process_noise\[1\] must be a finite number > 0"),
        ("mhe", {"mhe": {"horizon": 1000}}, r"mhe\.horizon must be an integer in 1\.\.186"),
        ("ukf", {"ukf": {"kappa": -16.0}}, r"ukf\.kappa must be > -16, got -16"),
        ("ukf", {"ukf": {"kappa": -18.0}, "demand": {}}, r"ukf\.kappa must be > -18, got -18"),
        ("recurrent", {"recurrent": {"weights": "x"}}, "recurrent.weights must be a file or one"),
    ],
)
def test_settings_that_an_estimator_cannot_have_are_refused_when_it_is_made(
    estimator, settings, message
):
    keywords = {"estimator": estimator, "estimator_settings": settings}
    with pytest.raises(ValueError, match=f"^estimator_settings.{message}"):
        gym.make("dptse_env:dptse/ShortHighway-v0", **keywords)


def test_a_set_for_the_corridor_comes_before_that_for_any():
    config = resolve("long-highway", {})
    assert config.settings_name == "ekf-w99-3lane-paced-long-highway"
    assert resolve("long-highway", {"estimator": "mhe"}).settings_name == "mhe-w99-3lane-paced"
    assert resolve("private-highway-v1", {}).settings_name == "ekf-w99-3lane-paced"


def test_a_road_of_ones_own_takes_no_set_for_an_ending_of_its_name():
    """`ekf-w99-3lane-capped-demand` is a variant, not a set for a road that is called demand."""
    keywords = {"parameters": "w99-3lane", "privacy": "capped", "corridor": {"name": "demand"}}
    assert resolve("paper-highway", keywords).settings_name == "ekf-w99-3lane-capped"


def test_a_tuned_set_by_name_serves_any_estimator():
    keywords = {"estimator": "ukf", "estimator_settings": "ekf-w99-3lane-paper"}
    config = resolve("paper-highway", keywords)
    assert config.estimator_settings == "ekf-w99-3lane-paper"
    assert config.settings() == load_settings("ekf-w99-3lane-paper")
    with pytest.raises(
        ValueError, match=r"^estimator_settings must be one of .*ekf-w99-3lane-paper.*, got 'best'$"
    ):
        resolve("paper-highway", {"estimator_settings": "best"})


def test_a_mapping_of_settings_keeps_what_would_have_been_chosen():
    keywords = {"parameters": "w99-3lane", "estimator_settings": {"mhe": {"horizon": 3}}}
    tuned = load_settings("ekf-w99-3lane-paper")
    assert tuned.process_noise != EstimatorSettings().process_noise
    expected = dataclasses.replace(tuned, mhe=dataclasses.replace(tuned.mhe, horizon=3))
    assert resolve("paper-highway", keywords).settings() == expected
    keywords["estimator"] = "open_loop"
    assert resolve("paper-highway", keywords).settings() == EstimatorSettings(
        mhe=HorizonSettings(horizon=3)
    )
    given = EstimatorSettings(noise_scale=(2.0, 2.0))
    keywords["estimator_settings"] = given
    assert resolve("paper-highway", keywords).settings() is given
    for bad, message in (
        ({"noise": 1.0}, r"^estimator_settings\.noise is unknown; allowed: "),
        ({"mhe": {"horizon": 0}}, r"^estimator_settings\.mhe\.horizon must be an integer in 1"),
        (3, r"^estimator_settings must be "),
    ):
        with pytest.raises(ValueError, match=message):
            resolve("paper-highway", {"estimator_settings": bad})


def test_seed_ranges():
    assert parse_seeds("3:6") == (3, 4, 5)
    assert parse_seeds("7") == (7,)
    for text in ("", "3:3", "4:2", "-1:2", "a:b", "1:2:3", " 0:1", "1:"):
        with pytest.raises(ValueError, match=r"^seeds must "):
            parse_seeds(text)


# --- privacy --------------------------------------------------------------------------------------


def test_a_preset_by_name_keeps_the_other_fields_of_privacy():
    config = resolve("private-highway", {"privacy": "corrected"})
    assert config.privacy == PrivacySettings("corrected", epsilon=5.0)
    assert make_task(config).flow_centre is None
    config = resolve("paper-highway", {"privacy": "capped", "epsilon": 2})
    assert config.privacy == CappedSettings(epsilon=2.0)
    assert config.privacy.boundary == "nominal"


EVERY_PRIVACY_KEYWORD = {
    "preset": "capped",
    "epsilon": 2,
    "delta": 0.01,
    "unit": "horizon",
    "cap": 8,
    "adjacency": "add_remove",
    "share": 0.25,
    "speed_release": "flow",
    "boundary_inputs": "private",
}


def test_every_privacy_keyword_is_reachable_from_json():
    assert set(EVERY_PRIVACY_KEYWORD) == {
        field.name for field in dataclasses.fields(CappedSettings)
    }
    plain = json.loads(json.dumps(EVERY_PRIVACY_KEYWORD))
    config = resolve("paper-highway", {"privacy": plain})
    assert config.privacy == CappedSettings(**EVERY_PRIVACY_KEYWORD)
    again = json.loads(json.dumps(dataclasses.asdict(config)))
    assert resolve("short-highway", again) == config
    nothing = {"boundary_inputs": None}
    assert resolve("private-highway", {"privacy": nothing}) == PRESETS["private-highway"]


BAD_PRIVACY = [
    ({"cap": 2.5}, "cap must be"),
    ({"epsilon": 0}, "epsilon must be"),
    ({"unit": "week"}, "unit must be one of"),
    ({"speed_release": "mean", "adjacency": "add_remove"}, "adjacency must be 'replace'"),
    ({"preset": "paper", "speed_release": "flow"}, "speed_release is unknown"),
]


def test_bad_privacy_is_named_with_its_path():
    for privacy, message in BAD_PRIVACY:
        with pytest.raises(ValueError, match=rf"^privacy\.{message}"):
            resolve("private-highway", {"privacy": privacy})


def test_neither_bandwidth_nor_sensors_enter_an_honest_bound():
    first = make_release(resolve("private-highway", {})).sensitivity
    more = {"bandwidth": 15, "corridor": {"fixed_sensors": [0, 7, 14]}}
    assert make_release(resolve("private-highway", more)).sensitivity == first
    private = {"privacy": {"boundary_inputs": "private"}}
    assert make_release(resolve("private-highway", private)).sensitivity == first


def test_the_papers_sensitivity_counts_released_boundary_segments():
    keywords = {"privacy": {"boundary_inputs": "private"}}
    fewer, more = (make_release(resolve("paper-highway", k)).sensitivity[0] for k in ({}, keywords))
    assert dict(fewer.assumptions)["n_sensors"] == 8
    assert dict(more.assumptions)["n_sensors"] == 8 + PAPER_HIGHWAY.n_boundaries


VOID = {
    "boundary_inputs": {"boundary_inputs": "true"},
    "speed_sensitivity": {"speed_release": "mean"},
}


@pytest.mark.parametrize(("reason", "privacy"), VOID.items(), ids=VOID)
def test_a_void_guarantee_is_warned_of_with_its_reason(reason, privacy):
    config = resolve("private-highway", {"privacy": privacy})
    with pytest.warns(UserWarning, match=f"no privacy is guaranteed. {reason}: ") as caught:
        warn_where_void(config)
    assert len(caught) == 1
    assert privacy_report(config).guarantee == "none"


@pytest.mark.parametrize(
    "privacy",
    ["paper", "corrected", "capped", {"boundary_inputs": "private", "unit": "horizon"}],
)
def test_no_warning_where_no_guarantee_is_requested_or_it_holds(privacy):
    # Warnings are errors in these tests.
    warn_where_void(resolve("private-highway", {"privacy": privacy}))


# --- queries: query_spans, price_levels, bandwidth_unit -------------------------------------------


SUMS = "tests.helpers:SumRelease"
KEYWORDS = {"privacy": SUMS, "query_spans": [1, 2, 4], "price_levels": [0.5, 1, 2]}


def test_a_configuration_survives_json_and_a_spec():
    config = resolve("short-highway", {**KEYWORDS, "bandwidth_unit": "sums"})
    assert config.query_spans == (1, 2, 4)
    assert config.price_levels == (0.5, 1.0, 2.0)
    plain = json.loads(json.dumps(dataclasses.asdict(config)))
    plain["privacy"]["preset"] = SUMS
    assert resolve("paper-highway", plain) == config
    settings = {"process_noise": [0.5, 0.25], "ukf": {"alpha": 1.0}}
    env = gym.make("dptse_env:dptse/ShortHighway-v0", estimator_settings=settings, **KEYWORDS)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config
    assert again.action_space == env.action_space


BAD_QUERIES = [
    ({"query_spans": []}, "query_spans must be ascending"),
    ({"query_spans": [2, 1]}, "query_spans must be ascending"),
    ({"query_spans": [1, 1]}, "query_spans must be ascending"),
    ({"query_spans": [1, 7]}, "query_spans must be ascending"),
    ({"query_spans": [0, 1]}, r"query_spans\[0\] must be"),
    ({"query_spans": [1.5]}, r"query_spans\[0\] must be"),
    ({"query_spans": 2}, "query_spans must be"),
    ({"price_levels": []}, "price_levels must be"),
    ({"price_levels": [1, 2, 1.0]}, "price_levels must be"),
    ({"price_levels": [0.01]}, r"price_levels\[0\] must be"),
    ({"price_levels": [1, 21]}, r"price_levels\[1\] must be"),
    ({"bandwidth_unit": "queries"}, "bandwidth_unit must be"),
    ({"query_spans": [3, 4]}, r"bandwidth must be in 3\.\.6"),
    ({"bandwidth": 7}, r"bandwidth must be in 1\.\.6"),
]


def test_bad_queries_are_named():
    for keywords, message in BAD_QUERIES:
        with pytest.raises(ValueError, match=f"^{message}"):
            resolve("short-highway", {"privacy": SumRelease, **keywords})


@pytest.mark.parametrize("key", ["query_spans", "price_levels"])
@pytest.mark.parametrize("preset", ["paper", "corrected", "capped"])
def test_release_models_of_single_segments_refuse_others(key, preset):
    message = rf"^{key} must be \(1,\) with the release model '{preset}', which releases no sums"
    with pytest.raises(ValueError, match=message):
        resolve("short-highway", {"privacy": preset, key: [1, 2]})
    assert resolve("short-highway", {"privacy": preset, key: [1]}).queries.are_plain


def test_mean_speeds_have_no_sums():
    keywords = {"privacy": MeanRelease, "query_spans": (1, 2)}
    with pytest.raises(ValueError, match=r"^query_spans must be \(1,\) where mean speeds are rel"):
        resolve("short-highway", keywords)
    levels = {"privacy": MeanRelease, "price_levels": (1.0, 2.0)}
    assert resolve("short-highway", levels).queries.n_options == 12


def test_too_many_options_are_refused():
    road = {"n_mainline": 200, "on_ramps": [], "off_ramps": [], "exit_shares": []}
    keywords = {
        "corridor": {**road, "demand": {"mainline": [[0, 1000]], "on_ramps": []}},
        "privacy": SumRelease, "incident": "none", "query_spans": list(range(1, 101)),
    }  # fmt: skip
    message = rf"^query_spans and price_levels must leave at most {MOST_OPTIONS} .*, got 15050$"
    with pytest.raises(ValueError, match=message):
        resolve("short-highway", keywords)
