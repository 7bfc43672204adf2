"""Errors of estimates, and rewards of them."""

import numpy as np
import pytest

from dptse_env.spaces.rewards import ErrorReward, ScoredSecond, estimation_error
from dptse_env.traffic import SHORT_HIGHWAY, Demand

ROAD = SHORT_HIGHWAY.replaced(
    n_mainline=2, on_ramps=(), off_ramps=(), exit_shares=(), fixed_sensors=(),
    demand=Demand(((0.0, 1000.0),)), incident=None, density_scale=100.0, speed_scale=50.0,
)  # fmt: skip


def reward_of(term, error):
    nothing = np.zeros((1, 2))
    return ErrorReward(term)(ScoredSecond(error, nothing, nothing, None, nothing > 0, ROAD))


def error_of(density_error, speed_error, occupied=(True, True)):
    density = np.where(occupied, 0.5, 0.0)[None]
    speed = np.full((1, 2), 80.0)
    return estimation_error(
        density, speed, density + np.array([density_error]), speed + np.array([speed_error])
    )


def test_errors_are_root_mean_squares_over_the_mainline():
    error = error_of((3.0, 4.0), (6.0, 8.0))
    assert error.density[0] == pytest.approx(np.sqrt(12.5))
    assert error.speed[0] == pytest.approx(np.sqrt(50.0))
    assert error.n_occupied.tolist() == [2]
    error = error_of((3.0, 4.0), (6.0, 1000.0), occupied=(True, False))
    assert error.density[0] == pytest.approx(np.sqrt(12.5))
    assert error.speed[0] == pytest.approx(6.0)  # an empty segment has none to get wrong


def test_an_empty_road_gives_finite_numbers():
    error = error_of((0.0, 0.0), (6.0, 8.0), occupied=(False, False))
    assert error.speed.tolist() == [0.0]
    assert reward_of("joint", error).tolist() == [0.0]


def test_terms():
    error = error_of((30.0, 40.0), (6.0, 8.0), occupied=(True, False))
    assert reward_of("density", error)[0] == pytest.approx(-np.sqrt(0.125))
    assert reward_of("speed", error)[0] == pytest.approx(-0.12)
    pooled = -np.sqrt((0.3**2 + 0.4**2 + 0.12**2) / 3)
    assert reward_of("joint", error)[0] == pytest.approx(pooled)
