"""Noise of releases: its distribution, streams and grid."""

import copy
import math
import pickle
import subprocess
import sys

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from agents.audit.residuals import RISK, examine
from dptse_env.release import noise as module
from dptse_env.release.noise import (
    BLOCK,
    DOUBT,
    FAR,
    LARGEST_SIGMA,
    Noise,
    grid_of,
    normal_of,
    rounded_normal,
)

from .worlds import ONE, streams

SIGMA = np.array([20.3, 11.2])
S = 19
UNIT = np.ones(S)


def on_grid(values):
    """Values rounded to the public grid: powers of two, 2^-6 veh/km and 2^-7 km/h."""
    grid = np.array([2.0**-6, 2.0**-7])
    return np.round(values / grid) * grid


def started(*seeds):
    made = Noise(len(seeds), S)
    made.reset(np.arange(len(seeds)), streams(*seeds))
    return made


def added(noise, values, episodes=ONE, sigma=SIGMA, unit=UNIT):
    deviations = np.broadcast_to(sigma, values.shape).copy()
    return noise.added(np.asarray(episodes), values, deviations, unit)


def drawn(noise, n_steps, episodes=ONE):
    """The noise of the next steps, (n_steps, k, S, 2), by adding it to zeros."""
    zeros = np.zeros((len(episodes), S, 2))
    return np.stack([added(noise, zeros, episodes) for _ in range(n_steps)])


# --- residuals -------------------------------------------------------------------------------


def test_residuals_are_white_and_of_the_stated_size():
    """550 steps of 19 segments of a moving truth are 10,450 values of each quantity."""
    noise = started(0)
    truth = np.random.default_rng(99).uniform(0.0, 300.0, (550, 1, S, 2))
    released = np.stack([added(noise, values) for values in truth])
    residuals = ((released - truth) / SIGMA)[:, 0]
    assert not examine(residuals).is_rejected
    # Nor are they larger than stated, or biased.
    assert stats.kstest(residuals.ravel(), "norm").pvalue > RISK


# --- the distribution ------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0.3, 2.0, FAR, 8.0])
def test_normal_numbers_are_within_a_thousandth_of_the_doubt_that_is_allowed(size):
    """Of the end of the 64 bits that lies nearest to the middle of the distribution, by mpmath."""
    with mpmath.workdps(40):
        v = int(mpmath.erfc(size / mpmath.sqrt(2)) * 2**63)
        for tail in (v, v + 1, v + 12345):
            exact = -mpmath.sqrt(2) * mpmath.erfinv(1 - mpmath.mpf(2 * tail + 1) / 2**64)
            above, below = normal_of(np.array([2 * tail, 2 * tail + 1], dtype=np.uint64)).tolist()
            assert below == -above
            assert abs(float(below - exact)) < DOUBT * (1.0 + size) / 1000.0


def interval(scale, found):
    """The values of the distribution function whose normal numbers round to an integer."""
    with mpmath.workdps(60):
        return [mpmath.ncdf((mpmath.mpf(found) + side) / scale) for side in (-0.5, 0.5)]


@pytest.mark.parametrize("scale", [700.5, 1500.3, 3e6])
@pytest.mark.parametrize("border", [0, 2000])
def test_bits_at_the_border_between_two_integers_are_settled_by_more_of_them(scale, border):
    """The 64 bits hold a border; what comes after them decides, and nothing else."""
    with mpmath.workdps(60):
        at = mpmath.ncdf(-(mpmath.mpf(border) + mpmath.mpf(0.5)) / scale) * mpmath.mpf(2) ** 64
        tail, rest = int(mpmath.floor(at)), int(mpmath.floor((at - mpmath.floor(at)) * 2**64))
    for first, expected in ((rest + 2, border), (max(rest - 2, 0), border + 1)):
        further = iter([first, 0])
        found = rounded_normal(scale, 2 * tail + 1, lambda further=further: next(further))
        low, high = interval(scale, found)
        with mpmath.workdps(60):
            value = (mpmath.mpf(tail) + mpmath.mpf(first) / 2**64) / 2**64
            assert low < value < high
        assert found == -expected
        assert next(further, None) is None or next(further, None) is None


def test_where_all_noise_is_in_doubt_releases_are_the_same(monkeypatch):
    """Each number is then settled by itself, and the stream goes on as if none had been."""
    certain = drawn(started(1), BLOCK + 1)
    monkeypatch.setattr(module, "DOUBT", 1.0)

    def settled(scale, bits, more):
        assert more() != more()
        return rounded_normal(scale, bits, more)

    monkeypatch.setattr(module, "rounded_normal", settled)
    np.testing.assert_array_equal(drawn(started(1), BLOCK + 1), certain)


def test_just_what_an_error_could_take_to_another_integer_and_what_is_far_is_settled(monkeypatch):
    """Numbers are three times as large as normal ones, and a settled one shows as 7."""
    monkeypatch.setattr(module, "rounded_normal", lambda scale, bits, more: 7)
    monkeypatch.setattr(module, "normal_of", lambda bits: 3.0 * normal_of(bits))
    monkeypatch.setattr(module, "DOUBT", 2.0**-15)
    found = drawn(started(0), BLOCK) / np.array([2.0**-6, 2.0**-7])
    bits = streams(0)[0].integers(2**64, size=(BLOCK, 1, S, 2), dtype=np.uint64)
    z, scale = 3.0 * normal_of(bits), SIGMA / np.array([2.0**-6, 2.0**-7])
    error = 2.0**-15 * (1.0 + abs(z))
    low, high, far = np.rint(scale * (z - error)), np.rint(scale * (z + error)), abs(z) > FAR
    np.testing.assert_array_equal(found, np.where((low != high) | far, 7.0, low))
    assert (far & (low == high)).any()
    assert 0.1 < (low != high).mean() < 0.9


@pytest.mark.parametrize("source", ["seeded", "secure"])
def test_released_integers_have_the_probabilities_of_a_rounded_gaussian(source):
    scale, columns = 1500.3, 5000
    noise = Noise(1, columns, source)
    noise.reset(ONE, streams(5))
    zeros, sigma = np.zeros((1, columns, 2)), np.full((1, columns, 2), scale)
    steps = np.concatenate([noise.added(ONE, zeros, sigma, np.ones(columns)) for _ in range(40)])
    np.testing.assert_array_equal(steps, np.rint(steps))
    borders = [-math.inf, *(np.arange(-40, 41) * 100 + 0.5), math.inf]
    expected = np.diff(stats.norm.cdf(borders, scale=scale)) * steps.size
    assert stats.chisquare(np.histogram(steps, borders)[0], expected).pvalue > 1e-4
    # Every bit is used: the last digits are uniform, and no two columns have the same noise.
    last = np.bincount((steps.ravel() % 10).astype(int))
    assert stats.chisquare(last).pvalue > 1e-4
    assert np.unique(steps[0, :, 0]).size > 0.5 * np.unique(steps[0]).size


def test_secure_noise_takes_no_seed():
    first, second = (Noise(1, S, "secure") for _ in range(2))
    for noise in (first, second):
        noise.reset(ONE, streams(1))
    assert (drawn(first, 1) != drawn(second, 1)).mean() > 0.99
    assert first._further(0)() != second._further(0)()


COPIES = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda noise: pickle.loads(pickle.dumps(noise)),
    "copy of a copy": lambda noise: copy.deepcopy(copy.copy(noise)),
}


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
def test_a_copy_repeats_seeded_noise_and_has_none_of_secure_noise(copied):
    seeded = started(1, 2)
    drawn(seeded, 3, [0, 1])
    np.testing.assert_array_equal(drawn(copied(seeded), 70, [1, 0]), drawn(seeded, 70, [1, 0]))
    secure = Noise(2, S, "secure", scale=3.0)
    secure.reset(np.arange(2), streams(1, 2))
    drawn(secure, 3, [0, 1])
    left = secure._bits.copy()
    for twin in (copied(secure), copied(secure)):
        assert not np.intersect1d(twin._bits, left).any()
        twin.reset(ONE, streams(1))
        np.testing.assert_allclose(drawn(twin, 200).std(axis=(0, 1, 2)), 3.0 * SIGMA, rtol=0.2)
        with pytest.raises(RuntimeError, match=r"^episode 1 must be reset before it is released"):
            drawn(twin, 1, [1])
    np.testing.assert_array_equal(secure._bits, left)
    drawn(secure, 70, [0, 1])


FORKED = """
import os
import numpy as np
from dptse_env.release.noise import Noise

def release():
    noise.added(np.arange(1), np.zeros((1, 3, 2)), np.ones((1, 3, 2)), np.ones(3))

for source in ("secure", "seeded"):
    noise = Noise(1, 3, source)
    noise.reset(np.arange(1), [np.random.default_rng(0)])
    release()
    if os.fork() == 0:
        try:
            release()
        except RuntimeError:
            noise.reset(np.arange(1), [np.random.default_rng(0)])
            release()
            os._exit(7)
        os._exit(8)
    release()
    print(os.waitstatus_to_exitcode(os.wait()[1]))
"""


@pytest.mark.skipif(not hasattr(module.os, "fork"), reason="this system has no forks")
def test_a_forked_process_has_none_of_the_secure_noise_and_its_origin_goes_on():
    """From a process that has no threads, as a fork should."""
    found = subprocess.run(
        [sys.executable, "-c", FORKED], capture_output=True, text=True, check=False
    )
    assert found.stdout.split() == ["7", "8"], found.stderr


# --- streams ---------------------------------------------------------------------------------


@settings(max_examples=30)
@given(data=st.data(), n_episodes=st.integers(1, 4))
def test_an_episode_has_its_own_stream_in_any_batch_and_interleaving(data, n_episodes):
    """Without a seam between blocks, through arbitrary subsets, orders and resets."""
    rows = list(range(n_episodes))
    noise, alone = started(*rows), streams(*rows)
    for turn in range(data.draw(st.integers(1, 20), label="turns")):
        chosen = data.draw(st.lists(st.sampled_from(rows), unique=True, min_size=1))
        if data.draw(st.booleans(), label="reset"):
            seeds = [(turn, row) for row in chosen]
            noise.reset(np.array(chosen), streams(*seeds))
            for row, stream in zip(chosen, streams(*seeds), strict=True):
                alone[row] = stream
        else:
            found = drawn(noise, 20, chosen)
            bits = [alone[row].integers(2**64, size=(20, S, 2), dtype=np.uint64) for row in chosen]
            expected = [normal_of(each) * SIGMA for each in bits]
            np.testing.assert_array_equal(found, on_grid(np.stack(expected, axis=1)))


def test_nothing_is_released_before_the_first_reset():
    noise = Noise(3, S)
    with pytest.raises(RuntimeError, match=r"^episode 0 must be reset before it is released: it "):
        drawn(noise, 1)
    noise.reset(np.array([0, 2]), streams(1, 2))
    drawn(noise, 70, [0, 2])
    with pytest.raises(RuntimeError, match=r"^episode 1 must be reset before it is released: it "):
        drawn(noise, 1, [1])
    with pytest.raises(ValueError, match="shorter"):
        noise.reset(np.arange(2), streams(1))


def test_given_noise_is_that_of_the_next_release_alone_and_does_not_outlast_a_reset():
    plain, given = started(1, 2), started(1, 2)
    deviations = np.random.default_rng(3).choice([-1.0, 1.0], size=(2, S, 2))
    given.give(deviations)
    found, expected = drawn(given, 3, [1, 0]), drawn(plain, 3, [1, 0])
    np.testing.assert_array_equal(found[0], on_grid(deviations[[1, 0]] * SIGMA))
    np.testing.assert_array_equal(found[1:], expected[1:])
    given.give(deviations)
    given.reset(ONE, streams(1))
    np.testing.assert_array_equal(drawn(given, 2), drawn(started(1), 2))
    with pytest.raises(ValueError, match=r"^noise must .* \(2, 19, 2\), got \(19, 2\)"):
        given.give(np.ones((S, 2)))


# --- values ----------------------------------------------------------------------------------


def test_a_release_is_the_value_plus_noise_over_its_unit_in_a_fresh_array():
    unit = np.linspace(0.5, 2.0, S)
    values = on_grid(np.linspace(0.0, 300.0, 2 * S).reshape(1, S, 2))
    before = values.copy()
    found = added(started(1), values, unit=unit)
    np.testing.assert_array_equal(values, before)
    np.testing.assert_array_equal(found, (values + drawn(started(1), 1)[0]) / unit[:, None])


@pytest.mark.parametrize("sigma", [(20.3, 11.2), (1e-3, 1e9), (1024.0, 0.5)])
def test_releases_lie_on_a_public_grid_much_finer_than_the_noise(sigma):
    grid = np.array([grid_of(each) for each in sigma])
    assert (grid <= np.divide(sigma, 1024.0)).all()
    assert ((grid > np.divide(sigma, 2048.0)) | (grid == 1.0)).all()
    assert (grid <= 1.0).all()  # so that counts are multiples of it
    np.testing.assert_array_equal(np.frexp(grid)[0], 0.5)  # powers of two
    values = np.random.default_rng(0).uniform(0.0, 300.0, (1, S, 2))
    steps = added(started(1), values, sigma=sigma) / grid
    np.testing.assert_array_equal(steps, np.rint(steps))
    assert (steps % 2.0 == 1.0).any()


def test_the_widest_noise_is_exact_and_wider_one_is_refused():
    values, widest = np.full((1, S, 2), 300.0), np.full((1, S, 2), LARGEST_SIGMA)
    steps = [rounded_normal(LARGEST_SIGMA, int(bits), lambda: 0) for bits in (2, 2**64 - 1)]
    assert all(float(300 + step) == 300 + step for step in steps)
    assert np.ptp(added(started(1), values, sigma=widest)) > LARGEST_SIGMA
    for bad in (2.0 * LARGEST_SIGMA, 1e150, np.inf, np.nan, 0.0):
        sigma = widest.copy()
        sigma[0, 3, 1] = bad
        with pytest.raises(ValueError, match=r"^privacy\.epsilon must be such that noise has "):
            added(started(1), values, sigma=sigma)
