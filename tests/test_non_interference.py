"""Nothing of the true traffic may reach a policy except through the mechanism.

With a mechanism that answers the same whatever the traffic, two episodes over different traffic
must look the same, bit by bit. The presets `paper` and `corrected` feed the estimator true boundary
inputs. That is their declared exception, so their test replaces them, and one test shows that it is
one. Each way for the truth to slip through is kept as a mutation that the comparison must catch.
"""

import itertools

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.estimators import ESTIMATORS
from dptse_env.process import TRUTH_INFO
from dptse_env.release.boundary import NominalBoundary
from dptse_env.release.noise import Noise
from dptse_env.schedules import (
    OBSERVATION_SCHEDULES,
    ORACLES,
    PROCESS_SCHEDULES,
    make_schedule,
)
from dptse_env.spaces.actions import ACTION_ENCODINGS
from tests.helpers import fast_and_slow

SEEDS = (0, 1)
START, STEPS = 250, 30
BLIND_SCHEDULES = sorted({*OBSERVATION_SCHEDULES, *PROCESS_SCHEDULES} - {"all"})


class ConstantNoise(Noise):
    """Releases the same values whatever the traffic: others for every second and segment."""

    def __init__(self, releases_flow):
        self._largest = 2000.0 if releases_flow else 80.0
        self._step = 0

    def reset(self, episodes, generators):
        self._step = 0

    def give(self, noise):
        pass  # its answers have no noise

    def added(self, episodes, values, sigma, unit):
        self._step += 1
        answer = np.random.default_rng(self._step).uniform(-0.2, 1.0, values.shape)
        return answer * [60.0, self._largest]


def transcript(env, traffic_seed, schedule=None):
    """Return all that a policy may see of an episode, and what the estimator makes of it."""
    start = min(START, env.unwrapped.config.last_start)
    options = {"traffic_seed": traffic_seed, "start": start}
    observation, info = env.reset(seed=7, options=options)
    env.action_space.seed(7)
    policy = make_schedule(schedule, env, seed=7) if schedule else None
    state, seen = None, [{"observation": observation, **public(env, info)}]
    truncated = False
    while not truncated:
        if policy is None:
            action = env.action_space.sample()
        else:
            action, state = policy.predict(observation, state, np.array([state is None]))
        observation, _, terminated, truncated, info = env.step(action)
        flags = {"observation": observation, "terminated": terminated, "truncated": truncated}
        seen.append(flags | public(env, info))
    return seen


def public(env, info):
    process = env.unwrapped.process
    estimate = {name: rows.copy() for name, rows in process.estimate._asdict().items()}
    masks = {"released": process.released.copy(), "age": process.age.copy()}
    shown = {key: value for key, value in info.items() if key not in TRUTH_INFO}
    terms = {
        name: getattr(process.release, name).copy()
        for name in ("prices", "centre", "sigmas")
        if hasattr(process.release, name)
    }
    return shown | estimate | masks | terms


def same(first, second):
    return all(
        one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)
        for one, other in zip(first, second, strict=True)
    )


def blind(env):
    """Cut the path through the mechanism; load both traffics first."""
    for seed in SEEDS:
        env.reset(seed=0, options={"traffic_seed": seed})
    process = env.unwrapped.process
    release = process.release
    release.noise = ConstantNoise(release.task.releases_flow)
    return env


def make_private(**keywords):
    keywords = {"horizon": STEPS, "random_start": True, **keywords}
    return gym.make("dptse_env:dptse/PrivateHighway-v0", traffic_seeds=SEEDS, **keywords)


def make_paper(**keywords):
    return gym.make("dptse_env:dptse/ShortHighway-v0", traffic_seeds=SEEDS, horizon=60, **keywords)


def with_nominal_boundary(env):
    """Take the declared exception of the paper's presets away."""
    process = env.unwrapped.process
    process.boundary = NominalBoundary(process.release.task, process.traffic, process.model)
    return env


def unlike(env):
    return not same(transcript(env, 0), transcript(env, 1))


# --- the guaranteed preset, as it is ------------------------------------------------------------


PAIRS = [
    ("mask", "ekf"), ("scores", "ukf"), ("slots", "enkf"), ("sequential", "mhe"),
    ("mask", "blend"), ("slots", "recurrent"),
]  # fmt: skip
EVERY_PAIR = list(itertools.product(ACTION_ENCODINGS, ESTIMATORS))


@pytest.mark.parametrize(("action", "estimator"), fast_and_slow(EVERY_PAIR, PAIRS))
def test_traffic_does_not_show(estimator, action):
    env = blind(make_private(estimator=estimator, action=action))
    first, second = transcript(env, 0), transcript(env, 1)
    assert same(first, second)
    assert not np.array_equal(first[1]["observation"], first[-1]["observation"])


SCHEDULES = [
    ("round-robin", "private"), ("stale-variance", "nominal"), ("speed-front", "private"),
    ("expected-reduction", "nominal"), ("greedy-trace", "private"),
]  # fmt: skip
EVERY_SCHEDULE = list(itertools.product(BLIND_SCHEDULES, ["nominal", "private"]))


@pytest.mark.parametrize(("schedule", "boundary"), fast_and_slow(EVERY_SCHEDULE, SCHEDULES))
def test_traffic_does_not_show_through_a_schedule(schedule, boundary):
    env = blind(make_private(privacy={"boundary_inputs": boundary}))
    assert same(transcript(env, 0, schedule), transcript(env, 1, schedule))


UNITS = [("ekf", "trip"), ("enkf", "horizon"), ("mhe", "event"), ("random_walk", "trip")]


@pytest.mark.parametrize(
    ("estimator", "unit"),
    fast_and_slow(itertools.product(ESTIMATORS, ["trip", "horizon", "event"]), UNITS),
)
def test_traffic_does_not_show_where_boundaries_are_released(estimator, unit):
    privacy = {"boundary_inputs": "private", "unit": unit, "cap": 3}
    env = blind(make_private(estimator=estimator, privacy=privacy))
    assert same(transcript(env, 0), transcript(env, 1))


def test_the_traffics_do_differ():
    env = make_private(truth_in_info=True)
    first, second = transcript(env, 0), transcript(env, 1)
    assert not same(first, second)
    process = env.unwrapped.process
    truths = [process.traffic.aggregates(np.array([s]), np.array([START])) for s in (0, 1)]
    assert not np.array_equal(*truths)


# --- mutations that must be caught --------------------------------------------------------------


def test_true_boundary_inputs_would_show():
    with pytest.warns(UserWarning, match="boundary_inputs"):
        env = make_private(privacy={"boundary_inputs": "true"})
    assert unlike(blind(env))


def test_an_emptiness_mask_would_show(monkeypatch):
    env = blind(make_private())
    process = env.unwrapped.process
    update = process.estimator.update

    def update_occupied(episodes, measured):
        occupied = process.truth(episodes)[..., 0] > 0
        update(episodes, measured._replace(observed=measured.observed & occupied))

    monkeypatch.setattr(process.estimator, "update", update_occupied)
    assert unlike(env)


def test_a_marker_for_empty_segments_would_show(monkeypatch):
    env = blind(make_private())
    noise = env.unwrapped.process.release.noise
    added = noise.added

    def marked(episodes, values, *declared):
        return np.where(values[..., :1] > 0, added(episodes, values, *declared), 0.0)

    monkeypatch.setattr(noise, "added", marked)
    assert unlike(env)


def test_an_initial_state_from_the_truth_would_show(monkeypatch):
    env = blind(make_private())
    process = env.unwrapped.process
    reset = process.estimator.reset

    def reset_to_truth(episodes, states, generators):
        truth = process.truth(episodes)
        reset(episodes, process.model.states(truth[..., 0] + 1.0, truth[..., 1]), generators)

    monkeypatch.setattr(process.estimator, "reset", reset_to_truth)
    assert unlike(env)


def test_realised_exposures_in_info_would_show(monkeypatch):
    """An account of what vehicles really spent is no public number."""
    env = blind(make_private())
    process = env.unwrapped.process
    info = process.info

    def telling(episode):
        paid = process.release.ledgers.paid[episode]
        return info(episode) | {"mu": float(paid.max(initial=0))}

    monkeypatch.setattr(process, "info", telling)
    assert unlike(env)


@pytest.mark.parametrize("oracle", sorted(ORACLES))
def test_an_oracle_shows(oracle):
    env = blind(make_private())
    assert not same(transcript(env, 0, oracle), transcript(env, 1, oracle))


# --- the presets of the paper, but for their declared exception ---------------------------------


@pytest.mark.parametrize(("action", "estimator"), fast_and_slow(EVERY_PAIR, PAIRS))
def test_the_papers_presets_show_traffic_through_their_boundary_only(estimator, action):
    env = with_nominal_boundary(blind(make_paper(estimator=estimator, action=action)))
    assert same(transcript(env, 0), transcript(env, 1))


@pytest.mark.parametrize(
    "schedule", fast_and_slow(BLIND_SCHEDULES, [name for name, _ in SCHEDULES])
)
def test_the_papers_presets_show_nothing_through_a_schedule(schedule):
    env = with_nominal_boundary(blind(make_paper()))
    assert same(transcript(env, 0, schedule), transcript(env, 1, schedule))


def test_the_papers_boundary_inputs_show():
    assert unlike(blind(make_paper()))
