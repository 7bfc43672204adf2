"""An environment on a road of one's own, from a road file."""

import dataclasses
import warnings
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from dptse_env import RoadEstimator
from dptse_env.config import resolve
from dptse_env.estimators import ESTIMATORS
from dptse_env.estimators.tuned import load_settings, write_settings
from dptse_env.model import load_parameters
from dptse_env.model.parameters import write_parameters
from dptse_env.release import RELEASE_MODELS
from dptse_env.traffic import write_corridor
from tests.estimators.helpers import weights_settings
from tests.helpers import PRIVATE, UNEVEN, fast_and_slow, play

ID = PRIVATE
ROAD = UNEVEN.replaced(duration=120)
FAST = [
    {"estimator": "enkf", "privacy": "capped"},
    {"estimator": "mhe", "privacy": "paced"},
    {"estimator": "random_walk", "privacy": "corrected"},
    {"estimator": "recurrent"},
]
CASES = [
    *FAST,
    *({"estimator": name} for name in sorted({*ESTIMATORS} - {"recurrent"})),
    *({"privacy": name} for name in RELEASE_MODELS),
]


@pytest.fixture(scope="module")
def road_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("road") / "uneven.toml"
    write_corridor(path, ROAD, {"parameters": "w99-3lane", "bandwidth": 3, "horizon": 40})
    return str(path)


def make(road_file, **keywords):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return gym.make(ID, corridor=road_file, traffic_seeds=[0], **keywords)


@pytest.mark.parametrize("keywords", fast_and_slow(CASES, FAST), ids=str)
def test_every_estimator_and_release_model_runs_on_an_uneven_road(road_file, keywords):
    env = make(road_file, **keywords)
    seen = play(env, 40)
    assert all(observation in env.observation_space for observation, *_ in seen)
    assert np.isfinite([reward for _, reward, *_ in seen[1:]]).all()
    assert seen[-1][3]
    assert seen[-1][4]["rmse_density"] < 100.0


def test_weights_on_a_road_unlike_those_of_their_training_are_named(road_file):
    name = "estimator_settings.recurrent.weights"
    with pytest.warns(UserWarning, match=f"{name}: values measured or tuned on"):
        env = gym.make(ID, corridor=road_file, traffic_seeds=[0], estimator="recurrent")
    assert name in env.unwrapped.config.inherited
    assert gym.make(ID, estimator="recurrent").unwrapped.config.inherited == ()


def classes(share=0.1, speed=85.0, **lorry):
    """Keywords of a road with cars and lorries."""
    car = {"name": "car", "share": 1.0 - share}
    lorry = {"name": "lorry", "share": share, "length": 12.0, "largest_speed": speed, **lorry}
    return {"corridor": {"vehicle_classes": [car, lorry]}}


KNOWN = {
    "n_mainline": [6, 20], "segment_length": [0.1, 0.15], "speed_limit": [80.0, 110.0],
    "lanes": [1, 6], "span": [1, 2], "flows": [1, 1], "epsilon": [0.5, 20.0],
    "connected": [0.05, 1.0], "slow_share": [0.0, 0.2], "slow_speed": [80.0, 95.0],
    "headway": [0.8, 2.0],
}  # fmt: skip
"""Ranges on a card: all properties that one may name."""
WITHIN = {**classes(0.2), "epsilon": 20.0, "penetration": [0.05, 0.2], "query_spans": [1, 2]}
BEYOND = [
    ("n_mainline", {"corridor": {"n_mainline": 25}}, "25"),
    ("segment_length", {"corridor": {"segment_length": 0.2}}, "0.2"),
    ("speed_limit", {"corridor": {"speed_limit": 120}}, "120"),
    ("lanes", {"corridor": {"lanes": 7}}, "7"),
    ("span", {"query_spans": [1, 3]}, "3"),
    ("flows", {"privacy": "corrected"}, "0"),
    ("epsilon", {"epsilon": 100.0}, "100"),
    ("epsilon", {"epsilon": 0.1}, "0.1"),
    ("connected", {"penetration": 0.02}, "0.02"),
    ("connected", {"penetration": [0.02, 0.5]}, "0.02"),
    ("slow_share", classes(0.3), "0.3"),
    ("slow_speed", classes(speed=70.0), "70"),
    ("headway", {"corridor": {"drivers": {"headway": 0.5}}}, "0.5"),
    ("headway", classes(speed=None, drivers={"headway": 2.5}), "2.5"),
]


def told_beyond(make):
    """Return what a function makes, and its warnings of weights, each part with its semicolon."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made = make()
    return made, [f"{w.message};" for w in caught if "was trained on" in str(w.message)]


@pytest.mark.parametrize(("name", "keywords", "value"), BEYOND)
def test_what_lies_beyond_the_card_of_weights_is_told_once(name, keywords, value, tmp_path):
    """By environments, and by a stream, which has no queries."""
    settings = weights_settings(tmp_path, **KNOWN)
    given = {"estimator": "recurrent", "estimator_settings": settings, "traffic_seeds": [0]}
    env, (said,) = told_beyond(lambda: gym.make(ID, **given, **keywords))
    low, high = KNOWN[name]
    assert f"weights.safetensors was trained on {name} {low:g} to {high:g}, not {value};" in said
    assert "estimator_settings.recurrent.weights" in env.unwrapped.config.inherited
    env, told = told_beyond(lambda: gym.make(ID, **given, **WITHIN))
    assert (env.unwrapped.config.inherited, told) == ((), [])
    if "corridor" in keywords:
        road, known = env.unwrapped.config.corridor.replaced(**keywords["corridor"]), {**KNOWN}
        settings = weights_settings(tmp_path, **{**known, "flows": [0, 1]})
        make = partial(RoadEstimator, road, "recurrent", estimator_settings=settings)
        _, (said,) = told_beyond(make)
        assert f"{name} " in said
        assert f"not {value};" in said


def test_queries_of_a_road_file_do_not_lie_beyond_the_card_where_a_stream_has_none(tmp_path):
    known = ROAD.replaced(segment_length=0.1)
    write_corridor(tmp_path / "road.toml", known, {"epsilon": 0.01, "penetration": 0.01})
    settings = weights_settings(tmp_path, epsilon=[0.5, 20.0], connected=[0.05, 1.0])
    given = {"estimator": "recurrent", "estimator_settings": settings}
    road = str(tmp_path / "road.toml")
    assert len(told_beyond(partial(gym.make, ID, corridor=road, **given))[1]) == 1
    assert told_beyond(partial(RoadEstimator, road, **given))[1] == []


def test_what_does_not_suit_the_road_is_refused(road_file, tmp_path):
    road = tmp_path / "short.toml"
    write_corridor(road, ROAD.replaced(segment_length=(0.1,) * 7 + (0.04,)))
    message = r"short\.toml: corridor\.segment_length must be at least 0\.0567 km .*, got 0\.04 km"
    with pytest.raises(ValueError, match=message + ".* an estimator .*: random_walk, recurrent"):
        make(str(road), parameters="published")
    table = {"estimator": "mhe", "estimator_settings": {"mhe": {"horizon": 1000}}}
    write_corridor(road, ROAD, table)
    with pytest.raises(ValueError, match=r"short\.toml: environment\.estimator_settings\.mhe\.hor"):
        make(str(road))
    with pytest.raises(ValueError, match=r"^estimator_settings\.mhe\.horizon must be"):
        make(str(road), **table)
    write_corridor(road, ROAD.replaced(segment_length=(0.1,) * 7 + (0.04,)))
    # A random walk does not step the model.
    make(str(road), parameters="published", estimator="random_walk").reset(seed=0)


def test_the_folder_of_an_import_is_no_road_but_its_file_is(tmp_path):
    write_corridor(tmp_path / "road.toml", ROAD)
    for given in (tmp_path, str(tmp_path)):
        with pytest.raises(ValueError, match=r"^corridor must be a road file, such as road\.toml"):
            make(given)


def test_a_ramp_that_is_too_short_is_named_as_the_file_has_it(tmp_path):
    road = ROAD.replaced(ramp_length=0.05)
    write_corridor(tmp_path / "ramp.toml", road)
    with pytest.raises(
        ValueError, match=r"ramp\.toml: corridor\.ramp_length must be at least 0\.05"
    ):
        make(str(tmp_path / "ramp.toml"), parameters="published")


@pytest.mark.filterwarnings("ignore:corridor.average_dwell, parameters")
def test_a_default_bandwidth_is_limited_to_the_road_and_a_given_one_is_not(tmp_path):
    path = str(tmp_path / "two.toml")
    Path(path).write_text("n_mainline = 2\nduration = 60\n[demand]\nmainline = [[0, 900]]\n")
    with pytest.warns(UserWarning, match="bandwidth is 2, the number of mainline segments"):
        assert resolve("paper-highway", {"corridor": path}).bandwidth == 2
    with pytest.raises(ValueError, match=r"bandwidth must be in 1\.\.2, got 5"):
        resolve("paper-highway", {"corridor": path, "bandwidth": 5})


def test_a_configuration_names_what_is_not_of_the_road(tmp_path):
    path = tmp_path / "plain.toml"
    path.write_text("n_mainline = 5\nduration = 60\nlanes = 2\n[demand]\nmainline = [[0, 1500]]\n")
    with pytest.warns(UserWarning, match="on another road") as told:
        env = gym.make(ID, corridor=str(path), traffic_seeds=[0], bandwidth=2)
    inherited = {"corridor.average_dwell", "parameters", "estimator_settings"}
    assert {*env.unwrapped.config.inherited} == inherited
    assert "`dptse fit` fits" in str(told[0].message)
    path.write_text(
        f"average_dwell = 4.0\n{path.read_text()}[environment]\nparameters = 'published'"
    )
    with pytest.warns(UserWarning, match="^estimator_settings: ") as told:
        gym.make(ID, corridor=str(path), traffic_seeds=[0], bandwidth=2)
    assert "`dptse fit --tune` tunes" in str(told[0].message)
    assert "`dptse fit` fits" not in str(told[0].message)


MINE = {
    "name": "mine", "free_flow_speed": 130.0, "jam_density": 380.0, "gamma": 0.5,
    "relaxation_time": 40.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("source", "keywords", "name"),
    [
        (None, {}, "ekf-w99-3lane-paced"),
        (None, {"estimator": "random_walk", "privacy": "printed"}, "random_walk-w99-3lane-printed"),
        ("published", {"privacy": "corrected"}, "ekf-published-corrected"),
    ],
)
def test_parameters_of_ones_own_keep_the_settings_of_those_they_come_from(source, keywords, name):
    mine = {**MINE, "derived_from": source}
    with pytest.warns(UserWarning, match="^estimator_settings: .*or with other parameters"):
        env = gym.make(ID, parameters=mine, traffic_seeds=[0], **keywords)
    assert env.unwrapped.config.settings() == load_settings(name)
    assert env.unwrapped.config.inherited == ("estimator_settings",)


def test_a_set_of_ones_own_with_the_name_of_a_shipped_one_is_no_shipped_one():
    mine = {**MINE, "name": "w99-3lane"}
    with pytest.warns(UserWarning, match="^estimator_settings: .*or with other parameters"):
        env = gym.make(ID, parameters=mine, traffic_seeds=[0])
    assert env.unwrapped.config.inherited == ("estimator_settings",)


@pytest.mark.filterwarnings("error")
def test_parameters_of_ones_own_warn_of_nothing_where_settings_are_given_or_none_ship():
    given = gym.make(ID, parameters=MINE, estimator_settings={"initial_variance": 0.5})
    gym.make(ID, parameters=MINE, estimator="open_loop")
    tuned = load_settings("ekf-w99-3lane-paced")
    assert given.unwrapped.config.settings() == dataclasses.replace(tuned, initial_variance=0.5)
    with pytest.raises(
        ValueError, match="derived_from must be one of published, w99-3lane, got 'x'"
    ):
        gym.make(ID, parameters={**MINE, "derived_from": "x"})


def test_files_of_a_road_hold_for_the_estimator_that_they_were_tuned_for(tmp_path):
    arz = dataclasses.replace(load_parameters("w99-3lane"), name="mine")
    write_parameters(tmp_path / "arz.json", arz, {})
    write_settings(
        tmp_path / "ekf.json", estimator="ekf", parameters="mine", privacy="paced",
        settings={"demand": {}, "initial_variance": 0.1}, provenance={},
    )  # fmt: skip
    road = str(tmp_path / "tuned.toml")
    table = {"estimator_settings": "ekf.json", "parameters": "arz.json", "bandwidth": 2}
    write_corridor(road, ROAD, table)

    def config(**keywords):
        return gym.make(ID, corridor=road, **keywords).unwrapped.config

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a complete file warns of nothing
        whole = config()
    assert whole.inherited == ()
    assert whole.parameters == arz
    assert (whole.settings().initial_variance, whole.settings().demand is None) == (0.1, False)
    with pytest.warns(UserWarning, match="^estimator_settings: values measured or tuned on"):
        assert config(estimator="random_walk").settings_name == "random_walk-w99-3lane-paced"
    assert config(estimator="open_loop").settings().demand is None
    with pytest.raises(ValueError, match="demand must be None for 'random_walk'"):
        config(estimator="random_walk", estimator_settings=str(tmp_path / "ekf.json"))
