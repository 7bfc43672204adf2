import math

import gymnasium as gym
import numpy as np
import polars as pl
import pytest

from agents.environments import make_config
from agents.statistics import mean_interval
from agents.studies.guarantees import (
    met_epsilon,
    paid,
    priced,
    report,
)
from agents.study import read_rows
from agents.tables import DENSITY, format_interval, values
from dptse_env.parts import privacy_report
from dptse_env.privacy import epsilon_of
from dptse_env.schedules import make_schedule
from tests.helpers import SHORT


@pytest.fixture(scope="module")
def rows(results):
    return read_rows("guarantees", results / "guarantees")


def line_of(text, start):
    """Return the numbers of the first line of a table that begins so."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {start} |"))
    return [each.strip() for each in line[1:-1].split("|")]


def test_a_cell_that_was_not_played_is_a_dash(rows, tmp_path):
    own = paid(estimator="random_walk", release="capped")
    few = rows.filter(pl.col("cell").is_in([priced("random_walk").id, own.id]))
    text = report(few, tmp_path)
    expected = format_interval(mean_interval(values(rows, own.labels, DENSITY)))
    assert line_of(text, "9. `capped`, random walk, `round-robin` (4)")[2:4] == [expected, "-"]
    # Nor are labels of a part that was not played at all columns of the rows.
    few = rows.filter(pl.col("cell") == priced("random_walk").id)
    few = few.select(name for name in few.columns if not few[name].null_count())
    text = report(few, tmp_path)
    assert line_of(text, "1. `capped`, EKF, `shift-ahead` (1)")[2:] == ["-"] * 5
    assert line_of(text, "random walk, nominal")[2] == "27.62 [26.08, 29.16]"
    assert not list(tmp_path.iterdir())
    # What a cell guarantees is known without playing it; true boundary inputs void it.
    lines = ("EKF, private", "EKF, true", "11. no noise, EKF, `round-robin` (3)")
    assert [line_of(text, each)[1] for each in lines] == ["ε = 5, δ = 0.05", "none", "none"]


def test_epsilon_is_that_of_the_sums_of_two_vehicles():
    own = priced("ekf", "`printed` noise", epsilon=1.0)
    config = make_config(own.env, own.keywords)
    density_std, speed_std = (each.noise_std for each in privacy_report(config).releases)
    # sqrt(2 C) vehicles on 100 m, by hand, and sqrt(2 C) speed limits.
    density, speed = math.sqrt(128) / 0.1 / density_std, math.sqrt(128) * 102.0 / speed_std
    assert met_epsilon(config) == pytest.approx(epsilon_of(density, 0.05))
    alone = epsilon_of(math.hypot(density, speed), 0.05)
    assert met_epsilon(config, alone=True) == pytest.approx(alone)


def test_exact_releases_the_true_densities_of_what_is_queried_and_claims_nothing():
    keywords = {**paid(release="exact").keywords, "traffic_seeds": [2000], "truth_in_info": True}
    env = gym.make(SHORT, disable_env_checker=True, **keywords)
    schedule, n = make_schedule("round-robin", env), env.unwrapped.interface.queries.n_mainline
    observation, _ = env.reset(seed=2000, options={"traffic_seed": 2000})
    state, largest = None, 0.0
    for _ in range(120):
        action, state = schedule.predict(observation, state)
        observation, _, _, _, info = env.step(action)
        truth = info["true_density"][:n][info["queried"]]
        released = env.unwrapped.process.released[0, :n, 0][info["queried"]]
        np.testing.assert_allclose(released, truth, atol=0.1)
        largest = max(largest, *truth)
    assert largest > 10.0
    assert math.isinf(info["spent_epsilon"])
    report = privacy_report(make_config(SHORT, paid(release="exact").keywords))
    assert (report.guarantee, report.void_reasons) == ("none", ("not_stated",))
