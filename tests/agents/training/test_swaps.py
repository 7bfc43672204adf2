"""Gains of swaps beside episodes that are run apart, and the moves of scores that they make."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import torch

from agents.seeds import training_seed
from agents.training.settings import parse_algorithm
from agents.training.swaps import LARGEST_GAIN, Swaps, raise_scores, try_swaps
from dptse_env.config import resolve
from dptse_env.sb3 import RoadPolicy
from tests.helpers import SHORT

SECONDS, TRIALS, HORIZON, SEED = 6, 2, 40, 1
TUNED = parse_algorithm("plackett-luce", 6).swaps
FEW = replace(TUNED, seconds=SECONDS, trials=TRIALS)
PRIVACIES = {
    "capped": {"preset": "capped", "cap": 20, "boundary_inputs": "private"},
    "paced": {"preset": "paced", "boundary_inputs": "private"},
}


class Wandering:
    """Queries at random, and remembers observations and queries."""

    def __init__(self):
        self.generator = np.random.default_rng(3)
        self.seen, self.queried = [], []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert not deterministic
        self.seen.append(observation.copy())
        self.queried.append(self.generator.permuted(np.tile(np.arange(6), (3, 1)), axis=1)[:, :2])
        return self.queried[-1], state


class Seeded:
    """An environment that remembers the seeds of its episodes."""

    def __init__(self, privacy):
        self.env = gym.make_vec(
            SHORT, num_envs=3, action="slots", bandwidth=2, autoreset_mode="Disabled",
            traffic_seeds="0:3", privacy=privacy, horizon=HORIZON,
        )  # fmt: skip
        self.seeds = None

    def __getattr__(self, name):
        return getattr(self.env, name)

    def reset(self, *, seed):
        self.seeds = seed
        return self.env.reset(seed=seed)


def tried(privacy, index=0):
    policy, env = Wandering(), Seeded(privacy)
    return policy, try_swaps(policy, env, FEW, index, SEED), env.seeds


@pytest.fixture(scope="module", params=PRIVACIES)
def round_of_swaps(request):
    return PRIVACIES[request.param], *tried(PRIVACIES[request.param])


def first_of(policy, swaps):
    """Return the second of the first states."""
    return next(k for k, seen in enumerate(policy.seen) if (seen == swaps.observations[:3]).all())


def test_swaps_are_tried_all_along_and_the_episodes_go_on_as_without(round_of_swaps):
    privacy, policy, swaps, seeds = round_of_swaps
    first = first_of(policy, swaps)
    assert HORIZON // 4 <= first < HORIZON // 4 + SECONDS
    times = range(first, HORIZON - SECONDS + 1, SECONDS)
    np.testing.assert_array_equal(
        swaps.observations, np.concatenate([policy.seen[t] for t in times])
    )
    env = Seeded(privacy)
    observation, _ = env.reset(seed=seeds)
    for seen, action in zip(policy.seen, policy.queried, strict=True):
        np.testing.assert_array_equal(seen, observation)
        observation, *_ = env.step(action)


def test_a_swap_replaces_a_queried_segment_by_one_that_was_not(round_of_swaps):
    _, policy, swaps, _ = round_of_swaps
    first = first_of(policy, swaps)
    assert np.bincount(swaps.state).tolist() == [TRIALS] * len(swaps.observations)
    for state, added, dropped in zip(swaps.state, swaps.added, swaps.dropped, strict=True):
        queried = policy.queried[first + SECONDS * (state // 3)][state % 3]
        assert dropped in queried
        assert added not in queried
    assert set(swaps.added) == set(swaps.dropped) == set(range(6))


def test_gains_are_those_of_episodes_run_apart(round_of_swaps):
    privacy, policy, swaps, seeds = round_of_swaps
    first = first_of(policy, swaps)
    # Signs of noise are drawn as the round draws them: after the choice of seconds.
    generator = np.random.default_rng([SEED, 0])
    generator.integers(SECONDS)

    def run(swapped, sign, signs):
        """Return rewards and spent budgets of episodes from their reset on; no forks."""
        env = Seeded(privacy)
        env.reset(seed=seeds)
        for action in policy.queried[:first]:
            env.step(action)
        if signs is None:
            shape = (3, env.process.release.task.n_channels, 2)
            signs = generator.choice([-1.0, 1.0], size=shape)
        env.process.release.give_noise(sign * signs)
        query = policy.queried[first].copy()
        for episode, added, dropped in swapped:
            query[episode][query[episode] == dropped] = added
        total = np.zeros(3)
        for action in [query, *policy.queried[first + 1 : first + SECONDS]]:
            total += env.step(action)[1]
        return np.array([total, env.process.release.budgets_spent(np.arange(3))]), signs

    signs = run((), 1.0, None)[1]

    def mean(swapped=()):
        return (run(swapped, 1.0, signs)[0] + run(swapped, -1.0, signs)[0]) / 2.0

    plain = mean()
    np.testing.assert_allclose(swaps.error[:3], -plain[0] / SECONDS, atol=1e-12)
    for trial in range(TRIALS):
        rows = slice(3 * trial, 3 * trial + 3)
        swapped = zip(swaps.state[rows], swaps.added[rows], swaps.dropped[rows], strict=True)
        expected = mean(list(swapped)) - plain
        np.testing.assert_allclose(swaps.gain[rows], expected[0], atol=1e-12)
        np.testing.assert_allclose(swaps.spent[rows], expected[1], atol=1e-12)
    assert np.abs(swaps.gain[: 3 * TRIALS]).min() > 1e-6
    assert np.abs(swaps.spent).max() > 0


def test_every_round_tries_other_swaps_in_other_episodes(round_of_swaps):
    privacy, _, swaps, seeds = round_of_swaps
    np.testing.assert_array_equal(tried(privacy)[1].gain, swaps.gain)
    _, other, other_seeds = tried(privacy, index=1)
    assert not np.array_equal(other.added[:30], swaps.added[:30])
    assert len({*seeds, *other_seeds}) == 6
    # Neither those of the regression nor those of another training.
    assert training_seed(SEED) + 1000 < min(seeds + other_seeds)
    assert max(seeds + other_seeds) < training_seed(SEED + 1)


# --- the fit --------------------------------------------------------------------------------------

STEP = 3.0
FIT = replace(TUNED, price=0.01, batches=400, batch_size=256, rate=1e-2)


@pytest.fixture
def policy():
    torch.manual_seed(0)
    config = resolve("short-plain", {"action": "slots", "bandwidth": 2})
    return RoadPolicy.from_config(config)


def inputs_of(policy, observations):
    """The inputs of the segments, shape (m, 6, n_inputs)."""
    return policy.features(torch.from_numpy(observations)).permute(2, 0, 1).numpy()


def planted(policy, gain=None, spent=None, n_states=300, trials=20):
    """Swaps whose gain is that of their segments, ``gain(inputs)`` of shape (m, 6), and noise."""
    generator = np.random.default_rng(0)
    size = policy.observation_space.shape[0]
    seen = generator.uniform(0.0, 0.3, size=(n_states, size)).astype(np.float32)
    state = np.repeat(np.arange(n_states), trials)
    pairs = generator.permuted(np.tile(np.arange(6), (len(state), 1)), axis=1)
    added, dropped = pairs[:, 0], pairs[:, 1]

    def difference(of):
        if of is None:
            return np.zeros(len(state))
        values = of(inputs_of(policy, seen))
        return values[state, added] - values[state, dropped]

    noise = generator.normal(0.0, 0.02, len(state))
    error = np.full(n_states, 0.1)
    gains = 0.1 * (difference(gain) + noise)
    return Swaps(seen, error, state, added, dropped, gains, difference(spent))


def moved(policy, swaps):
    """The moves of the scores, but for a constant of each state, which no choice depends on."""
    seen = torch.from_numpy(swaps.observations)
    with torch.no_grad():
        before = policy.scores(seen).numpy()
        with torch.enable_grad():
            raise_scores([policy], [swaps], FIT, STEP)
        change = policy.scores(seen).numpy() - before
    assert all(p.grad is None for p in policy.scorer.parameters())
    return centred(change) / STEP


def centred(values):
    return values - values.mean(axis=1, keepdims=True)


def test_scores_move_by_a_step_of_the_expected_gain(policy):
    def gain(inputs):
        return 0.1 * np.tanh(inputs[:, :, 0])

    swaps = planted(policy, gain)
    expected = centred(gain(inputs_of(policy, swaps.observations)))
    assert expected.std() > 0.04
    assert (moved(policy, swaps) - expected).std() < 0.2 * expected.std()


def test_budgets_have_their_price(policy):
    def spent(inputs):
        return 8.0 * (inputs[:, :, 0] > 0.0)

    swaps = planted(policy, None, spent)
    expected = -0.01 * centred(spent(inputs_of(policy, swaps.observations)))
    change = moved(policy, swaps)
    assert np.corrcoef(change.ravel(), expected.ravel())[0, 1] > 0.85
    assert np.polyfit(expected.ravel(), change.ravel(), 1)[0] == pytest.approx(1.0, abs=0.3)


def test_a_few_huge_gains_do_not_dominate(policy):
    swaps = planted(policy)
    swaps.gain[:] = 0.0
    swaps.gain[(swaps.added == 2) & (swaps.state % 20 == 0)] = 1e6
    assert 0.0 < moved(policy, swaps)[:, 2].mean() < LARGEST_GAIN
