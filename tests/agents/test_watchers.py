"""Watchers of episodes, against truth, records and numbers made up by hand."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from agents.environments import make_config
from agents.play import Cell, play
from agents.watchers import (
    LENGTHS,
    Contributions,
    Honesty,
)
from dptse_env.estimators import Estimate
from dptse_env.evaluation import evaluate
from dptse_env.parts import make_release
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.vector_info import info_of
from tests.helpers import SHORT

N_MAINLINE = 6
SEEDS = (2000, 2001)
PACED = {"preset": "paced", "epsilon": 5.0, "clip": 20.0}
CAPPED = {"preset": "capped", "epsilon": 5.0, "cap": 8}


def watch(privacy, watchers=("contributions",), **keywords):
    """Return the rows of two episodes."""
    keywords = {"estimator": "ekf", "privacy": privacy, **keywords}
    return play(Cell(SHORT, "round-robin", keywords, watchers=watchers), SEEDS)


def truth_of(privacy, seed):
    """Return the sum of refused contributions, and what vehicles have paid in the end."""
    keywords = {"estimator": "ekf", "privacy": privacy, "traffic_seeds": [seed]}
    env = gym.make(SHORT, disable_env_checker=True, **keywords)
    process, refused = env.unwrapped.process, []

    def private():
        return info_of(process.release.private(np.array([0]), process.traffic_index), 0)

    class Noting:
        def __call__(self):
            refused.append(private().get("n_refused", 0))

        def rows(self):
            return [{}]

    evaluate(env, "round-robin", [seed], watchers=[lambda process: Noting()])
    return sum(refused), private()


@pytest.fixture(scope="module")
def paced():
    return watch(PACED)


def test_watching_changes_nothing(paced):
    for row, watched in zip(watch(PACED, ()), paced, strict=True):
        assert row.items() <= watched.items()


def test_refusals_are_those_of_the_truth_wherever_they_are_counted(paced):
    for row, seed in zip(paced, SEEDS, strict=True):
        assert row["n_refused"] == truth_of(PACED, seed)[0] == sum(row["refused_of"]) > 0
        assert row["n_met"] >= sum(row["met_of"])
        assert len(row["met_of"]) == len(LENGTHS)
        # Ramps have fixed sensors, too: what is met there has no place on the mainline.
        assert len(row["met"]) == N_MAINLINE
        assert 0 < sum(row["met"]) < row["n_met"]
        assert (np.array(row["refused"]) <= np.array(row["met"])).all()


def test_lengths_are_seconds_on_the_mainline():
    """Every vehicle is met in each second on the mainline, all of which is queried."""
    row = watch(PACED, bandwidth=N_MAINLINE)[0]
    corridor = make_config(SHORT, {}).corridor
    record = RecordLibrary().get(corridor, SEEDS[0])
    counted, on_road = record.step > 0, record.segment < N_MAINLINE
    sensed = np.isin(record.segment, corridor.fixed_sensors)
    n = record.n_vehicles
    seconds = np.bincount(record.vehicle[counted & on_road], minlength=n)
    met = np.bincount(record.vehicle[counted & (on_road | sensed)], minlength=n)
    by_hand = np.histogram(seconds, [1, *LENGTHS[1:], np.inf], weights=met)[0]
    np.testing.assert_array_equal(row["met_of"], by_hand)


def test_a_cap_refuses_what_comes_after_it_and_none_where_every_second_has_a_budget(paced):
    for row, seed in zip(watch(CAPPED), SEEDS, strict=True):
        _, truth = truth_of(CAPPED, seed)
        assert row["n_met"] - row["n_refused"] == np.sum(truth["exposures"])
        assert row["n_refused"] > 0
    for row in watch({**PACED, "unit": "event"}):
        assert row["n_met"] > 100
        assert row["n_refused"] == sum(row["refused"]) == 0
    # At private boundaries vehicles are met, too.
    rows = watch({**PACED, "boundary_inputs": "private"})
    assert all(one["n_met"] > other["n_met"] for one, other in zip(rows, paced, strict=True))


def test_a_release_model_without_accounts_is_refused():
    release = make_release(make_config(SHORT, {"privacy": {"preset": "corrected"}}))
    with pytest.raises(ValueError, match=r"privacy\.preset must keep account .* got 'corrected'"):
        Contributions(SimpleNamespace(release=release))


class Process:
    """Two episodes of one mainline segment and a ramp, whose estimates miss by given errors."""

    n_episodes = 2

    def __init__(self):
        self.elapsed = np.array([61, 61])
        self.estimate = None
        self.interface = SimpleNamespace(queries=SimpleNamespace(n_mainline=1))

    def play(self, errors, occupied=True):
        truth = np.zeros((2, 2, 2))
        truth[..., 0], truth[..., 1] = (30.0 if occupied else 0.0), 90.0
        self.truth = lambda _: truth
        off = np.array(errors)[:, None]
        ones = np.ones((2, 2))
        self.estimate = Estimate(truth[..., 0] + off, truth[..., 1] - off, 2 * ones, 4 * ones)


def test_deviations_are_held_against_errors():
    process = Process()
    watcher = Honesty(process)
    for errors in ([1.0, 4.0], [1.0, 0.0]):
        process.play(errors)
        watcher()
    first, second = watcher.rows()
    assert first["chi2_density"] == pytest.approx(0.25)
    assert first["chi2_speed"] == pytest.approx(1 / 16)
    assert second["chi2_density"] == pytest.approx(0.5 * (2.0**2 + 0.0))
    process.elapsed[:] = 60  # nor does the warm-up count
    process.play([50.0, 50.0])
    watcher()
    assert watcher.rows() == [first, second]
    process.elapsed[:] = 62  # nor speeds of empty segments
    process.play([1.0, 1.0], occupied=False)
    watcher()
    assert watcher.rows()[0] == pytest.approx(first)
