"""The compiled step, its Jacobian and its rows of measurements beside the oracle and the model."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dptse_env.model import ARZModel, Channels
from dptse_env.model.step import advance, make_scratch, write_channel
from tests.helpers import UNEVEN, compiled, make_channels, pairwise

from .oracle import (
    CHANNELS,
    HIGHWAY,
    NO_RELAXATION,
    PUBLISHED,
    ROADS,
    STRAIGHT,
    W99,
    Oracle,
    random_inputs,
    random_states,
    scattered_states,
)

advance, make_scratch, write_channel = map(compiled, (advance, make_scratch, write_channel))


@pytest.mark.parametrize(
    ("road", "parameters", "memory"),
    pairwise(ROADS, [PUBLISHED, W99, NO_RELAXATION], [None, 20.0]),
)
@example(seed=405074828)  # a gap w - v of one rounding, whose power has a steep derivative
@given(seed=st.integers(0, 2**32 - 1))
def test_equals_the_oracle(road, parameters, memory, seed):
    model = ARZModel(ROADS[road].road, parameters, demand_memory=memory)
    oracle, rng = Oracle(ROADS[road], parameters, demand_memory=memory), np.random.default_rng(seed)
    scale = model.state_scale
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


def test_standing_traffic_takes_the_derivative_of_moving_traffic():
    """The cone's edge v = 0 is a kink; rounding must not choose the side."""
    model = ARZModel(STRAIGHT.road, PUBLISHED)
    at_rest = model.states(np.full((1, 15), 200.0), np.zeros((1, 15)))
    inputs = np.array([[1000.0, 102.0, 150.0]])
    below, at, above = (model.jacobian(at_rest * (1.0 + e), inputs) for e in (-1e-14, 0.0, 1e-14))
    np.testing.assert_allclose(below, at, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(above, at, rtol=1e-9, atol=1e-9)
    assert (at[0, 2 * np.arange(14), 2 * np.arange(1, 15) + 1] != 0.0).all()


@pytest.mark.parametrize(
    ("road", "channels", "speed", "memory"),
    [
        (HIGHWAY, Channels.of_segments(HIGHWAY.road), None, None),
        (HIGHWAY, CHANNELS, 51.0, 20.0),
        (UNEVEN, make_channels((6, 0, 2), (2, 1, 3)), 51.0, None),
    ],
)
def test_a_kernels_channel_is_the_models_measurement_linearised(road, channels, speed, memory):
    """Empty segments and negative densities among them, as a filter may have."""
    model = ARZModel(road.road, W99, centre=speed, channels=channels, demand_memory=memory)
    rng = np.random.default_rng(2)
    states = scattered_states(model, 20, rng)
    assert (model.components(states)[0] < 0.0).any(axis=0).mean() > 0.8
    nowhere = np.full((20, model.n_segments), np.nan)
    centre = nowhere if speed is None else rng.uniform(0.0, 100.0, nowhere.shape)
    values = model.measure(states, centre) / model.measurement_scale
    matrix = model.measurement_matrix(states, centre) / model.measurement_scale[:, None]
    matrix *= model.state_scale
    weights, constants = np.full((2, 6), np.nan), np.empty(2)
    for i, state in enumerate(states):
        for m, (first, span) in enumerate(zip(channels.first, channels.span, strict=True)):
            write_channel(
                model.arz, channels, model.state_scale, state, centre[i], m, weights, constants
            )
            covered = slice(2 * first, 2 * (first + span))
            written, unit = weights[:, : 2 * span], model.state_scale[covered]
            np.testing.assert_allclose(written, matrix[i, m][:, covered], rtol=1e-12, atol=1e-12)
            found = written @ (state[covered] / unit) + constants
            np.testing.assert_allclose(found, values[i, m], rtol=1e-11, atol=1e-11)
