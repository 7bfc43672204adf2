"""Nothing of the true traffic may reach a policy except through the mechanism.

With a mechanism that answers constants, two episodes over different traffic must look the same.
The presets of this release feed the estimator true boundary inputs. That is their declared
exception, so the tests replace them by constants, and one test shows that it is one.
"""

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.actions import ACTION_ENCODINGS
from dptse_env.estimators import ESTIMATORS
from dptse_env.process import TRUTH_INFO
from dptse_env.schedules import SCHEDULES, make_schedule

SEEDS = (0, 1)


class ConstantMechanism:
    """Releases the same values whatever the traffic."""

    sigma = np.array([20.0, 10.0])

    def reset(self, episodes, generators):
        pass

    def release(self, episodes, values):
        answer = np.empty_like(values)
        answer[..., 0] = 40.0 + np.arange(values.shape[1])
        answer[..., 1] = 80.0
        return answer


def transcript(env, traffic_seed, schedule=None, n_steps=60):
    """Return all that a policy may see of an episode."""
    observation, info = env.reset(seed=7, options={"traffic_seed": traffic_seed})
    env.action_space.seed(7)
    policy = make_schedule(schedule, env, seed=7) if schedule else None
    state, seen = None, [(observation, public(info))]
    for _ in range(n_steps):
        if policy is None:
            action = env.action_space.sample()
        else:
            action, state = policy.predict(observation, state, np.array([state is None]))
        observation, _, terminated, truncated, info = env.step(action)
        seen.append((observation, (terminated, truncated), public(info)))
    return seen


def public(info):
    return {
        key: value.tolist() if isinstance(value, np.ndarray) else value
        for key, value in info.items()
        if key not in TRUTH_INFO
    }


def blind(env, boundary=True):
    """Cut every path from the traffic to the policy, the declared exception included."""
    process = env.unwrapped.process
    for seed in SEEDS:
        env.reset(seed=0, options={"traffic_seed": seed})
    process.mechanism = ConstantMechanism()
    if boundary:
        process.boundary_inputs[:] = process.boundary_inputs[0, 100]
    return env


def same(first, second):
    return all(
        np.array_equal(a[0], b[0]) and a[1:] == b[1:] for a, b in zip(first, second, strict=True)
    )


def make(**keywords):
    return gym.make("dptse_env:dptse/ShortHighway-v0", traffic_seeds=SEEDS, **keywords)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("action", ACTION_ENCODINGS)
def test_traffic_does_not_show(estimator, action):
    env = blind(make(estimator=estimator, action=action))
    assert same(transcript(env, 0), transcript(env, 1))


@pytest.mark.parametrize("schedule", sorted(set(SCHEDULES) - {"all"}))
def test_traffic_does_not_show_through_a_schedule(schedule):
    env = blind(make())
    assert same(transcript(env, 0, schedule), transcript(env, 1, schedule))


def test_the_traffics_do_differ():
    env = make(truth_in_info=True)
    truths = [env.reset(seed=0, options={"traffic_seed": s, "start": 0}) for s in SEEDS]
    assert len(truths) == 2
    env = make()
    assert not same(transcript(env, 0), transcript(env, 1))


def test_true_boundary_inputs_show():
    env = blind(make(), boundary=False)
    assert not same(transcript(env, 0), transcript(env, 1))


def test_an_emptiness_mask_would_show(monkeypatch):
    env = blind(make())
    process = env.unwrapped.process
    update = process.estimator.update

    def update_occupied(episodes, observed, values, sigma):
        truth = process.truth(episodes)
        update(episodes, observed & (truth[..., 0] > 0), values, sigma)

    monkeypatch.setattr(process.estimator, "update", update_occupied)
    assert not same(transcript(env, 0), transcript(env, 1))


def test_an_initial_state_from_the_truth_would_show(monkeypatch):
    env = blind(make(horizon=100))
    process = env.unwrapped.process
    reset = process.estimator.reset

    def reset_to_truth(episodes, states, generators):
        truth = process.sensing.aggregates(process.slot[episodes], np.full(1, 100))
        reset(episodes, process.model.states(truth[..., 0] + 1.0, truth[..., 1]), generators)

    monkeypatch.setattr(process.estimator, "reset", reset_to_truth)
    assert not same(transcript(env, 0), transcript(env, 1))
