"""An environment on a road of one's own, from a road file."""

import dataclasses
import json
import warnings

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.estimators import ESTIMATORS, EstimatorSettings
from dptse_env.estimators.ekf import count_variance
from dptse_env.estimators.settings import load_settings, write_settings
from dptse_env.model import ARZModel, load_parameters
from dptse_env.release import RELEASE_MODELS
from dptse_env.schedules import make_schedule
from dptse_env.traffic import write_corridor
from tests.helpers import UNEVEN, fast_and_slow

ID = "dptse_env:dptse/PrivateHighway-v1"
ROAD = dataclasses.replace(UNEVEN, duration=120)


@pytest.fixture(scope="module")
def road_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("road") / "uneven.toml"
    write_corridor(path, ROAD, {"parameters": "w99-3lane", "bandwidth": 3, "horizon": 40})
    return str(path)


def make(road_file, **keywords):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return gym.make(ID, corridor=road_file, traffic_seeds=[0], **keywords)


def play(env, steps=40):
    observation, info = env.reset(seed=0)
    rewards = []
    for _ in range(steps):
        assert env.observation_space.contains(observation)
        observation, reward, _, truncated, info = env.step(env.action_space.sample())
        rewards.append(reward)
    assert truncated
    return np.array(rewards), info


@pytest.mark.parametrize(
    "estimator",
    fast_and_slow(sorted(set(ESTIMATORS) - {"recurrent"}), ["ekf", "enkf", "mhe", "random_walk"]),
)
def test_every_estimator_runs_on_an_uneven_road(road_file, estimator):
    env = make(road_file, estimator=estimator)
    rewards, info = play(env)
    assert np.isfinite(rewards).all()
    assert info["rmse_density"] < 100.0


@pytest.mark.parametrize("estimator", ["ekf", "mhe"])
def test_both_backends_agree_on_an_uneven_road(road_file, estimator):
    found = []
    for backend in ("compiled", "reference"):
        settings = {"count_noise": 2.0}
        env = make(road_file, estimator=estimator, backend=backend, estimator_settings=settings)
        env.action_space.seed(0)
        found.append(play(env)[0])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-4)


def test_a_count_scatters_less_in_density_on_a_longer_segment():
    model = ARZModel(ROAD, load_parameters("w99-3lane"))
    variance = count_variance(model, EstimatorSettings(count_noise=2.0))
    np.testing.assert_allclose(
        variance * ROAD.segment_lengths, 2.0 / model.density_scale**2, rtol=1e-12
    )


@pytest.mark.parametrize("preset", RELEASE_MODELS)
def test_every_release_model_runs_on_an_uneven_road(road_file, preset):
    rewards, _ = play(make(road_file, privacy=preset))
    assert np.isfinite(rewards).all()


def test_a_recurrent_network_is_refused_outside_its_ranges_and_runs_if_told_so(road_file):
    with pytest.raises(ValueError, match="were trained on"):
        make(road_file, estimator="recurrent")
    settings = {"recurrent": {"outside": True}}
    rewards, _ = play(make(road_file, estimator="recurrent", estimator_settings=settings))
    assert np.isfinite(rewards).all()


def test_schedules_run_on_an_uneven_road(road_file):
    env = make(road_file)
    policy = make_schedule("largest-deviation", env)
    observation, _ = env.reset(seed=0)
    state, start = None, np.ones(1, dtype=bool)
    for _ in range(20):
        action, state = policy.predict(observation, state, start, True)
        observation, reward, *_ = env.step(action)
        start = np.zeros(1, dtype=bool)
    assert np.isfinite(reward)


def test_the_time_step_must_suit_the_shortest_segment_where_the_model_is_stepped(tmp_path):
    lengths = (0.1,) * 7 + (0.04,)
    road = tmp_path / "short.toml"
    write_corridor(road, dataclasses.replace(ROAD, segment_length=lengths))
    message = r"^corridor\.segment_length must be longer for the parameters 'paper': on 0\.04 km"
    with pytest.raises(ValueError, match=message):
        make(str(road), parameters="paper")
    make(str(road), parameters="paper", estimator="random_walk").reset(seed=0)


def test_a_reset_names_what_is_not_of_the_road(tmp_path):
    path = tmp_path / "plain.toml"
    path.write_text("n_mainline = 5\nduration = 60\nlanes = 2\n[demand]\nmainline = [[0, 1500]]\n")
    with pytest.warns(UserWarning, match="on another road"):
        env = gym.make(ID, corridor=str(path), traffic_seeds=[0], bandwidth=2)
    _, info = env.reset(seed=0)
    assert set(info["inherited"]) == {
        "corridor.average_dwell", "parameters", "estimator_settings",
    }  # fmt: skip
    assert json.dumps(info["inherited"])


MINE = {
    "name": "mine", "free_flow_speed": 130.0, "jam_density": 380.0, "gamma": 0.5,
    "relaxation_time": 40.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("keywords", "name"),
    [
        ({}, "ekf-w99-3lane-paced"),
        ({"estimator": "random_walk", "privacy": "paper"}, "random_walk-w99-3lane-paper"),
        ({"derived_from": "paper", "privacy": "corrected"}, "ekf-paper-corrected"),
    ],
)
def test_parameters_of_ones_own_keep_the_settings_of_those_they_come_from(keywords, name):
    mine = {**MINE, "derived_from": keywords.pop("derived_from", None)}
    with pytest.warns(UserWarning, match="^estimator_settings: .*or with other parameters"):
        env = gym.make(ID, parameters=mine, traffic_seeds=[0], **keywords)
    assert env.unwrapped.config.settings() == load_settings(name)
    assert env.reset(seed=0)[1]["inherited"] == ["estimator_settings"]


def test_parameters_of_ones_own_warn_of_nothing_where_settings_are_given_or_none_ship():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        given = gym.make(ID, parameters=MINE, estimator_settings={"count_noise": 0.5})
        gym.make(ID, parameters=MINE, estimator="open_loop")
    tuned = load_settings("ekf-w99-3lane-paced")
    assert given.unwrapped.config.settings() == dataclasses.replace(tuned, count_noise=0.5)
    with pytest.raises(ValueError, match="derived_from must be one of paper, w99-3lane, got 'x'"):
        gym.make(ID, parameters={**MINE, "derived_from": "x"})


def test_settings_of_a_road_hold_for_the_estimator_that_they_were_tuned_for(tmp_path):
    tuned = {"demand": {}, "count_noise": 0.1}
    write_settings(
        tmp_path / "ekf.json", estimator="ekf", parameters="w99-3lane", privacy="paced",
        settings=tuned, provenance={},
    )  # fmt: skip
    road = tmp_path / "tuned.toml"
    table = {"estimator_settings": "ekf.json", "parameters": "w99-3lane", "bandwidth": 2}
    write_corridor(road, ROAD, table)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        config = gym.make(ID, corridor=str(road)).unwrapped.config
    assert config.settings().demand is not None
    with pytest.warns(UserWarning, match="^estimator_settings: values measured or tuned on"):
        walk = gym.make(ID, corridor=str(road), estimator="random_walk").unwrapped.config
    assert walk.settings_name == "random_walk-w99-3lane-paced"
    config = gym.make(ID, corridor=str(road), estimator="open_loop").unwrapped.config
    assert config.settings().demand is None
    with pytest.raises(ValueError, match="demand must be None for 'random_walk'"):
        gym.make(
            ID, corridor=str(road), estimator="random_walk",
            estimator_settings=str(tmp_path / "ekf.json"),
        )  # fmt: skip
