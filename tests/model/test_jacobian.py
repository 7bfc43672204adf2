import numpy as np
import pytest

from dptse_env.model.compiled import CompiledARZModel
from tests.cases import pairwise

from .roads import (
    HIGHWAY,
    PAPER,
    STRAIGHT,
    UNEVEN,
    W99,
    Road,
    model_of,
    random_inputs,
    random_states,
)

ROADS = {
    "highway": HIGHWAY,
    "straight": STRAIGHT,
    "uneven": UNEVEN,
    "ramps side by side": Road(on_ramps=(3, 5), off_ramps=(4,), exit_shares=(0.2,)),
    "wide ramps": Road(
        n_mainline=6, on_ramps=(2,), off_ramps=(4,), exit_shares=(0.5,), ramp_lanes=3
    ),
}


@pytest.mark.parametrize(("road", "parameters"), pairwise(ROADS, [PAPER, W99], n=5))
def test_equals_central_differences_away_from_kinks(road, parameters):
    model = model_of(ROADS[road], parameters)
    rng = np.random.default_rng(11)
    # Occupied, moving traffic: vacuum and standing cells are kinks themselves.
    density = rng.uniform(0.02, 0.9, (400, model.n_segments)) * model.jam_density
    largest = 1.1 * parameters.free_flow_speed - model.relations.pressure(
        density, model.jam_density
    )
    states = model.states(density, rng.uniform(0.05, 0.95, density.shape) * largest)
    inputs = random_inputs(model, 400, rng)

    scale = np.tile(
        [model.density_scale, model.density_scale * model.speed_scale], density.shape[1]
    )
    jacobian = model.jacobian(states, inputs) * scale[None, :] / scale[:, None]

    def differences(h):
        columns = [
            (model.step(states + e, inputs) - model.step(states - e, inputs)) / (2.0 * h)
            for e in np.diag(h * scale)
        ]
        return np.stack(columns, axis=-1) / scale[:, None]

    numeric, wider = differences(1e-7), differences(2e-7)
    # Where two step sizes disagree a kink lies between the points.
    smooth = np.abs(numeric - wider) < 1e-5 * (1.0 + np.abs(numeric))
    assert smooth.mean() > 0.999
    error = np.abs(jacobian - numeric) / (1.0 + np.abs(numeric))
    # A kink within both steps hides from the comparison of the two: count instead of forbid.
    assert np.mean(error[smooth] > 1e-5) < 1e-6
    assert np.quantile(error, 0.999) < 1e-6


@pytest.mark.parametrize("road", ROADS.values(), ids=ROADS.keys())
def test_has_the_sparsity_of_the_network(road):
    model = model_of(road)
    rng = np.random.default_rng(12)
    states, inputs = random_states(model, 500, rng), random_inputs(model, 500, rng)
    jacobian = model.jacobian(states, inputs)
    allowed = np.kron(model.layout.sparsity(), np.ones((2, 2), dtype=bool))
    assert np.all(jacobian[:, ~allowed] == 0.0)
    used = np.any(jacobian != 0.0, axis=0).reshape(model.n_segments, 2, -1, 2).any(axis=(1, 3))
    np.testing.assert_array_equal(used, model.layout.sparsity())


def test_standing_traffic_takes_the_derivative_of_moving_traffic():
    """The cone's edge v = 0 is a kink; rounding must not choose the side."""
    density = np.full((1, 15), 200.0)
    at_rest = model_of(STRAIGHT).states(density, np.zeros((1, 15)))
    inputs = np.array([[1000.0, 102.0, 150.0]])
    for model in (model_of(STRAIGHT), CompiledARZModel(STRAIGHT, PAPER)):
        nudged = [at_rest * (1.0 + e) for e in (-1e-14, 0.0, 1e-14)]
        jacobians = [model.jacobian(states, inputs) for states in nudged]
        for jacobian in jacobians[1:]:
            np.testing.assert_allclose(jacobian, jacobians[0], rtol=1e-9, atol=1e-9)
