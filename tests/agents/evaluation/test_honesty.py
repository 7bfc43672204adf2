from types import SimpleNamespace

import numpy as np
import pytest

from agents.evaluation.episodes import EpisodeScore
from agents.evaluation.honesty import EstimateWatcher, regimes
from dptse_env.estimators import Estimate


def test_regimes_part_the_occupied_segments():
    speed = np.array([[90.0, 95.0, 40.0, 30.0, 20.0, 0.0, 100.0, 90.0]])
    occupied = np.array([[True] * 5 + [False] + [True] * 2])
    jam, front, free = regimes(speed, occupied)
    assert front.tolist() == [[False, True, True, False, False, False, False, False]]
    assert jam.tolist() == [[False, False, False, True, True, False, False, False]]
    assert free.tolist() == [[True, False, False, False, False, False, True, True]]


class Process:
    """Two episodes of one mainline segment and a ramp, whose estimates miss by given errors."""

    n_episodes = 2

    def __init__(self):
        self.time = np.array([61, 61])
        self.estimate = None
        self.interface = SimpleNamespace(n_mainline=1)

    def play(self, errors, occupied=True):
        truth = np.zeros((2, 2, 2))
        truth[..., 0], truth[..., 1] = (30.0 if occupied else 0.0), 90.0
        self.truth = lambda _: truth
        off = np.array(errors)[:, None]
        ones = np.ones((2, 2))
        self.estimate = Estimate(truth[..., 0] + off, truth[..., 1] - off, 2 * ones, 4 * ones)


def score(seed):
    return EpisodeScore(seed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_deviations_are_held_against_errors():
    process = Process()
    watcher = EstimateWatcher(process)
    for errors in ([1.0, 4.0], [1.0, 0.0]):
        process.play(errors)
        watcher()
    first, second = watcher.scores([score(2000), score(2001)])
    assert first.chi2_density == pytest.approx(0.25)
    assert first.chi2_speed == pytest.approx(1 / 16)
    assert second.chi2_density == pytest.approx(0.5 * (2.0**2 + 0.0))
    assert (first.density_50, first.density_95) == (100.0, 100.0)
    assert (second.density_90, second.density_95) == (50.0, 50.0)  # 2 deviations exceed 1.96
    assert second.speed_50 == 50.0
    assert (first.n_free, first.n_jam, first.n_front) == (2.0, 0.0, 0.0)
    assert first.density_free == pytest.approx(2.0)
    assert second.speed_free == pytest.approx(16.0)


def test_the_warm_up_and_speeds_of_empty_segments_do_not_count():
    process = Process()
    watcher = EstimateWatcher(process)
    process.play([50.0, 50.0])
    process.time[:] = 60
    watcher()
    process.time[:] = 61
    process.play([2.0, 2.0], occupied=False)
    watcher()
    found = watcher.scores([score(2000), score(2001)])[0]
    assert found.chi2_density == pytest.approx(1.0)
    assert found.chi2_speed == 0.0
    assert found.n_free == 0.0
