"""An episode's noise follows its seed alone, and its score the record's second."""

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.parts import make_parts
from dptse_env.process import QueryProcess
from dptse_env.release.noise import grid_of
from dptse_env.traffic import RecordLibrary

TWO = np.arange(2)
QUERY_ALL = np.ones((2, 6), dtype=np.int8)


def grid(process):
    """Spacing of the grid of both released quantities."""
    return np.array([grid_of(sigma) for sigma in process.release.sigma.tolist()])


def begin(seeds, options, **keywords):
    """Return a process with two episodes."""
    every = {"bandwidth": 6, "traffic_seeds": "0:2", "horizon": 80, "random_start": True}
    process = QueryProcess(make_parts(resolve("short-highway", {**every, **keywords}), 2))
    process.reset(TWO, [np.random.default_rng(seed) for seed in seeds], options)
    return process


def play(process, n_steps=80):
    """Return the released values and their noise, (n_steps, 2, 6, 2) each."""
    released, noise = [], []
    for _ in range(n_steps):
        process.step(TWO, QUERY_ALL)
        released.append(process.released[:, :6].copy())
        noise.append(released[-1] - process.truth(TWO)[:, :6])
    return np.array(released), np.array(noise)


def test_two_seeds_share_no_noise_on_one_record():
    process = begin((1, 2), {"traffic_seed": 0, "start": 0})
    _, noise = play(process)
    assert (np.abs(noise[:, 0] - noise[:, 1]) > grid(process)).mean() > 0.99
    for component in (0, 1):
        first, second = noise[:, 0, :, component].ravel(), noise[:, 1, :, component].ravel()
        assert abs(np.corrcoef(first, second)[0, 1]) < 0.2


@pytest.mark.parametrize(
    "options", [{"traffic_seed": [0, 1], "start": 0}, {"traffic_seed": 0, "start": [0, 100]}]
)
def test_one_seed_has_one_noise_on_any_traffic(options):
    process = begin((1, 1), options)
    released, noise = play(process)
    assert not np.array_equal(released[:, 0], released[:, 1])
    # Sums are rounded to the grid, so their noise agrees to half its spacing on either side.
    assert (np.abs(noise[:, 0] - noise[:, 1]) <= 1.001 * grid(process)).all()


@pytest.mark.parametrize("estimator", ["enkf", "random_walk"])
def test_the_noise_does_not_depend_on_the_estimator(estimator):
    same = {"traffic_seed": 0, "start": 0}
    expected, _ = play(begin((1, 2), same, estimator="ekf"))
    released, _ = play(begin((1, 2), same, estimator=estimator))
    np.testing.assert_array_equal(released, expected)


@pytest.mark.parametrize("start", [0, 17])
def test_an_episode_is_scored_against_the_record_at_its_second(start):
    process = begin((5, 6), {"traffic_seed": 1, "start": start}, reward="density")
    corridor, n = process.config.corridor, 6
    record = RecordLibrary().get(corridor, 1)
    reward = np.full(2, np.nan)
    for k in range(60):
        density = record.counts[start + k, :n] / corridor.segment_length
        error = np.sqrt(np.mean((process.estimate.density[:, :n] - density) ** 2, axis=1))
        np.testing.assert_allclose(process.infos(TWO)["rmse_density"], error, rtol=1e-12)
        if k > 0:
            np.testing.assert_allclose(reward, -error / corridor.density_scale, rtol=1e-12)
        reward = process.step(TWO, QUERY_ALL).reward
