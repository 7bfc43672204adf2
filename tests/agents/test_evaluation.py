import gymnasium as gym
import numpy as np
import pytest

from agents.evaluation import run_episode, watch_episode
from dptse_env.schedules import make_schedule


def make(**keywords):
    return gym.make("dptse_env:dptse/ShortHighway-v0", traffic_seeds="0:2", **keywords)


def test_errors_are_pooled_over_segments_and_seconds():
    env = make(truth_in_info=True)
    process = env.unwrapped.process
    pairs = []

    def note():
        truth = process.truth(np.arange(1))[0, :6]
        pairs.append((truth, process.estimate.density[0, :6], process.estimate.speed[0, :6]))

    schedule = make_schedule("paper", env)
    score = run_episode(env, schedule, traffic_seed=1, seed=3, on_second=note)
    assert len(pairs) == 241
    counted = pairs[61:]  # the state at the reset is not an estimate
    truth, density, speed = (np.array(part) for part in zip(*counted, strict=True))
    occupied = truth[..., 0] > 0
    expected_density = np.sqrt(np.mean((density - truth[..., 0]) ** 2))
    expected_speed = np.sqrt(np.mean((speed - truth[..., 1])[occupied] ** 2))
    assert score.traffic_seed == 1
    assert score.rmse_density == pytest.approx(expected_density)
    assert score.rmse_speed == pytest.approx(expected_speed)


def test_policies_meet_the_same_traffic_and_the_same_noise():
    released = []
    for name in ("static", "random"):
        env = make()
        process = env.unwrapped.process
        release, values = process.mechanism.release, []
        process.mechanism.release = lambda episodes, truth, f=release, v=values: (
            v.append(f(episodes, truth)) or v[-1]
        )
        run_episode(env, make_schedule(name, env, seed=0), traffic_seed=0, seed=1)
        released.append(np.array(values))
    np.testing.assert_array_equal(*released)


@pytest.mark.parametrize("action", ["mask", "sequential"])
def test_a_sequential_episode_scores_the_same(action):
    scores = []
    for kind in ("mask", action):
        env = make(action=kind)
        scores.append(run_episode(env, make_schedule("oldest-first", env), traffic_seed=0, seed=1))
    assert scores[0] == scores[1]


def test_an_episode_within_the_warm_up_has_no_score():
    env = make(horizon=30)
    with pytest.raises(ValueError, match="longer than the warm-up of 60 s"):
        run_episode(env, make_schedule("paper", env), traffic_seed=0, seed=1)


def test_watching_changes_nothing():
    env = make()
    schedule = make_schedule("round-robin", env)
    watched, history = watch_episode(env, schedule, traffic_seed=0, seed=1)
    assert watched == run_episode(env, schedule, traffic_seed=0, seed=1)
    assert len(history.truth) == len(history.queried) == 241
    assert np.array(history.queried)[1:].sum(axis=1).tolist() == [2] * 240
