"""`evaluate`: rows of a batch are those of single episodes, on the same traffic and noise."""

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.evaluation import evaluate
from dptse_env.schedules import (
    OBSERVATION_SCHEDULES,
    ORACLES,
    PROCESS_SCHEDULES,
    make_schedule,
)
from tests.helpers import SHORT, assert_same, fast_and_slow, make_env

FAST_ONES = {"horizon": 100, "estimator": "random_walk"}


def make_vector(num_envs=2, **keywords):
    return gym.make_vec(SHORT, num_envs=num_envs, **{"traffic_seeds": "0:3", **keywords})


def assert_same_rows(policy, seeds, keywords):
    """Compare a batch's rows with those of one episode after another."""
    envs = make_vector(**keywords), make_env(**keywords)
    one, other = (evaluate(env, policy, seeds, 3) for env in envs)
    assert_same(one, other, tolerance=1e-9)
    assert [row["traffic_seed"] for row in one] == list(seeds)
    assert len({row["rmse_density"] for row in one}) == len(one)


SCHEDULES = {*OBSERVATION_SCHEDULES, *PROCESS_SCHEDULES, *ORACLES} - {"random", "all"}
FAST = ("shift-ahead", "speed-front", "greedy-trace", "oracle-error")


@pytest.mark.parametrize("name", fast_and_slow(sorted(SCHEDULES), FAST))
def test_a_batch_gives_the_rows_of_one_episode_after_another(name):
    assert_same_rows(name, (1, 0), {"horizon": 100, "estimator": "ekf"})


def test_seeds_need_not_fill_the_last_batch_and_episodes_may_start_late():
    late = {**FAST_ONES, "random_start": True, "action": "sequential"}
    assert_same_rows("shift-ahead", (0, 1, 2), late)


def oldest(observation):
    """Query the segment that was not observed for the longest time."""
    return np.eye(6, dtype=np.int8)[observation[..., 56:62].argmax(axis=-1)]


class Alone:
    def predict(self, observation):
        return oldest(observation)


class WithMode(Alone):
    def predict(self, observation, deterministic=False):
        assert deterministic
        return oldest(observation), None


class Bound(Alone):
    def __init__(self, env):
        assert env.interface.observations.slices["age"] == slice(56, 62)


OWN = [oldest, Alone(), Alone, WithMode, Bound, f"{__name__}:Alone", f"{__name__}:oldest"]


@pytest.mark.parametrize("policy", OWN)
def test_a_policy_may_be_a_function_or_a_class_of_ones_own(policy):
    """Its rows are those of the same choice with the signature of stable-baselines3."""

    class Whole:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return oldest(observation), None

    expected = evaluate(make_vector(3, **FAST_ONES), Whole(), [0, 1, 2])
    assert evaluate(make_vector(3, **FAST_ONES), policy, [0, 1, 2]) == expected
    assert_same(evaluate(make_env(**FAST_ONES), policy, [1]), expected[1:2], tolerance=1e-9)


@pytest.mark.parametrize("policy", [3, dict, {}])
def test_what_cannot_act_is_no_policy(policy):
    with pytest.raises(ValueError, match=r"must have predict\(\), or be a function of an obs"):
        evaluate(make_env(), policy, [0])


def test_a_policy_without_a_state_is_refused():
    class Stateless:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return oldest(observation)

    with pytest.raises(ValueError, match=r"policy\.predict\(\) must be an action and a state, got"):
        evaluate(make_env(), Stateless(), [0])


class Noting:
    """Keeps truth and estimates of every second."""

    def __init__(self, process, seconds):
        self.process, self.seconds = process, seconds

    def __call__(self):
        estimate = self.process.estimate
        truth = self.process.truth(np.arange(1))[:, :6]
        self.seconds.append((truth, estimate.density[:, :6].copy(), estimate.speed[:, :6].copy()))

    def rows(self):
        return [{"n_seconds": len(self.seconds)}]


def test_errors_are_pooled_over_segments_and_seconds():
    noted = []
    (row,) = evaluate(make_env(), "shift-ahead", [1], 2, watchers=[lambda p: Noting(p, noted)])
    assert row["n_seconds"] == 241
    counted = noted[61:]  # the first is the state at the reset
    truth, density, speed = (np.array(part)[:, 0] for part in zip(*counted, strict=True))
    occupied = truth[..., 0] > 0
    expected_density = np.sqrt(np.mean((density - truth[..., 0]) ** 2))
    expected_speed = np.sqrt(np.mean((speed - truth[..., 1])[occupied] ** 2))
    assert row["rmse_density"] == pytest.approx(expected_density)
    assert row["rmse_speed"] == pytest.approx(expected_speed)


def test_a_schedule_that_draws_chooses_the_same_with_the_same_noise_seed():
    given = {"num_envs": 2, "traffic_seeds": [2000, 2001]}
    first, same, other = (
        evaluate(gym.make_vec(SHORT, **given), "random", [2000, 2001], seed) for seed in (3, 3, 4)
    )
    assert first == same
    assert first != other


def test_a_seed_gives_the_same_noise_under_every_policy_and_another_with_a_noise_seed():
    released = []
    for name, noise in (("static", 0), ("random", 0), ("static", 1)):
        env, values = make_env(), []
        process, release = env.unwrapped.process, env.unwrapped.process.release.release

        def watched(request, release=release, values=values):
            measured = release(request)
            values.append(measured.values.copy())  # of all columns, queried or not
            return measured

        process.release.release = watched
        evaluate(env, make_schedule(name, env, seed=0), [0], noise)
        released.append(np.array(values))
    np.testing.assert_array_equal(released[0], released[1])
    assert (released[0] != released[2]).any()


@pytest.mark.parametrize(
    ("env", "seeds", "message"),
    [
        (lambda: make_env(horizon=60), [0], "warm_up must be shorter than an episode, got 60"),
        (make_env, [], "seeds must be one or more"),
        (make_env, "0:3", r"seeds must be traffic seeds, such as range\(.*, got '0:3'"),
        (make_env, 0, "seeds must be traffic seeds, .*, got 0"),
        (make_env, [0.5], "seeds must be an integer"),
        (make_env, [0, 7], r"environment's traffic_seeds \(make .* traffic_seeds=\[0, 7\]\), got "),
        (make_env, range(2000, 2032), r"traffic_seeds='2000:2032'\), got \[2000,"),
        (lambda: make_vector(autoreset_mode="SameStep"), [0], "another autoreset_mode"),
        (lambda: gym.make("CartPole-v1"), [0], "environment of dptse_env, got CartPoleEnv"),
        (lambda: SHORT, [0], "environment of dptse_env, got str"),
    ],
)
def test_what_cannot_be_evaluated_is_refused(env, seeds, message):
    with pytest.raises((ValueError, TypeError), match=message):
        evaluate(env(), "shift-ahead", seeds)
