"""The model of many states at once beside the oracle, and beside `ARZModel`."""

import numpy as np
import pytest

from dptse_env.model import ARZModel
from dptse_env.model.columns import (
    advance_states,
    make_batch_scratch,
    measure_channel,
    project_states,
)
from dptse_env.model.step import project
from tests.helpers import UNEVEN, compiled, make_channels, pairwise

from .oracle import (
    HIGHWAY,
    PUBLISHED,
    ROADS,
    W99,
    Oracle,
    random_inputs,
    random_states,
    scattered_states,
)

advance_states, make_batch_scratch, measure_channel, project, project_states = map(
    compiled, (advance_states, make_batch_scratch, measure_channel, project, project_states)
)

WIDTH = 104
everywhere = pytest.mark.parametrize(
    ("road", "parameters"), [(HIGHWAY, PUBLISHED), (UNEVEN, W99)], ids=["highway", "uneven"]
)


def advanced(model, states, inputs):
    columns = states.T.copy()
    road, arz, _ = model.dynamics
    advance_states(road, arz, columns, inputs, make_batch_scratch(model.road, len(states)))
    return columns.T


@pytest.mark.parametrize(
    ("road", "parameters", "memory"), pairwise(ROADS, [PUBLISHED, W99], [None, 20.0])
)
def test_advances_as_the_oracle(road, parameters, memory):
    """Also where the states fill no whole vectors."""
    model = ARZModel(ROADS[road].road, parameters, demand_memory=memory)
    oracle, rng = Oracle(ROADS[road], parameters, demand_memory=memory), np.random.default_rng(0)
    for width in (WIDTH, 1, 3, 77) * 10:
        states, inputs = random_states(model, width, rng), random_inputs(model, 1, rng)
        expected = oracle.step(states, np.repeat(inputs, width, axis=0)) / model.state_scale
        found = advanced(model, states, inputs[0]) / model.state_scale
        np.testing.assert_allclose(found, expected, atol=1e-12)


@everywhere
@pytest.mark.parametrize("bounds", ["cone", "box"])
def test_kernels_project_one_state_and_many_as_the_model_does(road, parameters, bounds):
    model, rng = ARZModel(road.road, parameters, demand_memory=20.0), np.random.default_rng(0)
    for _ in range(10):
        states = scattered_states(model, WIDTH, rng)
        columns, expected = states.T.copy(), model.project(states, bounds)
        project_states(model.road, model.arz, columns, bounds == "box")
        assert (model.demand_factors(expected) != model.demand_factors(states)).any()
        for state in states:
            project(model.road, model.arz, state, bounds == "box")
        scale = model.state_scale
        np.testing.assert_allclose(columns.T / scale, expected / scale, atol=1e-13)
        np.testing.assert_allclose(states / scale, expected / scale, atol=1e-15)


@everywhere
@pytest.mark.parametrize("flows", [False, True])
def test_a_channel_of_many_states_is_what_the_model_measures(road, parameters, flows):
    """States with negative components among them, as those of members ahead of a projection."""
    span = (1, 2, 3) if flows else (1, 1, 1)
    n = len(road.geometry.segment_lengths)
    channels = make_channels((n - 1, 0, 2), span)
    model = ARZModel(road.road, parameters, centre=51.0 if flows else None, channels=channels)
    rng, width = np.random.default_rng(0), np.empty((3, WIDTH))
    states = scattered_states(model, WIDTH, rng)
    centre = rng.uniform(0.0, 100.0, n) if flows else np.full(n, np.nan)
    expected = model.measure(states, centre) / model.measurement_scale
    for m in range(3):
        measure_channel(model.arz, channels, m, states.T.copy(), centre, *width)
        found = width[:2].T / model.measurement_scale
        np.testing.assert_allclose(found, expected[:, m], atol=1e-9)
    assert (states[:, 0::2] < 0.0).any()


@everywhere
def test_what_is_not_finite_stays_so_in_its_column_or_reaches_all_as_an_input(road, parameters):
    model, rng = ARZModel(road.road, parameters), np.random.default_rng(0)
    states, inputs = random_states(model, WIDTH, rng), random_inputs(model, 1, rng)[0]
    clean, rows = advanced(model, states, inputs), np.arange(model.n_states)
    states[rows, rows] = np.nan
    after = advanced(model, states, inputs)
    assert np.isnan(after[: rows.size]).any(axis=1).all()
    np.testing.assert_array_equal(after[rows.size :], clean[rows.size :])
    for is_box in (False, True):
        columns = states.T.copy()
        project_states(model.road, model.arz, columns, is_box)
        assert np.isnan(columns[rows, rows]).all()
    for column in range(5):  # demand, w, the density behind the exit, and an on-ramp's two
        inputs = random_inputs(model, 1, rng)[0]
        inputs[column] = np.nan
        after = advanced(model, random_states(model, WIDTH, rng), inputs)
        assert np.isnan(after).any(axis=1).mean() > 0.5
