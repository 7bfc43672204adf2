"""The mechanism, with a residual test that a wrong one fails: see the seeded mutations below."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from dptse_env.release.mechanism import GaussianMechanism, Mechanism

SIGMA = (20.3, 11.2)
S = 19


def make(n_episodes=1, n_segments=S, block=32, kind=GaussianMechanism):
    return kind(SIGMA, n_episodes=n_episodes, n_segments=n_segments, block=block)


def on_grid(values):
    """Values rounded to the public grid: powers of two, 2^-6 veh/km and 2^-7 km/h."""
    grid = np.array([2.0**-6, 2.0**-7])
    return np.round(values / grid) * grid


def streams(*seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def started(*seeds, **sizes):
    mechanism = make(len(seeds), **sizes)
    mechanism.reset(np.arange(len(seeds)), streams(*seeds))
    return mechanism


def noise(mechanism, n_steps, episodes=None):
    """The noise of the next steps, (n_steps, k, S, 2), by releasing zeros."""
    rows = np.arange(mechanism.n_episodes) if episodes is None else np.asarray(episodes)
    zeros = np.zeros((len(rows), S, 2))
    return np.stack([mechanism.release(rows, zeros) for _ in range(n_steps)])


# --- residuals -------------------------------------------------------------------------------


def residual_faults(true, released, sigma, max_lag=100):
    """Name each way in which (released - true) / sigma, (steps, S, 2), is not white and normal.

    Two-sided, at a total level of about 1e-4: chi-square for the variance of each quantity, and
    normal bounds on the mean, and on the mean product of residuals at each lag, of neighbouring
    segments and of the two quantities.
    """
    residuals = (released - true) / np.asarray(sigma)
    faults = []
    for quantity, values in (("density", residuals[..., 0]), ("speed", residuals[..., 1])):
        tail = stats.chi2(values.size).cdf((values**2).sum())
        if not 1e-5 < tail < 1.0 - 1e-5:
            faults.append(f"variance of {quantity}")
        if not abs(values.sum()) < 5.0 * np.sqrt(values.size):
            faults.append(f"mean of {quantity}")
    pairs = {f"lag {k}": (residuals[k:], residuals[:-k]) for k in range(1, max_lag + 1)}
    pairs["neighbours"] = (residuals[:, 1:], residuals[:, :-1])
    pairs["density and speed"] = (residuals[..., 0], residuals[..., 1])
    for name, (left, right) in pairs.items():
        if not abs((left * right).sum()) < 5.0 * np.sqrt(left.size):
            faults.append(f"correlation: {name}")
    return faults


def run(kind, n_steps=550, seed=1):
    """Release a moving truth; 550 steps of 19 segments are 10,450 values of each quantity."""
    mechanism = started(seed, kind=kind)
    truth = np.random.default_rng(99).uniform(0.0, 300.0, (n_steps, 1, S, 2))
    released = np.stack([mechanism.release(np.array([0]), values) for values in truth])
    return truth[:, 0], released[:, 0]


@pytest.mark.parametrize("seed", range(2))
def test_residuals_are_white_and_of_the_stated_size(seed):
    assert residual_faults(*run(GaussianMechanism, seed=seed), SIGMA) == []


# Seeded mutations: each is a fault that the residual test is there for.


class TooLoud(GaussianMechanism):
    def _draw(self, row, generator):
        super()._draw(row, generator)
        self._noise[row] *= 1.05


class TooQuiet(GaussianMechanism):
    def _draw(self, row, generator):
        super()._draw(row, generator)
        self._noise[row] *= 0.95


class SpeedTooQuiet(GaussianMechanism):
    def _draw(self, row, generator):
        super()._draw(row, generator)
        self._noise[row, ..., 1] *= 0.95


class RepeatsItsBlock(GaussianMechanism):
    def _draw(self, row, generator):
        super()._draw(row, copy.deepcopy(generator))


class OneDrawForBothQuantities(GaussianMechanism):
    def _draw(self, row, generator):
        super()._draw(row, generator)
        self._noise[row, ..., 1] = self._noise[row, ..., 0] / self._sigma[0] * self._sigma[1]


class Smoothed(GaussianMechanism):
    def _draw(self, row, generator):
        super()._draw(row, generator)
        block = self._noise[row]
        block[1:] = np.sqrt(0.98) * block[1:] + np.sqrt(0.02) * block[:-1]


@pytest.mark.parametrize(
    ("mutation", "symptom"),
    [
        (TooLoud, "variance of density"),
        (TooQuiet, "variance of density"),
        (SpeedTooQuiet, "variance of speed"),
        (RepeatsItsBlock, "correlation: lag 32"),
        (OneDrawForBothQuantities, "correlation: density and speed"),
        (Smoothed, "correlation: lag 1"),
    ],
)
def test_residual_test_fails_for_a_faulty_mechanism(mutation, symptom):
    assert symptom in residual_faults(*run(mutation, seed=0), SIGMA)


# --- streams ---------------------------------------------------------------------------------


@pytest.mark.parametrize("block", [1, 7, 500])
def test_blocks_leave_no_seam(block):
    """The noise is the stream itself, whatever the size of the blocks it is drawn in."""
    expected = on_grid(np.random.default_rng(5).standard_normal((130, S, 2)) * SIGMA)
    found = noise(started(5, block=block), 130)[:, 0]
    np.testing.assert_array_equal(found, expected)


@settings(deadline=None, max_examples=40)
@given(data=st.data(), block=st.integers(1, 9), n_episodes=st.integers(1, 5))
def test_an_episode_meets_the_same_noise_in_any_batch_and_interleaving(data, block, n_episodes):
    """Each keeps to its own stream through arbitrary subsets, orders and resets."""
    mechanism = make(n_episodes, block=block)
    rows = list(range(n_episodes))
    mechanism.reset(np.array(rows), streams(*rows))
    alone = streams(*rows)
    for turn in range(data.draw(st.integers(1, 25), label="turns")):
        chosen = data.draw(st.lists(st.sampled_from(rows), unique=True, min_size=1))
        if data.draw(st.booleans(), label="reset"):
            seeds = [(turn, row) for row in chosen]
            mechanism.reset(np.array(chosen), streams(*seeds))
            for row, stream in zip(chosen, streams(*seeds), strict=True):
                alone[row] = stream
        else:
            found = noise(mechanism, 1, chosen)[0]
            expected = [on_grid(alone[row].standard_normal((S, 2)) * SIGMA) for row in chosen]
            np.testing.assert_array_equal(found, expected)


def test_noise_does_not_depend_on_the_queries():
    """Unasked segments may hold anything, not-a-number included; the rest meet the same noise."""
    everything, few = started(3), started(3)
    values = np.random.default_rng(0).uniform(0.0, 300.0, (1, S, 2))
    for step in range(80):
        asked = np.zeros(S, dtype=bool)
        asked[[step % S, 14]] = True
        hidden = np.where(asked[None, :, None], values, np.nan)
        whole = everything.release(np.array([0]), values)
        part = few.release(np.array([0]), hidden)
        np.testing.assert_array_equal(part[:, asked], whole[:, asked])
        assert np.isnan(part[:, ~asked]).all()


def test_streams_are_independent():
    first, second = np.moveaxis(noise(started(1, 2), 300), 1, 0) / np.asarray(SIGMA)
    products = first * second
    assert abs(products.sum()) < 4.0 * np.sqrt(products.size)
    assert np.mean(first == second) < 0.01


def test_a_reset_starts_the_given_stream_and_leaves_the_others_alone():
    mechanism, undisturbed = started(1, 2), started(1, 2)
    noise(mechanism, 10)
    noise(undisturbed, 10)
    mechanism.reset(np.array([0]), streams(7))
    found = noise(mechanism, 50)
    np.testing.assert_array_equal(found[:, 0], noise(started(7), 50)[:, 0])
    np.testing.assert_array_equal(found[:, 1], noise(undisturbed, 50)[:, 1])


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_a_copy_goes_on_with_the_same_noise(clone):
    mechanism = started(1, 2)
    noise(mechanism, 20)
    twin = clone(mechanism)
    np.testing.assert_array_equal(noise(mechanism, 50), noise(twin, 50))


# --- values ----------------------------------------------------------------------------------


def test_a_release_is_the_value_plus_noise_in_a_fresh_array():
    mechanism, twin = started(1, 2), started(1, 2)
    values = on_grid(np.random.default_rng(0).uniform(0.0, 300.0, (2, S, 2)))
    before = values.copy()
    first = mechanism.release(np.arange(2), values)
    kept = first.copy()
    second = mechanism.release(np.arange(2), values)
    np.testing.assert_array_equal(values, before)
    np.testing.assert_array_equal(first, kept)
    assert not np.shares_memory(first, second)
    np.testing.assert_array_equal(first, values + noise(twin, 1)[0])
    second[:] = 0.0
    np.testing.assert_array_equal(
        mechanism.release(np.arange(2), values), values + noise(twin, 2)[1]
    )


@pytest.mark.parametrize("sigma", [(20.3, 11.2), (1e-3, 1e9), (76.0, 3878.0)])
def test_releases_lie_on_a_public_grid_much_finer_than_the_noise(sigma):
    mechanism = GaussianMechanism(sigma, n_episodes=1, n_segments=S)
    mechanism.reset(np.array([0]), streams(1))
    values = np.random.default_rng(0).uniform(0.0, 300.0, (1, S, 2))
    in_grid = mechanism.release(np.array([0]), values) / mechanism.grid
    np.testing.assert_array_equal(in_grid, np.rint(in_grid))
    share = mechanism.grid / np.array(sigma)
    assert (share <= 2.0**-10).all()
    assert (share > 2.0**-11).all()
    np.testing.assert_array_equal(np.frexp(mechanism.grid)[0], 0.5)  # powers of two


def fine_bits(densities):
    """The share of small numbers that have bits finer than 2^-50, as few sums with 10 can have."""
    small = densities[np.abs(densities) < 1.0]
    assert small.size > 1000
    return np.mean(small * 2.0**50 != np.rint(small * 2.0**50))


def test_the_low_bits_of_a_release_do_not_tell_an_empty_segment_from_one_vehicle():
    rng = np.random.default_rng(1)
    plain = rng.standard_normal(100_000) * SIGMA[0]
    # The attack works on sums in double precision: with one vehicle on 0.1 km no such bit is left.
    assert fine_bits(0.0 + plain) > 0.5
    assert fine_bits(10.0 + plain) == 0.0
    released = {}
    for density in (0.0, 10.0):
        mechanism = started(2)
        values = np.full((1, S, 2), density)
        released[density] = np.concatenate(
            [mechanism.release(np.array([0]), values)[0, :, 0] for _ in range(5000)]
        )
    assert fine_bits(released[0.0]) == fine_bits(released[10.0]) == 0.0
    found, expected = (released[density] / 2.0**-6 for density in (0.0, 10.0))
    # The same numbers can be released in both worlds: 10 veh/km are 640 steps of the grid.
    np.testing.assert_array_equal(found + 640.0, expected)


def test_sigma_is_public_and_cannot_be_changed():
    mechanism = make()
    assert mechanism.sigma.tolist() == list(SIGMA)
    with pytest.raises(ValueError, match="read-only"):
        mechanism.sigma[0] = 0.0


def test_a_constant_stub_can_stand_in_for_a_mechanism():
    class Constant:
        def __init__(self) -> None:
            self.sigma = np.ones(2)

        def reset(self, episodes, generators):
            pass

        def release(self, episodes, values):
            return np.full((len(episodes), *values.shape[1:]), 50.0)

    def use(mechanism: Mechanism):
        mechanism.reset(np.array([0]), streams(1))
        return mechanism.release(np.array([0]), np.zeros((1, S, 2)))

    assert (use(Constant()) == 50.0).all()
    assert use(make()).shape == (1, S, 2)


# --- bad input -------------------------------------------------------------------------------


def test_nothing_is_released_before_the_first_reset():
    mechanism = make(3)
    with pytest.raises(RuntimeError, match="episode 0 was released before its first reset"):
        noise(mechanism, 1)
    mechanism.reset(np.array([0, 2]), streams(1, 2))
    np.testing.assert_array_equal(noise(mechanism, 70, [0, 2])[:, 0], noise(started(1), 70)[:, 0])
    with pytest.raises(RuntimeError, match="episode 1 was released before its first reset"):
        noise(mechanism, 1, [1])


@pytest.mark.parametrize("shape", [(1, S, 1), (S, 2), (2, S, 2)])
def test_values_of_another_shape_are_refused_and_cost_no_noise(shape):
    mechanism = started(1)
    with pytest.raises(ValueError, match=r"^values must have shape \(1, 19, 2\), got "):
        mechanism.release(np.array([0]), np.zeros(shape))
    np.testing.assert_array_equal(noise(mechanism, 5), noise(started(1), 5))


def test_streams_must_match_the_episodes():
    with pytest.raises(ValueError, match=r"one for each of 2 episodes, got 1$"):
        make(2).reset(np.arange(2), streams(1))


@pytest.mark.parametrize(
    "sigma", [(1.0,), (1.0, 0.0), (1.0, -1.0), (np.nan, 1.0), 1.0, (1.0, 1.0, 1.0)]
)
def test_a_bad_sigma_is_refused(sigma):
    with pytest.raises(ValueError, match=r"^sigma must be two finite numbers > 0, got "):
        GaussianMechanism(sigma, n_episodes=1, n_segments=S)


@pytest.mark.parametrize("size", ["n_episodes", "n_segments", "block"])
def test_a_bad_size_is_named(size):
    with pytest.raises(ValueError, match=rf"^{size} must be an integer >= 1, got 0$"):
        make(**{size: 0})


# --- noise that is given ---------------------------------------------------------------------


def test_given_noise_is_that_of_the_next_release_alone():
    plain, given = started(1, 2), started(1, 2)
    deviations = np.random.default_rng(3).choice([-1.0, 1.0], size=(2, S, 2))
    given.give(deviations)
    plain_noise, given_noise = noise(plain, 3), noise(given, 3)
    np.testing.assert_array_equal(given_noise[0], on_grid(deviations * SIGMA))
    np.testing.assert_array_equal(given_noise[1:], plain_noise[1:])


def test_given_noise_does_not_outlast_a_reset():
    given = started(1)
    given.give(np.ones((1, S, 2)))
    given.reset(np.array([0]), streams(1))
    np.testing.assert_array_equal(noise(given, 2), noise(started(1), 2))


def test_given_noise_must_have_the_shape_of_a_release():
    with pytest.raises(ValueError, match=r"^noise must have shape \(1, 19, 2\), got \(19, 2\)"):
        started(1).give(np.ones((S, 2)))
