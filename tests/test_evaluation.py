import gymnasium as gym
import numpy as np
import pytest

import dptse_env
from dptse_env.evaluation import evaluate
from dptse_env.schedules import (
    OBSERVATION_SCHEDULES,
    ORACLES,
    PROCESS_SCHEDULES,
    make_schedule,
)
from dptse_env.spaces.actions import ACTION_ENCODINGS
from tests.helpers import fast_and_slow

SHORT = "dptse_env:dptse/ShortHighway-v0"


def make(**keywords):
    return gym.make(SHORT, traffic_seeds="0:2", **keywords)


def make_batch(n=2, **keywords):
    return gym.make_vec(SHORT, num_envs=n, traffic_seeds="0:2", **keywords)


class Noting:
    """Keeps truth and estimates of every second."""

    def __init__(self, process):
        self.process, self.seconds = process, []

    def __call__(self):
        process = self.process
        truth = process.truth(np.arange(process.n_episodes))[:, :6]
        estimate = process.estimate
        self.seconds.append((truth, estimate.density[:, :6].copy(), estimate.speed[:, :6].copy()))

    def rows(self):
        return [{"n_seconds": len(self.seconds)}] * self.process.n_episodes


def test_the_baseline_is_evaluated_by_its_name():
    rows = dptse_env.evaluate(make(), "paper", seeds=range(2))
    assert [row["traffic_seed"] for row in rows] == [0, 1]
    assert rows == evaluate(make(), make_schedule("paper", make()), [0, 1])
    assert 0 < rows[0]["rmse_density"] < 60


def test_errors_are_pooled_over_segments_and_seconds():
    noted = []
    env = make()
    (row,) = evaluate(
        env, "paper", [1], 2, watchers=[lambda process: noted.append(Noting(process)) or noted[-1]]
    )
    assert row["n_seconds"] == 241
    counted = noted[0].seconds[61:]  # the first is the state at the reset
    truth, density, speed = (np.array(part)[:, 0] for part in zip(*counted, strict=True))
    occupied = truth[..., 0] > 0
    expected_density = np.sqrt(np.mean((density - truth[..., 0]) ** 2))
    expected_speed = np.sqrt(np.mean((speed - truth[..., 1])[occupied] ** 2))
    assert row["rmse_density"] == pytest.approx(expected_density)
    assert row["rmse_speed"] == pytest.approx(expected_speed)


def watched(release, values):
    """Return a function that releases, and keeps the values of all columns, queried or not."""

    def release_and_keep(request):
        measured = release(request)
        values.append(measured.values.copy())
        return measured

    return release_and_keep


def test_a_seed_gives_the_same_noise_under_every_policy_and_another_with_a_noise_seed():
    released = []
    for name, noise in (("static", 0), ("random", 0), ("static", 1)):
        env = make()
        release, values = env.unwrapped.process.release, []
        release.release = watched(release.release, values)
        evaluate(env, make_schedule(name, env, seed=0), [0], noise)
        released.append(np.array(values))
    np.testing.assert_array_equal(released[0], released[1])
    assert (released[0] != released[2]).any()


def assert_same(batch, singles):
    assert [row["traffic_seed"] for row in batch] == [row["traffic_seed"] for row in singles]
    for one, other in zip(batch, singles, strict=True):
        assert one == pytest.approx(other, rel=0, abs=1e-9)
    assert len({row["rmse_density"] for row in batch}) == len(batch)


SCHEDULES = [*OBSERVATION_SCHEDULES, *PROCESS_SCHEDULES, *ORACLES]
FAST = ("paper", "speed-front", "greedy-trace", "oracle-error")


@pytest.mark.parametrize("name", fast_and_slow(sorted({*SCHEDULES} - {"random", "all"}), FAST))
def test_a_batch_gives_the_rows_of_one_episode_after_another(name):
    keywords = {"horizon": 100, "estimator": "ekf"}
    seeds = (1, 0)
    assert_same(
        evaluate(make_batch(**keywords), name, seeds, 3),
        evaluate(make(**keywords), name, seeds, 3),
    )


def test_seeds_need_not_fill_the_last_batch():
    keywords = {"horizon": 80, "estimator": "random_walk"}
    env = gym.make_vec(SHORT, num_envs=2, traffic_seeds="0:3", **keywords)
    rows = evaluate(env, "paper", range(3))
    single = gym.make(SHORT, traffic_seeds="0:3", **keywords)
    assert_same(rows, evaluate(single, "paper", range(3)))


class Learned:
    """Stands in for a learned policy: its picks follow the observation and its own memory."""

    def __init__(self, env):
        self.interface = env.unwrapped.interface
        self.weights = np.random.default_rng(0).standard_normal(
            (self.interface.observations.space.shape[0], self.interface.n_mainline)
        )

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        batch = np.atleast_2d(observation)
        state = np.zeros((len(batch), self.interface.n_mainline)) if state is None else state
        state = np.where(np.asarray(episode_start)[:, None], 0.0, 0.9 * state) + np.tanh(
            batch @ self.weights
        )
        scores = state if deterministic else -state
        picked = np.zeros(scores.shape, dtype=bool)
        if "picked" in self.interface.observations.slices:
            picked = self.interface.observations.block(batch, "picked") > 0
        scores = np.where(picked, -np.inf, scores)
        best = np.argsort(-scores, axis=1)[:, : self.interface.bandwidth]
        wanted = np.zeros(scores.shape, dtype=bool)
        np.put_along_axis(wanted, best, True, axis=1)
        action = self.interface.actions.encode(wanted, np.zeros_like(wanted))
        return (action[0] if np.ndim(observation) == 1 else action), state


@pytest.mark.parametrize(
    ("action", "deterministic"),
    [(action, k % 2 == 0) for k, action in enumerate(ACTION_ENCODINGS)],
)
def test_a_batch_gives_the_rows_of_a_learned_policy(action, deterministic):
    keywords = {
        "action": action, "estimator": "random_walk", "privacy": "capped", "horizon": 100,
    }  # fmt: skip
    single, batch = make(**keywords), make_batch(**keywords)
    assert_same(
        evaluate(batch, Learned(batch), [1, 0], 4, deterministic=deterministic),
        evaluate(single, Learned(single), [1, 0], 4, deterministic=deterministic),
    )


def test_late_starts_drop_the_same_seconds_of_their_episodes():
    keywords = {"horizon": 100, "random_start": True, "estimator": "random_walk"}
    batch = make_batch(**keywords)
    rows = evaluate(batch, "paper", [0, 1], 3)
    assert len(set(batch.unwrapped.process.time.tolist())) > 1
    assert_same(rows, evaluate(make(**keywords), "paper", [0, 1], 3))


@pytest.mark.parametrize(
    ("env", "seeds", "message"),
    [
        (lambda: make(horizon=60), [0], "warm_up must be shorter than an episode, got 60"),
        (make, [], "seeds must be one or more"),
        (make, [0, 7], r"seeds must be among the environment's traffic_seeds, got \[7\]"),
        (lambda: make_batch(autoreset_mode="SameStep"), [0], "another autoreset_mode"),
        (lambda: gym.make("CartPole-v1"), [0], "environment of dptse_env, got CartPoleEnv"),
    ],
)
def test_what_cannot_be_evaluated_is_refused(env, seeds, message):
    with pytest.raises((ValueError, TypeError), match=message):
        evaluate(env(), "paper", seeds)
