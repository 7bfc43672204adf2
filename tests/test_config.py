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
from dptse_env.estimators.tuning import available_settings, load_settings
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY, DemandDistribution, IncidentDistribution


def test_seeds_of_training_validation_and_test_are_disjoint():
    assert not set(TRAINING_SEEDS) & set(VALIDATION_SEEDS)
    assert not set(TRAINING_SEEDS) & set(TEST_SEEDS)
    assert not set(VALIDATION_SEEDS) & set(TEST_SEEDS)
    for preset in PRESETS.values():
        assert set(preset.traffic_seeds) <= set(TRAINING_SEEDS)


def test_presets_are_as_in_the_paper():
    config = PRESETS["paper-highway"]
    assert (config.estimator, config.bandwidth, config.parameters) == ("ekf", 5, "paper")
    assert (config.privacy.preset, config.privacy.epsilon, config.privacy.delta) == (
        "paper", 1.0, 0.05,
    )  # fmt: skip
    assert config.horizon_steps == 700
    assert config.sensitivity().releases[0].bound == pytest.approx(
        10 * (2 * 8 * PAPER_HIGHWAY.average_dwell) ** 0.5
    )


def test_the_noise_does_not_depend_on_the_model():
    first, second = (
        resolve("paper-highway", {"parameters": name}).sensitivity()
        for name in ("paper", "w99-3lane")
    )
    assert first == second


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
    own = {"name": "mine", "free_flow_speed": 100.0, "jam_density": 350.0, "gamma": 1.0,
           "relaxation_time": 40.0}  # fmt: skip
    assert resolve("paper-highway", {"parameters": own}).settings() == EstimatorSettings()


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
    given = EstimatorSettings(noise_scale=2.0)
    keywords["estimator_settings"] = given
    assert resolve("paper-highway", keywords).settings() is given
    for bad, message in (
        ({"noise": 1.0}, r"^estimator_settings\.noise is unknown; allowed: "),
        ({"mhe": {"horizon": 0}}, r"^estimator_settings\.mhe\.horizon must be an integer >= 1"),
        (3, r"^estimator_settings must be "),
    ):
        with pytest.raises(ValueError, match=message):
            resolve("paper-highway", {"estimator_settings": bad})


@pytest.mark.parametrize(
    "settings", ["ekf-paper-paper", {"process_noise": [0.5, 0.25], "ukf": {"alpha": 1.0}}]
)
def test_settings_survive_the_spec_of_an_environment(settings):
    env = gym.make("dptse_env:dptse/PaperHighway-v0", estimator_settings=settings)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    config, other = env.unwrapped.config, again.unwrapped.config
    assert other == config
    plain = json.loads(json.dumps(dataclasses.asdict(config)))
    assert resolve("short-highway", plain) == config


@pytest.mark.parametrize(("text", "seeds"), [("3:6", (3, 4, 5)), ("7", (7,)), ("0:1", (0,))])
def test_seed_ranges(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "3:3", "4:2", "-1:2", "a:b", "1:2:3", " 0:1", "1:"])
def test_bad_seed_ranges_are_refused(text):
    with pytest.raises(ValueError, match=r"^seeds must "):
        parse_seeds(text)
