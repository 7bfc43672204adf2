import numpy as np
import pytest

from dptse_env.rewards import Reward, estimation_error

SCALES = {"density_scale": 100.0, "speed_scale": 50.0}


def error_of(density_error, speed_error, occupied=(True, True)):
    density = np.where(occupied, 30.0, 0.0)[None]
    speed = np.full((1, 2), 80.0)
    return estimation_error(
        density, speed, density + np.array([density_error]), speed + np.array([speed_error])
    )


def test_errors_are_root_mean_squares_over_the_mainline():
    error = error_of((3.0, 4.0), (6.0, 8.0))
    assert error.density[0] == pytest.approx(np.sqrt(12.5))
    assert error.speed[0] == pytest.approx(np.sqrt(50.0))
    assert error.n_occupied.tolist() == [2]


def test_an_empty_segment_has_no_speed_to_get_wrong():
    error = error_of((3.0, 4.0), (6.0, 1000.0), occupied=(True, False))
    assert error.density[0] == pytest.approx(np.sqrt(12.5))
    assert error.speed[0] == pytest.approx(6.0)


def test_an_empty_road_gives_finite_numbers():
    error = error_of((0.0, 0.0), (6.0, 8.0), occupied=(False, False))
    assert error.speed.tolist() == [0.0]
    assert Reward("joint", 2, **SCALES).value(error).tolist() == [0.0]


def test_terms():
    error = error_of((30.0, 40.0), (6.0, 8.0), occupied=(True, False))
    assert Reward("density", 2, **SCALES).value(error)[0] == pytest.approx(-np.sqrt(0.125))
    assert Reward("speed", 2, **SCALES).value(error)[0] == pytest.approx(-0.12)
    pooled = -np.sqrt((0.3**2 + 0.4**2 + 0.12**2) / 3)
    assert Reward("joint", 2, **SCALES).value(error)[0] == pytest.approx(pooled)
