"""A batch gives the numbers of as many scalar environments, whatever is configured."""

import threading
import time

import numpy as np
import pytest

from dptse_env.estimators import ESTIMATORS
from dptse_env.registration import ENVIRONMENTS
from dptse_env.utils.threads import SMALLEST_BLOCK
from tests.cases import fast_and_slow

from .vectors import COUNTED, assert_same, briefly, lock_step, short


@pytest.mark.parametrize(
    ("estimator", "action", "privacy"),
    [
        ("ekf", "mask", COUNTED),
        ("ukf", "scores", "paper"),
        ("enkf", "slots", "paper"),
        ("mhe", "sequential", "paper"),
        ("blend", "mask", COUNTED),
        ("recurrent", "slots", "paper"),
    ],
)
def test_a_batch_is_so_many_scalar_environments(estimator, action, privacy):
    keywords = {"estimator": estimator, "action": action, "privacy": privacy}
    lock_step({**keywords, "truth_in_info": True}, n_steps=17)


LONG = [name for name in ENVIRONMENTS if "Long" in name]


@pytest.mark.parametrize("env_id", fast_and_slow(ENVIRONMENTS, set(ENVIRONMENTS) - set(LONG)))
def test_every_id_is_so_many_scalar_environments(env_id):
    lock_step({"traffic_seeds": "0:2", **briefly(env_id)}, n_steps=8, env_id=f"dptse_env:{env_id}")


@pytest.mark.parametrize(
    ("mode", "truth_in_info"), [("NextStep", False), ("NextStep", True), ("SameStep", True)]
)
def test_autoreset_is_that_of_gymnasium(mode, truth_in_info):
    keywords = {"truth_in_info": truth_in_info, "privacy": COUNTED}
    lock_step(keywords, n_steps=20, autoreset_mode=mode)


@pytest.mark.parametrize(
    "estimator", fast_and_slow(ESTIMATORS, ["ekf", "enkf", "mhe", "recurrent"])
)
def test_threads_change_nothing(estimator):
    n = 3 * SMALLEST_BLOCK
    one, two = (short(n, estimator=estimator, threads=threads) for threads in (1, 2))
    assert_same(one.reset(seed=5), two.reset(seed=5), tolerance=0)
    one.action_space.seed(1)
    for _ in range(8):
        actions = one.action_space.sample()
        assert_same(one.step(actions), two.step(actions), tolerance=0)


@pytest.mark.parametrize(
    ("estimator", "threads_given", "n_names"),
    [("ekf", 1, 1), ("ekf", 2, 2), ("enkf", 2, 2), ("random_walk", 2, 1)],
)
def test_compiled_estimators_work_on_so_many_threads(
    estimator, threads_given, n_names, monkeypatch
):
    env = short(2 * SMALLEST_BLOCK, estimator=estimator, threads=threads_given)
    env.reset(seed=0)
    names, predict = set(), env.process.estimator.predict

    def watched(episodes, inputs):
        names.add(threading.current_thread().name)
        time.sleep(0.02)
        predict(episodes, inputs)

    monkeypatch.setattr(env.process.estimator, "predict", watched)
    env.step(env.action_space.sample())
    assert len(names) == n_names


def test_traffic_and_start_one_by_one():
    env, single = short(truth_in_info=True), short(1, truth_in_info=True)
    options = {"traffic_seed": [2, 0, 2], "start": np.array([100, 3, 0])}
    observation, infos = env.reset(seed=4, options=options)
    for episode in range(3):
        own = {key: int(values[episode]) for key, values in options.items()}
        alone, info = single.reset(seed=4 + episode, options=own)
        np.testing.assert_array_equal(observation[episode], alone[0])
        for key in ("traffic_seed", "time"):
            assert infos["truth"][key][episode] == info["truth"][key][0]
    options["reset_mask"] = np.array([False, True, True])
    options["start"] = [999, 7, 8]  # of an episode that goes on, and so never looked at
    assert env.reset(options=options)[1]["truth"]["time"].tolist() == [0, 7, 8]
