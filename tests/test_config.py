import dataclasses
import json

import pytest

from dptse_env.config import (
    PRESETS,
    PROCESS_NOISE,
    TEST_SEEDS,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    parse_seeds,
    resolve,
)
from dptse_env.estimators import EstimatorSettings
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


def test_process_noise_follows_the_parameters_unless_given():
    for name, noise in PROCESS_NOISE.items():
        assert resolve("paper-highway", {"parameters": name}).settings().process_noise == noise
    given = {"process_noise": [0.5, 0.25]}
    config = resolve("paper-highway", {"estimator_settings": given})
    assert config.settings() == EstimatorSettings(process_noise=(0.5, 0.25))
    own = {"name": "mine", "free_flow_speed": 100.0, "jam_density": 350.0, "gamma": 1.0,
           "relaxation_time": 40.0}  # fmt: skip
    assert resolve("paper-highway", {"parameters": own}).settings() == EstimatorSettings()


@pytest.mark.parametrize(("text", "seeds"), [("3:6", (3, 4, 5)), ("7", (7,)), ("0:1", (0,))])
def test_seed_ranges(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "3:3", "4:2", "-1:2", "a:b", "1:2:3", " 0:1", "1:"])
def test_bad_seed_ranges_are_refused(text):
    with pytest.raises(ValueError, match=r"^seeds must "):
        parse_seeds(text)
