"""The model of many states at once beside the oracle, and beside `ARZModel`."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.model import ARZModel
from dptse_env.model.columns import (
    advance_states,
    make_batch_scratch,
    measured_speeds,
    project_states,
    released_by_states,
)
from tests.cases import pairwise
from tests.estimators.parts import compiled

from .oracle import Oracle
from .roads import HIGHWAY, PAPER, ROADS, UNEVEN, W99, random_inputs, random_states

advance_states = compiled(advance_states)
make_batch_scratch = compiled(make_batch_scratch)
measured_speeds = compiled(measured_speeds)
project_states = compiled(project_states)
released_by_states = compiled(released_by_states)

WIDTH = 104
everywhere = pytest.mark.parametrize(
    ("road", "parameters"), [(HIGHWAY, PAPER), (UNEVEN, W99)], ids=["highway", "uneven"]
)


def advanced(model, states, inputs):
    columns = states.T.copy()
    advance_states(model.road, columns, inputs, make_batch_scratch(model.road, len(states)))
    return columns.T


def scattered(model, rng):
    """States within bounds and beyond."""
    states = random_states(model, WIDTH, rng)
    states *= 1.0 + 0.5 * rng.normal(size=states.shape)
    return states + 0.1 * model.state_scale * rng.normal(size=states.shape)


@pytest.mark.parametrize(
    ("road", "parameters", "demand"), pairwise(ROADS, [PAPER, W99], [False, True])
)
def test_advances_as_the_oracle(road, parameters, demand):
    model = ARZModel(ROADS[road], parameters, demand_states=demand)
    oracle, rng, scale = (
        Oracle(model.network, parameters),
        np.random.default_rng(0),
        model.state_scale,
    )
    for _ in range(50):
        states, inputs = random_states(model, WIDTH, rng), random_inputs(model, 1, rng)
        expected = oracle.step(states, np.repeat(inputs, WIDTH, axis=0))
        actual = advanced(model, states, inputs[0])
        np.testing.assert_allclose(actual / scale, expected / scale, atol=1e-12)


@everywhere
@pytest.mark.parametrize("bounds", ["cone", "box"])
def test_projects_as_the_model_does(road, parameters, bounds):
    model, rng = ARZModel(road, parameters, demand_states=True), np.random.default_rng(0)
    for _ in range(10):
        states = scattered(model, rng)
        columns, expected = states.T.copy(), model.project(states, bounds)
        project_states(model.road, columns, bounds == "box")
        scale = model.state_scale
        np.testing.assert_allclose(columns.T / scale, expected / scale, atol=1e-13)
        assert (model.demand_factors(expected) != model.demand_factors(states)).any()


@everywhere
@pytest.mark.parametrize("reference_speed", [None, 51.0])
def test_releases_what_the_model_measures(road, parameters, reference_speed):
    """States with negative components among them, as those of members ahead of a projection."""
    model, rng = (
        ARZModel(road, parameters, reference_speed=reference_speed),
        np.random.default_rng(0),
    )
    states, out, v_f = scattered(model, rng), np.empty(WIDTH), parameters.free_flow_speed
    centre = rng.uniform(0.0, 100.0, model.n_segments)
    released, speeds = model.measure(states, centre)[..., 1], model.traffic(states)[..., 1]
    for s, jam in enumerate(model.jam_density):
        pair = (np.ascontiguousarray(states[:, 2 * s + i]) for i in range(2))
        rho, psi = pair
        v_0 = np.nan if reference_speed is None else centre[s]
        released_by_states(model.road, s, rho, psi, v_0, out)
        atol = 1e-9 * model.measurement_scale[1]
        np.testing.assert_allclose(out, released[:, s], rtol=0.0, atol=atol)
        measured_speeds(rho, psi, jam, v_f, parameters.gamma, out)
        np.testing.assert_allclose(out, speeds[:, s], rtol=1e-12, atol=1e-9 * v_f)
    assert (states[:, 0::2] < 0.0).any()


@everywhere
def test_what_is_not_finite_stays_so_in_its_column(road, parameters):
    model, rng = ARZModel(road, parameters), np.random.default_rng(0)
    states, inputs = random_states(model, WIDTH, rng), random_inputs(model, 1, rng)[0]
    clean, rows = advanced(model, states, inputs), np.arange(model.n_states)
    states[rows, rows] = np.nan
    after = advanced(model, states, inputs)
    assert np.isnan(after[: rows.size]).any(axis=1).all()
    np.testing.assert_array_equal(after[rows.size :], clean[rows.size :])
    for is_box in (False, True):
        columns = states.T.copy()
        project_states(model.road, columns, is_box)
        assert np.isnan(columns[rows, rows]).all()


@everywhere
def test_inputs_that_are_not_finite_reach_every_column(road, parameters):
    """Demand, w, the density behind the exit, and an on-ramp's: NaN in, NaN out."""
    model, rng = ARZModel(road, parameters), np.random.default_rng(0)
    for column in range(5):
        inputs = random_inputs(model, 1, rng)[0]
        inputs[column] = np.nan
        after = advanced(model, random_states(model, WIDTH, rng), inputs)
        assert np.isnan(after).any(axis=1).mean() > 0.5


def test_widths_that_are_no_whole_vector_agree():
    model = ARZModel(HIGHWAY, replace(PAPER, name="other", gamma=1.7))
    rng, scale = np.random.default_rng(0), model.state_scale
    states, inputs = random_states(model, WIDTH, rng), random_inputs(model, 1, rng)[0]
    whole = advanced(model, states, inputs)
    for width in (1, 3, 7, 77):
        part = advanced(model, states[:width], inputs)
        np.testing.assert_allclose(part / scale, whole[:width] / scale, atol=1e-13)
