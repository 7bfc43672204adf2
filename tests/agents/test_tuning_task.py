import dataclasses

import pytest

from agents.evaluation import run_episode
from agents.tuning_task import TuningTask, score_episode
from dptse_env.estimators import EstimatorSettings
from dptse_env.model import ARZParameters
from dptse_env.schedules import make_schedule

TASK = TuningTask(
    env="dptse_env:dptse/ShortHighway-v0",
    estimator="ekf",
    parameters="w99-3lane",
    privacy="paper",
    epsilon=1.0,
    delta=0.05,
    bandwidth=2,
    seeds="0:3",
)


def test_an_episode_is_what_an_evaluation_runs_with_another_noise_seed():
    settings = EstimatorSettings(process_noise=(0.02, 0.03))
    env = TASK.make(settings)
    assert env.unwrapped.config.settings() == settings
    schedule = make_schedule("paper", env)
    expected = run_episode(env, schedule, traffic_seed=1, seed=1_000_001)
    assert score_episode(TASK, settings, 1) == expected
    assert score_episode(TASK, EstimatorSettings(), 1) != expected


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "998:1002"}, "seeds must be training seeds, in 0:1000, got '998:1002'"),
        ({"noise_seed": 2000}, "noise_seed must be >= 3000, .*, got 2000"),
        ({"estimator": "open_loop"}, "'open_loop' has nothing to tune"),
        ({"parameters": ARZParameters("a/b", 100.0, 300.0, 1.0, 30.0)}, "part of a file name"),
    ],
)
def test_bad_tasks_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TASK, **changes)


def test_a_task_takes_parameters_of_its_own():
    own = ARZParameters("own", 100.0, 300.0, 1.0, 30.0)
    task = dataclasses.replace(TASK, parameters=own, bandwidth=None)
    assert task.name == "ekf-own-paper"
    assert task.config().parameters == own
    assert task.config().settings() == EstimatorSettings()
    assert task.identity()["bandwidth"] == 2
    with pytest.raises(ValueError, match="unknown schedule 'best'"):
        dataclasses.replace(TASK, schedule="best").config()
