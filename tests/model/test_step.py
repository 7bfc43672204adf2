"""The compiled step and its Jacobian beside the oracle."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dptse_env.model import ARZModel
from dptse_env.model.step import advance, make_scratch, normalise
from tests.helpers import compiled, pairwise

from .oracle import Oracle
from .roads import HIGHWAY, NO_RELAXATION, PAPER, ROADS, STRAIGHT, W99, random_inputs, random_states

advance = compiled(advance)
make_scratch = compiled(make_scratch)
normalise = compiled(normalise)


@pytest.mark.parametrize(
    ("road", "parameters", "demand"), pairwise(ROADS, [PAPER, W99, NO_RELAXATION], [False, True])
)
@example(seed=405074828)  # a gap w - v of one rounding, whose power has a steep derivative
@given(seed=st.integers(0, 2**32 - 1))
def test_equals_the_oracle(road, parameters, demand, seed):
    model = ARZModel(ROADS[road], parameters, demand_states=demand)
    oracle, rng, scale = (
        Oracle(ROADS[road], parameters),
        np.random.default_rng(seed),
        model.state_scale,
    )
    states, inputs = random_states(model, 4, rng), random_inputs(model, 4, rng)
    expected = oracle.step(states, inputs)
    np.testing.assert_allclose(model.step(states, inputs) / scale, expected / scale, atol=1e-12)

    by_scale = scale[None, :] / scale[:, None]
    expected = oracle.jacobian(states, inputs) * by_scale
    # Where a rounding of the state alone changes a derivative, it may do so between the two.
    rounded = [oracle.jacobian(states * (1.0 + e), inputs) * by_scale for e in (4e-16, -4e-16)]
    slack = np.max([np.abs(one - expected) for one in rounded], axis=0)
    error = np.abs(model.jacobian(states, inputs) * by_scale - expected)
    np.testing.assert_array_less(error, 1e-11 * (1.0 + np.abs(expected)) + 10.0 * slack)


def test_stays_equal_over_an_episode():
    model, oracle, rng = ARZModel(HIGHWAY, W99), Oracle(HIGHWAY, W99), np.random.default_rng(7)
    a = b = random_states(model, 2, rng)
    for _ in range(300):
        inputs = random_inputs(model, 2, rng)
        a, b = oracle.step(a, inputs), model.step(b, inputs)
    np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9)


def test_standing_traffic_takes_the_derivative_of_moving_traffic():
    """The cone's edge v = 0 is a kink; rounding must not choose the side."""
    model = ARZModel(STRAIGHT, PAPER)
    at_rest = model.states(np.full((1, 15), 200.0), np.zeros((1, 15)))
    inputs = np.array([[1000.0, 102.0, 150.0]])
    below, at, above = (model.jacobian(at_rest * (1.0 + e), inputs) for e in (-1e-14, 0.0, 1e-14))
    np.testing.assert_allclose(below, at, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(above, at, rtol=1e-9, atol=1e-9)
    assert (at[0, 2 * np.arange(14), 2 * np.arange(1, 15) + 1] != 0.0).all()


def test_a_batch_equals_a_loop_to_the_bit_and_leaves_its_arguments_alone():
    model, rng = ARZModel(HIGHWAY, PAPER), np.random.default_rng(8)
    states, inputs = random_states(model, 32, rng), random_inputs(model, 32, rng)
    kept = states.copy()
    after, jacobian = model.step(states[::2], inputs[::2]), model.jacobian(states[::2], inputs[::2])
    np.testing.assert_array_equal(states, kept)
    for i in range(16):
        one = slice(2 * i, 2 * i + 1)
        np.testing.assert_array_equal(model.step(states[one], inputs[one])[0], after[i])
        np.testing.assert_array_equal(model.jacobian(states[one], inputs[one])[0], jacobian[i])


def test_a_kernel_may_overwrite_its_state():
    model, rng = ARZModel(HIGHWAY, PAPER), np.random.default_rng(10)
    states, inputs = random_states(model, 1, rng), random_inputs(model, 1, rng)
    state, blocks = states[0].copy(), np.empty((*model.road.neighbours.shape, 4))
    advance(model.road, state, inputs[0], state, blocks, make_scratch(model.road))
    np.testing.assert_array_equal(state, model.step(states, inputs)[0])


def test_normalised_derivatives_are_those_between_normalised_states():
    model, rng = ARZModel(HIGHWAY, W99, demand_states=True), np.random.default_rng(12)
    states, inputs = random_states(model, 1, rng), random_inputs(model, 1, rng)
    expected = model.jacobian(states, inputs)[0] * model.state_scale / model.state_scale[:, None]
    road, scratch = model.road, make_scratch(model.road)
    blocks, after = np.empty((*road.neighbours.shape, 4)), np.empty(model.n_states)
    advance(road, states[0], inputs[0], after, blocks, scratch)
    normalise(road, model.density_scale, blocks, scratch.by_factor)
    pairs = expected[:38, :38].reshape(19, 2, 19, 2)
    for c, slot in np.argwhere(road.neighbours >= 0):
        block = pairs[c, :, road.neighbours[c, slot]]
        np.testing.assert_allclose(blocks[c, slot].reshape(2, 2), block, rtol=1e-12, atol=1e-15)
    for e, c in enumerate(road.entries):
        by_factor = expected[2 * c : 2 * c + 2, 38 + e]
        np.testing.assert_allclose(scratch.by_factor[e], by_factor, rtol=1e-12)


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))]
)
def test_a_copy_of_a_model_steps_alike(duplicate):
    model, rng = ARZModel(HIGHWAY, W99, demand_states=True), np.random.default_rng(11)
    states, inputs = random_states(model, 4, rng), random_inputs(model, 4, rng)
    after = model.step(states, inputs)
    np.testing.assert_array_equal(duplicate(model).step(states, inputs), after)
