import numpy as np
import pytest

from dptse_env.model.calibration import calibrate, starting_parameters
from dptse_env.model.compiled import CompiledARZModel
from dptse_env.model.prediction import TrafficSeries, persistence_error, prediction_error

from .roads import HIGHWAY, PAPER
from .series import simulated


@pytest.fixture(scope="module")
def data():
    return [simulated(0), simulated(1)]


def test_equilibrium_traffic_gives_its_own_parameters_back():
    density = np.linspace(5.0, 320.0, 400)[:, None] * np.ones((1, 19))
    density[:, 15:] /= 3.0
    speed = 110.0 * (1.0 - (density[:, :1] / 333.0) ** 1.2) * np.ones((1, 19))
    series = TrafficSeries(density, speed, density[:, :6], speed[:, :6])
    start = starting_parameters(HIGHWAY, [series])
    assert start.free_flow_speed == pytest.approx(110.0, rel=0.02)
    assert start.jam_density == pytest.approx(333.0, rel=0.05)
    assert start.gamma == pytest.approx(1.2, rel=0.05)


@pytest.mark.slow
def test_calibration_finds_a_model_that_predicts_well(data):
    found = calibrate(
        HIGHWAY, data, "fit", start=PAPER, horizons=(5, 15), stride=10, max_evaluations=150
    )
    wrong = prediction_error(CompiledARZModel(HIGHWAY, PAPER), data, (5, 15), 10)
    assert found.parameters.name == "fit"
    assert found.loss < 0.25
    assert found.error.density[1] < 0.3 * wrong.density[1]
    assert set(found.at_bounds) <= {"free_flow_speed", "jam_density", "gamma", "relaxation_time"}
    assert found.persistence == persistence_error(data, 15, (5, 15), 10)
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
