import dataclasses

import gymnasium as gym
import pytest

from agents.search.tuning_task import score_episodes
from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.settings import load_settings
from dptse_env.evaluation import evaluate
from dptse_env.model import ARZParameters
from tests.agents.search.tasks import TASK
from tests.helpers import save_untrained


def make(cell):
    return gym.make(cell.env, traffic_seeds="0:3", **cell.all_keywords)


def test_episodes_are_what_an_evaluation_runs_with_other_noise_seeds():
    settings = EstimatorSettings(process_noise=(0.02, 0.03))
    env = make(TASK.cell(settings))
    assert env.unwrapped.config.settings() == settings
    expected = evaluate(env, "paper", (1, 0), 1_000_000)
    assert score_episodes(TASK, settings, (1, 0)) == expected
    assert score_episodes(TASK, EstimatorSettings(), (1, 0)) != expected


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "998:1002"}, "seeds must be training seeds, in 0:1000, got '998:1002'"),
        ({"noise_seed": 2000}, "noise_seed must be an integer in 1000000..1999000, got 2000"),
        ({"estimator": "open_loop"}, "'open_loop' has nothing to tune"),
        ({"keywords": {"estimator": "ukf"}}, r"keywords\.estimator must be left out"),
        ({"keywords": {"privacy": "paper"}}, r"keywords\.privacy must be a JSON object"),
        ({"parameters": ARZParameters("a/b", 100.0, 300.0, 1.0, 30.0)}, "part of a file name"),
    ],
)
def test_bad_tasks_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TASK, **changes)


def test_keywords_reach_the_environment_and_the_identity():
    keywords = {"reward": "speed", "privacy": {"epsilon": 2.0, "cap": 9}}
    task = dataclasses.replace(TASK, privacy="capped", keywords=keywords)
    config = task.config()
    assert config.reward == "speed"
    privacy = config.privacy
    assert (privacy.preset, privacy.epsilon, privacy.cap) == ("capped", 2.0, 9)
    other = dataclasses.replace(task, keywords={**keywords, "reward": "joint"})
    assert task.identity() != other.identity()
    with pytest.raises(ValueError, match="cargo"):
        dataclasses.replace(TASK, keywords={"cargo": 1}).config()


def test_a_task_takes_parameters_of_its_own():
    parameters = ARZParameters("mine", 100.0, 300.0, 1.0, 30.0)
    task = dataclasses.replace(TASK, parameters=parameters, keywords={})
    assert task.name == "ekf-mine-paper"
    assert task.config().parameters == parameters
    assert task.config().settings() == load_settings("ekf-w99-3lane-paper")
    assert task.identity()["bandwidth"] == 2
    with pytest.raises(ValueError, match=r"schedule must be one of .*, got 'best'"):
        dataclasses.replace(TASK, schedule="best").cell().check()


def test_settings_can_be_tuned_for_a_saved_policy(tmp_path):
    pytest.importorskip("torch")
    path = save_untrained(tmp_path / "policy.safetensors", seed=1)
    task = dataclasses.replace(TASK, schedule=str(path))
    settings = EstimatorSettings(process_noise=(0.02, 0.03))
    env = make(task.cell(settings))
    assert env.unwrapped.config.action == "slots"
    expected = evaluate(env, task.cell().load_policy(env), (1,), 1_000_000)
    assert score_episodes(task, settings, (1,)) == expected
    assert score_episodes(TASK, settings, (1,)) != expected
    other = dataclasses.replace(
        TASK, schedule=str(save_untrained(tmp_path / "other.safetensors", seed=2))
    )
    assert task.identity()["policy"] != other.identity()["policy"]  # by content, not by name
    with pytest.raises(ValueError, match="bandwidth is 2 for the policy and 3"):
        dataclasses.replace(task, keywords={"bandwidth": 3}).cell().check()
    with pytest.raises(FileNotFoundError, match=r"none\.zip"):
        dataclasses.replace(task, schedule="none.zip")
