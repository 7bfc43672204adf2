"""Errors of predictions, and parameters that are fitted to runs of traffic of a known model."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.model import ARZModel
from dptse_env.model.calibration import (
    TrafficSeries,
    calibrate,
    persistence_error,
    prediction_error,
    starting_parameters,
)

from .oracle import HIGHWAY, PAPER

TRUTH = replace(PAPER, name="truth", free_flow_speed=110.0, gamma=1.2, relaxation_time=30.0)


def simulated(seed: int, n_steps: int = 240) -> TrafficSeries:
    """Waves of demand and a passing queue at the exit, by the model itself."""
    model, rng = ARZModel(HIGHWAY, TRUTH), np.random.default_rng(seed)
    t = np.arange(n_steps)[:, None]
    phase, slow = rng.uniform(0.0, 2 * np.pi, 6), rng.uniform(40.0, 80.0, 6)
    share = 0.25 + 0.2 * np.sin(2 * np.pi * t / slow + phase)
    share[n_steps // 3 : n_steps // 2, 1] = 0.9
    density = share * TRUTH.jam_density * np.array([3, 3, 1, 1, 1, 1]) / 3.0
    speed = TRUTH.free_flow_speed * (1.0 - share**TRUTH.gamma)
    inputs = model.boundary_inputs(density, speed)
    rows = [model.states(np.full((1, 19), 30.0), np.full((1, 19), 80.0))]
    for k in range(n_steps - 1):
        rows.append(model.step(rows[-1], inputs[k : k + 1]))
    history = np.concatenate(rows)
    return TrafficSeries(model.density(history), model.speed(history), density, speed)


@pytest.fixture(scope="module")
def data():
    return [simulated(0), simulated(1)]


def test_the_true_model_predicts_without_error_and_a_wrong_one_errs_the_more_the_further(data):
    error = prediction_error(ARZModel(HIGHWAY, TRUTH), data)
    assert error.horizons == (5, 10, 15, 20, 25, 30)
    assert max(*error.density, *error.speed) < 1e-6
    error = prediction_error(ARZModel(HIGHWAY, PAPER), data, (1, 7))
    assert error.density[1] > error.density[0] > 0.0
    assert error.speed[1] > error.speed[0] > 0.0


def test_persistence_is_the_root_mean_square_of_the_change(data):
    error = persistence_error(data, 15, horizons=(20,), stride=1)
    for found, field in ((error.density, "density"), (error.speed, "speed")):
        traffic = np.stack([getattr(series, field)[:, :15] for series in data])
        change = traffic[:, 20:] - traffic[:, :-20]
        assert found[0] == pytest.approx(np.sqrt(np.mean(change**2)))


def test_empty_segments_have_no_speed_and_do_no_harm():
    density = np.zeros((40, 19))
    density[:, 3] = 10.0
    speed = np.where(density > 0.0, 90.0, np.nan)
    series = TrafficSeries(density, speed, np.zeros((40, 6)), np.full((40, 6), np.nan))
    error = prediction_error(ARZModel(HIGHWAY, PAPER), [series], (5,))
    assert np.isfinite([*error.density, *error.speed]).all()
    assert persistence_error([series], 15, (5,)).speed == (0.0,)


def test_bad_series_and_horizons_are_named(data):
    good, model = data[0], ARZModel(HIGHWAY, PAPER)
    for changes, message in (
        ({"speed": good.speed[:-1]}, r"density and series\.speed must share a shape"),
        ({"boundary_density": -good.boundary_density}, "boundary_density must be finite and >= 0"),
        ({"speed": good.speed * np.nan}, "speed must be finite and >= 0 wherever"),
    ):
        with pytest.raises(ValueError, match=rf"series\.{message}"):
            replace(good, **changes)
    with pytest.raises(ValueError, match=r"horizons must be ascending steps >= 1, got \(5, 5\)"):
        prediction_error(model, data, (5, 5))
    with pytest.raises(ValueError, match="longer than the longest horizon of 500 steps, got 240"):
        prediction_error(model, data, (500,))
    with pytest.raises(ValueError, match="stride must be >= 1, got 0"):
        persistence_error(data, 15, (5,), 0)


def test_equilibrium_traffic_gives_its_own_parameters_back():
    density = np.linspace(5.0, 320.0, 400)[:, None] * np.ones((1, 19))
    density[:, 15:] /= 3.0
    speed = 110.0 * (1.0 - (density[:, :1] / 333.0) ** 1.2) * np.ones((1, 19))
    start = starting_parameters(
        HIGHWAY, [TrafficSeries(density, speed, density[:, :6], speed[:, :6])]
    )
    assert start.free_flow_speed == pytest.approx(110.0, rel=0.02)
    assert start.jam_density == pytest.approx(333.0, rel=0.05)
    assert start.gamma == pytest.approx(1.2, rel=0.05)


@pytest.mark.slow
def test_calibration_finds_a_model_that_predicts_well(data):
    horizons = (5, 15)
    found = calibrate(HIGHWAY, data, "fit", PAPER, horizons, stride=10, max_evaluations=150)
    wrong = prediction_error(ARZModel(HIGHWAY, PAPER), data, horizons, 10)
    assert found.parameters.name == "fit"
    assert found.loss < 0.25
    assert found.error.density[1] < 0.3 * wrong.density[1]
    assert set(found.at_bounds) <= {"free_flow_speed", "jam_density", "gamma", "relaxation_time"}
    assert found.persistence == persistence_error(data, 15, horizons, 10)
    lanes = np.array(HIGHWAY.segment_lanes)
    assert found.parameters.jam_density > max((s.density / lanes * 3).max() for s in data)


def test_a_fit_that_ends_at_a_bound_says_so():
    """Free traffic at one speed tells nothing of the jam, and speeds beyond the search's reach."""
    rng = np.random.default_rng(0)
    density = np.tile(rng.uniform(5.0, 60.0, (120, 1)), (1, 19))
    speed = np.full((120, 19), 25.0)
    series = TrafficSeries(density, speed, density[:, :6], speed[:, :6])
    found = calibrate(HIGHWAY, [series], "slow", start=PAPER, horizons=(5,), max_evaluations=200)
    assert "free_flow_speed" in found.at_bounds
