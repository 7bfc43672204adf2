"""Demand states: factors on the demands of the entries, at the end of the model's state."""

import numpy as np
import pytest

from dptse_env.model.compiled import CompiledARZModel
from dptse_env.model.model import ARZModel

from .roads import HIGHWAY, PAPER, W99, random_inputs, random_states

MODELS = [ARZModel, CompiledARZModel]


def with_factors(model, n, rng):
    states = random_states(model, n, rng)
    model.demand_factors(states)[:] = rng.uniform(0.1, 3.0, (n, model.n_demand_states))
    return states


@pytest.mark.parametrize("model_type", MODELS)
@pytest.mark.parametrize("parameters", [PAPER, W99])
def test_a_factor_multiplies_the_demand_and_stays(model_type, parameters):
    rng = np.random.default_rng(0)
    model = model_type(HIGHWAY, parameters, demand_states=True)
    plain = model_type(HIGHWAY, parameters)
    assert (model.n_demand_states, model.n_states) == (3, plain.n_states + 3)
    states, inputs = with_factors(model, 50, rng), random_inputs(model, 50, rng)
    scaled = inputs.copy()
    scaled[:, model.layout.entry_inputs] *= model.demand_factors(states)
    after, traffic = model.step(states, inputs), states[:, : plain.n_states]
    np.testing.assert_allclose(after[:, : plain.n_states], plain.step(traffic, scaled), rtol=1e-12)
    np.testing.assert_array_equal(model.demand_factors(after), model.demand_factors(states))
    np.testing.assert_array_equal(model.density(states), plain.density(traffic))


@pytest.mark.parametrize("model_type", MODELS)
def test_the_jacobian_has_the_derivatives_by_the_factors(model_type):
    rng = np.random.default_rng(1)
    model = model_type(HIGHWAY, W99, demand_states=True)
    states, inputs = with_factors(model, 30, rng), random_inputs(model, 30, rng)
    jacobian, n = model.jacobian(states, inputs), 2 * model.n_segments
    for factor in range(model.n_demand_states):
        step = np.zeros(model.n_states)
        step[n + factor] = 1e-6
        numeric = (model.step(states + step, inputs) - model.step(states - step, inputs)) / 2e-6
        smooth = np.abs(jacobian[:, :, n + factor] - numeric).max(axis=1) < 1e-3
        assert smooth.mean() > 0.9  # the others lie at a kink
        assert np.abs(jacobian[:, :, n + factor]).max() > 1.0
    np.testing.assert_allclose(
        jacobian, ARZModel(HIGHWAY, W99, demand_states=True).jacobian(states, inputs), atol=1e-9
    )


@pytest.mark.parametrize("bounds", ["cone", "box"])
def test_factors_are_projected_into_their_bounds(bounds):
    model = ARZModel(HIGHWAY, W99, demand_states=True)
    states = random_states(model, 2, np.random.default_rng(2))
    model.demand_factors(states)[:] = [[-1.0, 0.5, 9.0], [0.05, 1.0, 3.0]]
    projected = model.demand_factors(model.project(states, bounds))
    np.testing.assert_array_equal(projected, [[0.1, 0.5, 3.0], [0.1, 1.0, 3.0]])


def test_states_begin_at_a_factor_of_one_and_scales_fit():
    model = ARZModel(HIGHWAY, W99, demand_states=True)
    states = model.states(np.ones((2, 19)), np.ones((2, 19)))
    np.testing.assert_array_equal(model.demand_factors(states), np.ones((2, 3)))
    np.testing.assert_array_equal(model.state_scale[-3:], np.ones(3))
    assert model.state_scale.shape == (model.n_states,)
