from dataclasses import replace

import numpy as np
import pytest

from dptse_env.model.compiled import CompiledARZModel
from dptse_env.model.model import ARZModel
from dptse_env.model.prediction import TrafficSeries, persistence_error, prediction_error

from .roads import HIGHWAY, PAPER
from .series import TRUTH, simulated


@pytest.fixture(scope="module")
def data():
    return [simulated(0), simulated(1)]


def test_the_true_model_predicts_without_error(data):
    error = prediction_error(CompiledARZModel(HIGHWAY, TRUTH), data)
    assert error.horizons == (5, 10, 15, 20, 25, 30)
    assert max(error.density) < 1e-6
    assert max(error.speed) < 1e-6


def test_both_backends_report_the_same_error(data):
    horizons = (1, 7)
    plain = prediction_error(ARZModel(HIGHWAY, PAPER), data, horizons)
    compiled = prediction_error(CompiledARZModel(HIGHWAY, PAPER), data, horizons)
    np.testing.assert_allclose(plain.density, compiled.density, rtol=1e-10)
    np.testing.assert_allclose(plain.speed, compiled.speed, rtol=1e-10)
    assert plain.density[1] > plain.density[0] > 0.0


def test_persistence_is_the_root_mean_square_of_the_change(data):
    error = persistence_error(data[:1], 15, horizons=(20,), stride=1)
    rho, v = data[0].density[:, :15], data[0].speed[:, :15]
    assert error.density[0] == pytest.approx(np.sqrt(np.mean((rho[20:] - rho[:-20]) ** 2)))
    assert error.speed[0] == pytest.approx(np.sqrt(np.mean((v[20:] - v[:-20]) ** 2)))


def test_empty_segments_have_no_speed_and_do_no_harm():
    density = np.zeros((40, 19))
    density[:, 3] = 10.0
    speed = np.where(density > 0.0, 90.0, np.nan)
    boundary = np.zeros((40, 6))
    series = TrafficSeries(density, speed, boundary, np.full((40, 6), np.nan))
    error = prediction_error(CompiledARZModel(HIGHWAY, PAPER), [series], (5,))
    assert np.isfinite([*error.density, *error.speed]).all()
    assert persistence_error([series], 15, (5,)).speed == (0.0,)


def test_bad_series_are_named(data):
    good = data[0]
    with pytest.raises(ValueError, match=r"series\.density and series\.speed must share a shape"):
        replace(good, speed=good.speed[:-1])
    with pytest.raises(ValueError, match=r"series\.boundary_density must be finite and >= 0"):
        replace(good, boundary_density=-good.boundary_density)
    with pytest.raises(ValueError, match=r"series\.speed must be finite and >= 0 wherever"):
        replace(good, speed=good.speed * np.nan)


def test_bad_horizons_are_named(data):
    model = ARZModel(HIGHWAY, PAPER)
    with pytest.raises(ValueError, match=r"horizons must be ascending steps >= 1, got \(5, 5\)"):
        prediction_error(model, data, (5, 5))
    with pytest.raises(ValueError, match="longer than the longest horizon of 500 steps, got 240"):
        prediction_error(model, data, (500,))
    with pytest.raises(ValueError, match="stride must be >= 1, got 0"):
        persistence_error(data, 15, (5,), 0)
