import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import torch

from agents.training.policy_iteration import LARGEST_GAIN, raise_scores
from agents.training.recipes import SwapRounds
from agents.training.swaps import Swaps
from dptse_env.config import resolve
from dptse_env.sb3 import PlackettLucePolicy

N = 6
STEP = 3.0
SETTINGS = SwapRounds(price=0.01, batches=400, batch_size=256, rate=1e-2)


@pytest.fixture
def policy():
    torch.manual_seed(0)
    config = resolve("short-highway", {"action": "slots", "bandwidth": 2})
    return PlackettLucePolicy.from_config(config, width=16)


def planted(policy, gain, spent=None, n_states=300, trials=20):
    """Swaps whose gain is that of their segments, ``gain(channels)`` of shape (m, N), and noise."""
    generator = np.random.default_rng(0)
    size = policy.observation_space.shape[0]
    seen = generator.uniform(0.0, 0.3, size=(n_states, size)).astype(np.float32)
    state = np.repeat(np.arange(n_states), trials)
    pairs = generator.permuted(np.tile(np.arange(N), (len(state), 1)), axis=1)
    added, dropped = pairs[:, 0], pairs[:, 1]

    def difference(of):
        if of is None:
            return np.zeros(len(state))
        values = of(policy.features(torch.from_numpy(seen)).numpy())
        return values[state, added] - values[state, dropped]

    noise = generator.normal(0.0, 0.02, len(state))
    error = np.full(n_states, 0.1)
    gains = 0.1 * (difference(gain) + noise)
    return Swaps(seen, error, state, added, dropped, gains, difference(spent))


def moved(policy, swaps, settings=SETTINGS):
    """The moves of the scores, but for a constant of each state, which no choice depends on."""
    seen = torch.from_numpy(swaps.observations)

    def scores():
        with torch.no_grad():
            return policy.scores(seen).numpy()

    before = scores()
    raise_scores([policy], [swaps], settings, STEP)
    change = scores() - before
    return change - change.mean(axis=1, keepdims=True)


def centred(values):
    return values - values.mean(axis=1, keepdims=True)


def test_scores_move_by_a_step_of_the_expected_gain(policy):
    def gain(channels):
        return 0.1 * np.tanh(channels[:, 0])

    swaps = planted(policy, gain)
    expected = centred(gain(policy.features(torch.from_numpy(swaps.observations)).numpy()))
    change = moved(policy, swaps) / STEP
    assert expected.std() > 0.04
    assert (change - expected).std() < 0.2 * expected.std()


def test_budgets_have_their_price(policy):
    def spent(channels):
        return 8.0 * (channels[:, 0] > 0.0)

    swaps = planted(policy, None, spent)
    change = moved(policy, swaps) / STEP
    expected = -0.01 * centred(spent(policy.features(torch.from_numpy(swaps.observations)).numpy()))
    assert np.corrcoef(change.ravel(), expected.ravel())[0, 1] > 0.9


def test_a_few_huge_gains_do_not_dominate(policy):
    swaps = planted(policy, None)
    swaps.gain[:] = 0.0
    swaps.gain[(swaps.added == 2) & (swaps.state % 20 == 0)] = 1e6
    change = moved(policy, swaps) / STEP
    assert 0.0 < change[:, 2].mean() < LARGEST_GAIN


def test_no_gain_moves_nothing_but_noise(policy):
    swaps = planted(policy, None)
    assert np.abs(moved(policy, swaps) / STEP).mean() < 0.01


def test_it_reports_its_progress_and_leaves_no_gradients(policy):
    shares = []
    few = SwapRounds(batches=100, batch_size=8)
    raise_scores([policy], [planted(policy, None, n_states=10)], few, STEP, shares.append)
    assert shares == [0.0, 0.5]
    assert all(p.grad is None for p in policy.scorer.parameters())
