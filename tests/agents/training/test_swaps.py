import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from agents.training.swaps import Swaps, try_swaps
from tests.helpers import SumRelease

SHORT = "dptse_env:dptse/ShortHighway-v0"
SEEDS = [5, 6, 7]
COUNTED = {"preset": "capped", "cap": 20, "boundary_inputs": "private"}
PRIVACIES = [COUNTED, {"preset": "paced", "boundary_inputs": "private"}]
SECONDS, TRIALS, HORIZON = 6, 2, 40


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


def make(**keywords):
    keywords = {"traffic_seeds": "0:3", "privacy": COUNTED, "horizon": HORIZON, **keywords}
    return gym.make_vec(
        SHORT, num_envs=3, action="slots", bandwidth=2, autoreset_mode="Disabled", **keywords
    )


def tried(env, policy, seed=0):
    generator = np.random.default_rng(seed)
    return list(try_swaps(env, policy, SEEDS, generator, seconds=SECONDS, trials=TRIALS))


@pytest.fixture(scope="module", params=PRIVACIES, ids=lambda privacy: privacy["preset"])
def privacy(request):
    return request.param


@pytest.fixture(scope="module")
def pass_of_swaps(privacy):
    policy = Wandering()
    return policy, tried(make(privacy=privacy), policy)


def test_swaps_are_tried_all_along_and_the_episodes_go_on_as_without(pass_of_swaps, privacy):
    policy, parts = pass_of_swaps
    first = next(k for k, seen in enumerate(policy.seen) if (seen == parts[0].observations).all())
    assert HORIZON // 4 <= first < HORIZON // 4 + SECONDS
    assert len(parts) == (HORIZON - first) // SECONDS
    for k, part in enumerate(parts):
        np.testing.assert_array_equal(part.observations, policy.seen[first + k * SECONDS])
    env = make(privacy=privacy)
    observation, _ = env.reset(seed=SEEDS)
    for seen, action in zip(policy.seen, policy.queried, strict=True):
        np.testing.assert_array_equal(seen, observation)
        observation, *_ = env.step(action)


def test_a_swap_replaces_a_queried_segment_by_one_that_was_not(pass_of_swaps):
    policy, parts = pass_of_swaps
    for part in parts:
        first = next(k for k, seen in enumerate(policy.seen) if (seen == part.observations).all())
        queried = policy.queried[first]
        assert part.state.tolist() == [0, 1, 2] * TRIALS
        for episode, added, dropped in zip(part.state, part.added, part.dropped, strict=True):
            assert dropped in queried[episode]
            assert added not in queried[episode]
    joined = Swaps.from_parts(parts)
    assert set(joined.added) == set(joined.dropped) == set(range(6))


def signs(env):
    """Signs as the first state's, drawn like the swaps: they come after the choice of seconds."""
    generator = np.random.default_rng(0)
    generator.integers(SECONDS)
    return generator.choice([-1.0, 1.0], size=(3, env.process.release.task.n_columns, 2))


def test_gains_are_those_of_episodes_run_apart(pass_of_swaps, privacy):
    policy, parts = pass_of_swaps
    part = parts[0]
    first = next(k for k, seen in enumerate(policy.seen) if (seen == part.observations).all())

    def run(swapped, sign):
        """Return rewards and spent budgets of an episode from its reset on; no forks."""
        env = make(privacy=privacy)
        env.reset(seed=SEEDS)
        for action in policy.queried[:first]:
            env.step(action)
        env.process.release.give_noise(sign * signs(env))
        query = policy.queried[first].copy()
        for episode, added, dropped in swapped:
            query[episode][query[episode] == dropped] = added
        total = np.zeros(3)
        for action in [query, *policy.queried[first + 1 : first + SECONDS]]:
            total += env.step(action)[1]
        return np.array([total, env.process.release.budgets_spent(np.arange(3))])

    def mean(swapped):
        return (run(swapped, 1.0) + run(swapped, -1.0)) / 2.0

    plain = mean([])
    np.testing.assert_allclose(part.error, -plain[0] / SECONDS, atol=1e-12)
    for trial in range(TRIALS):
        rows = slice(3 * trial, 3 * trial + 3)
        swapped = zip(part.state[rows], part.added[rows], part.dropped[rows], strict=True)
        expected = mean(list(swapped)) - plain
        np.testing.assert_allclose(part.gain[rows], expected[0], atol=1e-12)
        np.testing.assert_allclose(part.spent[rows], expected[1], atol=1e-12)
    assert np.abs(part.gain).min() > 1e-6
    assert np.abs(part.spent).max() > 0


def test_other_draws_try_other_swaps(pass_of_swaps, privacy):
    again = Swaps.from_parts(tried(make(privacy=privacy), Wandering()))
    other = Swaps.from_parts(tried(make(privacy=privacy), Wandering(), seed=1))
    joined = Swaps.from_parts(pass_of_swaps[1])
    np.testing.assert_array_equal(joined.gain, again.gain)
    assert not np.array_equal(joined.added[:50], other.added[:50])


def test_states_of_later_parts_are_counted_on():
    part = tried(make(), Wandering())[0]
    joined = Swaps.from_parts([part, part])
    assert joined.state.tolist() == [0, 1, 2, 0, 1, 2, 3, 4, 5, 3, 4, 5]
    assert joined.observations.shape == (6, part.observations.shape[1])
    np.testing.assert_array_equal(joined.gain, np.tile(part.gain, 2))


def test_without_budgets_nothing_is_spent():
    joined = Swaps.from_parts(tried(make(privacy="paper"), Wandering()))
    assert not joined.spent.any()
    assert joined.gain.any()


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"bandwidth": 6}, "bandwidth below 6 segments, got 6"),
        ({"horizon": 6}, "leaves 6 s to measure a gain, got 6 s"),
    ],
)
def test_environments_without_swaps_are_refused(keywords, message):
    keywords = {"traffic_seeds": "0:3", "bandwidth": 2, **keywords}
    env = gym.make_vec(SHORT, num_envs=3, action="slots", autoreset_mode="Disabled", **keywords)
    with pytest.raises(ValueError, match=message):
        tried(env, Wandering())


def test_swaps_need_queries_of_equal_cost():
    with pytest.raises(
        ValueError, match=r"^swaps need queries that cost the same, got query_spans"
    ):
        tried(make(privacy=SumRelease, query_spans=(1, 2)), Wandering())


def test_swaps_need_a_release_model_whose_noise_can_be_set():
    with pytest.raises(ValueError, match=r"^noise of the release model '.*SumRelease' cannot be"):
        tried(make(privacy=SumRelease), Wandering())
