import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from agents.environments import make_config, unwrap
from agents.evaluation.episodes import (
    check_test_seeds,
    run_episode,
    run_episodes,
    seed_kind,
    watch_episode,
)
from dptse_env.schedules import (
    COVARIANCE_SCHEDULES,
    DEVIATION_SCHEDULES,
    OBSERVATION_SCHEDULES,
    ORACLES,
    make_schedule,
)
from dptse_env.spaces.actions import ACTION_ENCODINGS


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
        release, values = process.release.mechanism.release, []
        process.release.mechanism.release = lambda episodes, truth, f=release, v=values: (
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


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        ((2000,), "seeds must be 2 or more"),
        ((2000, 2000), "distinct"),
        ((0, 2000), r"test seeds, in 2000\.\.2999.*got 0"),
        ((1999, 2000), "got 1999"),
    ],
)
def test_seeds_that_are_no_test_seeds_are_refused(seeds, message):
    with pytest.raises(ValueError, match=message):
        check_test_seeds(seeds)


@pytest.mark.parametrize(
    ("seeds", "kind"),
    [
        (range(500, 502), "training"),
        ((1000, 1999), "validation"),
        ((2000, 2999), "test"),
        ((999, 1000), "mixed"),
        ((2999, 3000), "mixed"),
    ],
)
def test_seeds_are_named_by_their_range(seeds, kind):
    assert seed_kind(seeds) == kind


def test_an_environment_of_another_package_is_refused():
    with pytest.raises(TypeError, match="environment of dptse_env, got CartPoleEnv"):
        unwrap(gym.make("CartPole-v1"))
    assert make_config("dptse_env:dptse/ShortHighway-v0", {"bandwidth": 1}).bandwidth == 1


# A batch at once

PAIRS = {"traffic_seeds": (1, 0, 1), "seeds": (3, 9, 4)}


def make_batch(n=3, **keywords):
    return gym.make_vec(
        "dptse_env:dptse/ShortHighway-v0", num_envs=n, autoreset_mode="Disabled",
        traffic_seeds="0:2", **keywords,
    )  # fmt: skip


def one_by_one(make_policy, deterministic=True, **keywords):
    scores = []
    for traffic_seed, seed in zip(*PAIRS.values(), strict=True):
        env = make(**keywords)
        scores.append(
            run_episode(
                env, make_policy(env), traffic_seed=traffic_seed, seed=seed,
                deterministic=deterministic,
            )
        )  # fmt: skip
    return scores


def assert_same_scores(batch, singles):
    table = np.array(
        [[dataclasses.astuple(score) for score in scores] for scores in (batch, singles)]
    )
    np.testing.assert_allclose(table[0], table[1], rtol=0, atol=1e-9)
    assert len({score.rmse_density for score in batch}) == len(batch)


class Learned:
    """Stands in for a learned policy: its picks follow the observation and its own memory."""

    def __init__(self, env):
        env = env.unwrapped
        self.interface = env.interface
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


LOOKS_AHEAD = ("oracle-gain", "oracle-greedy", "oracle-brute-force")
LADDER = [
    pytest.param(name, marks=pytest.mark.slow) if name in LOOKS_AHEAD else name
    for name in (
        *OBSERVATION_SCHEDULES,
        *DEVIATION_SCHEDULES,
        *COVARIANCE_SCHEDULES,
        *ORACLES,
    )
    if name not in ("random", "all")
]


@pytest.mark.parametrize("name", LADDER)
def test_a_batch_scores_every_schedule_as_one_by_one(name):
    env = make_batch()
    batch = run_episodes(env, make_schedule(name, env), **PAIRS)
    assert [score.traffic_seed for score in batch] == [1, 0, 1]
    assert_same_scores(batch, one_by_one(lambda env: make_schedule(name, env)))


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("action", list(ACTION_ENCODINGS))
def test_a_batch_scores_a_learned_policy_as_one_by_one(action, deterministic):
    keywords = {"action": action, "estimator": "random_walk", "privacy": "capped"}
    env = make_batch(**keywords)
    batch = run_episodes(env, Learned(env), deterministic=deterministic, **PAIRS)
    assert_same_scores(batch, one_by_one(Learned, deterministic=deterministic, **keywords))


def test_a_batch_of_late_starts_drops_the_same_seconds():
    keywords = {"horizon": 100, "random_start": True, "estimator": "random_walk"}
    env = make_batch(**keywords)
    batch = run_episodes(env, make_schedule("paper", env), **PAIRS)
    assert len(set(env.process.time.tolist())) > 1
    assert_same_scores(batch, one_by_one(lambda env: make_schedule("paper", env), **keywords))


def test_a_batch_is_watched_every_second():
    env, times = make_batch(action="sequential", estimator="random_walk"), []
    run_episodes(
        env,
        make_schedule("paper", env),
        **PAIRS,
        on_second=lambda: times.append(env.process.time[1]),
    )
    assert times == list(range(241))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": (1, 2)}, "must be 3 each, one for each episode, got 3 and 2"),
        ({"traffic_seeds": (0, 1, 0, 1)}, "must be 3 each"),
        ({"traffic_seeds": (0, 1, 7)}, "traffic_seed must be one of"),
        ({"warm_up": 240}, "longer than the warm-up of 240 s"),
    ],
)
def test_a_batch_refuses_what_does_not_fit(changes, message):
    env = make_batch(estimator="random_walk")
    with pytest.raises(ValueError, match=message):
        run_episodes(env, make_schedule("paper", env), **{**PAIRS, **changes})


def test_a_batch_that_begins_again_by_itself_is_refused():
    env = gym.make_vec("dptse_env:dptse/ShortHighway-v0", num_envs=3, traffic_seeds="0:2")
    with pytest.raises(ValueError, match="autoreset_mode='Disabled', got 'NextStep'"):
        run_episodes(env, make_schedule("paper", env), **PAIRS)
