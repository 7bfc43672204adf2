"""The model of many states at once against `ARZModel`."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.model import ARZModel, load_parameters
from dptse_env.model.columns import (
    advance_states,
    make_batch_scratch,
    measured_speeds,
    project_states,
    released_by_states,
)
from dptse_env.model.model import make_road_arrays
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY
from tests.estimators.parts import compiled
from tests.model.roads import UNEVEN

advance_states = compiled(advance_states)
make_batch_scratch = compiled(make_batch_scratch)
measured_speeds = compiled(measured_speeds)
project_states = compiled(project_states)
released_by_states = compiled(released_by_states)

WIDTH = 104

everywhere = pytest.mark.parametrize(
    ("corridor", "parameters"),
    [
        (PAPER_HIGHWAY, load_parameters("w99-3lane")),
        (SHORT_HIGHWAY, load_parameters("paper")),
        (UNEVEN, load_parameters("w99-3lane")),
    ],
    ids=lambda value: value.name,
)


class UnusedExits:
    """A corridor whose off-ramps nobody takes, which its own checks refuse."""

    def __init__(self, corridor):
        self._corridor, self.exit_shares = corridor, (0.0,) * len(corridor.exit_shares)

    def __getattr__(self, name):
        return getattr(self._corridor, name)


def random_states(model, rng):
    """States all over the cone and beyond, with empty, jammed and standing cells among them."""
    shape, jam, v_f = (WIDTH, model.n_segments), model.jam_density, model.speed_scale
    density = rng.uniform(0.0, 1.0, shape) ** rng.choice([0.5, 2.0], (WIDTH, 1)) * jam
    speed = rng.uniform(0.0, 1.2, shape) * v_f
    kind = rng.random(shape)
    density[kind < 0.05] = 0.0
    speed[kind > 0.95] = 0.0
    states = model.states(density, speed)
    crowded = (kind > 0.05) & (kind < 0.1)
    states[:, 0::2] = np.where(crowded, jam, states[:, 0::2])
    states[0], states[1] = 0.0, model.states(jam[None], np.zeros((1, jam.size)))[0]
    return states


def random_inputs(model, rng):
    lanes = np.array(model.network.boundary_lanes) / max(model.network.boundary_lanes)
    density = rng.uniform(0.0, 1.2, (1, model.n_boundaries)) * lanes * model.density_scale
    density[rng.random(density.shape) < 0.1] = 0.0
    speed = rng.uniform(0.0, 1.0, density.shape) * model.speed_scale
    return model.boundary_inputs(density, speed)[0]


def advanced(model, states, inputs):
    road, swarm = make_road_arrays(model), states.T.copy()
    advance_states(road, swarm, inputs, make_batch_scratch(road, len(states)))
    return swarm.T


def unit(model):
    return np.tile([1.0, model.speed_scale], model.n_segments) * model.density_scale


@everywhere
def test_advances_as_the_model_steps(corridor, parameters):
    model, rng = ARZModel(corridor, parameters), np.random.default_rng(0)
    for _ in range(50):
        states, inputs = random_states(model, rng), random_inputs(model, rng)
        expected = model.step(states, np.repeat(inputs[None], WIDTH, axis=0))
        actual = advanced(model, states, inputs)
        np.testing.assert_allclose(actual / unit(model), expected / unit(model), atol=1e-12)


@everywhere
def test_an_off_ramp_that_nobody_takes_does_not_hold_traffic_up(corridor, parameters):
    nobody = UnusedExits(corridor)
    model, rng = ARZModel(nobody, parameters), np.random.default_rng(0)
    states, inputs = random_states(model, rng), random_inputs(model, rng)
    expected = model.step(states, np.repeat(inputs[None], WIDTH, axis=0))
    actual = advanced(model, states, inputs)
    np.testing.assert_allclose(actual / unit(model), expected / unit(model), atol=1e-12)


@everywhere
def test_projects_as_the_model_does(corridor, parameters):
    model, rng = ARZModel(corridor, parameters), np.random.default_rng(0)
    for bounds in 10 * ("cone", "box"):
        scatter = 1.0 + 0.5 * rng.normal(size=(WIDTH, model.n_states))
        states = random_states(model, rng) * scatter + 0.1 * unit(model) * rng.normal(
            size=scatter.shape
        )
        swarm = states.T.copy()
        project_states(make_road_arrays(model), swarm, bounds == "box")
        expected = model.project(states, bounds)
        np.testing.assert_allclose(swarm.T / unit(model), expected / unit(model), atol=1e-13)


def with_factors(model, states, rng):
    """The states and random factors on the demands, within their bounds and beyond."""
    factors = rng.uniform(-0.5, 4.0, (len(states), model.n_demand_states))
    return np.concatenate([states, factors], axis=1)


@everywhere
def test_demand_factors_scale_what_enters_and_stay(corridor, parameters):
    plain = ARZModel(corridor, parameters)
    model, rng = ARZModel(corridor, parameters, demand_states=True), np.random.default_rng(0)
    for _ in range(50):
        inputs = random_inputs(model, rng)
        states = model.project(with_factors(model, random_states(plain, rng), rng))
        expected = model.step(states, np.repeat(inputs[None], WIDTH, axis=0))
        actual = advanced(model, states, inputs)
        scale = model.state_scale
        np.testing.assert_allclose(actual / scale, expected / scale, atol=1e-12)
        np.testing.assert_array_equal(model.demand_factors(actual), model.demand_factors(states))
    ones = model.compose(*model.components(states))
    assert (np.abs(advanced(model, ones, inputs) - actual)[:, : 2 * model.n_segments] > 1e-3).any()


@everywhere
def test_projects_demand_factors_as_the_model_does(corridor, parameters):
    for bounds in ("cone", "box"):
        projects_demand_factors(corridor, parameters, bounds)


def projects_demand_factors(corridor, parameters, bounds):
    plain = ARZModel(corridor, parameters)
    model, rng = ARZModel(corridor, parameters, demand_states=True), np.random.default_rng(0)
    states = with_factors(model, random_states(plain, rng), rng)
    states[:, : 2 * model.n_segments] *= 1.0 + 0.5 * rng.normal(size=(WIDTH, plain.n_states))
    swarm = states.T.copy()
    project_states(make_road_arrays(model), swarm, bounds == "box")
    expected = model.project(states, bounds)
    scale = model.state_scale
    np.testing.assert_allclose(swarm.T / scale, expected / scale, atol=1e-13)
    assert (model.demand_factors(expected) != model.demand_factors(states)).any()


@everywhere
def test_measures_as_the_model_does(corridor, parameters):
    model, rng = ARZModel(corridor, parameters), np.random.default_rng(0)
    states = random_states(model, rng)
    expected = model.measure(states)[..., 1]
    out = np.empty(WIDTH)
    for s in range(model.n_segments):
        rho, psi = (np.ascontiguousarray(states[:, 2 * s + i]) for i in range(2))
        jam, v_f, gamma = model.jam_density[s], parameters.free_flow_speed, parameters.gamma
        measured_speeds(rho, psi, jam, v_f, gamma, out)
        np.testing.assert_allclose(out, expected[:, s], atol=1e-9 * v_f)


@everywhere
def test_releases_what_the_model_measures(corridor, parameters):
    """States with negative components among them, as those of members ahead of a projection."""
    for reference_speed in (None, 0.0, 51.0):
        model = ARZModel(corridor, parameters, reference_speed=reference_speed)
        v_0 = np.nan if reference_speed is None else reference_speed
        assert_releases(model, np.full(model.n_segments, v_0), model.measure)


@everywhere
def test_releases_flows_centred_on_a_speed_of_each_segment(corridor, parameters):
    model = ARZModel(corridor, parameters, reference_speed=51.0)
    centre = np.random.default_rng(1).uniform(0.0, 100.0, model.n_segments)
    assert_releases(model, centre, lambda states: model.measure(states, centre))


def assert_releases(model, centre, measure):
    road, rng = make_road_arrays(model), np.random.default_rng(0)
    states = random_states(model, rng)
    states += 0.02 * unit(model) * rng.normal(size=states.shape)
    expected = measure(states)[..., 1]
    out = np.empty(WIDTH)
    for s in range(model.n_segments):
        rho, psi = (np.ascontiguousarray(states[:, 2 * s + i]) for i in range(2))
        released_by_states(road, s, rho, psi, centre[s], out)
        np.testing.assert_allclose(out, expected[:, s], rtol=0.0, atol=1e-9 * road.second_scale)
    assert (states[:, 0::2] < 0.0).any()


@everywhere
def test_what_is_not_finite_stays_so_in_its_column(corridor, parameters):
    model, rng = ARZModel(corridor, parameters), np.random.default_rng(0)
    states, inputs = random_states(model, rng), random_inputs(model, rng)
    clean = advanced(model, states, inputs)
    rows = np.arange(model.n_states)
    poisoned = states[: rows.size].copy()
    poisoned[rows, rows] = np.nan
    after = advanced(model, np.concatenate([poisoned, states[rows.size :]]), inputs)
    assert np.isnan(after[: rows.size]).any(axis=1).all()
    np.testing.assert_array_equal(after[rows.size :], clean[rows.size :])
    for is_box in (False, True):
        swarm = poisoned.T.copy()
        project_states(make_road_arrays(model), swarm, is_box)
        assert np.isnan(swarm[rows, rows]).all()


@everywhere
def test_inputs_that_are_not_finite_reach_every_column(corridor, parameters):
    """Demand, w, the density behind the exit, and an on-ramp's: NaN in, NaN out."""
    model, rng = ARZModel(corridor, parameters), np.random.default_rng(0)
    for column in range(5):
        inputs = random_inputs(model, rng)
        inputs[column] = np.nan
        after = advanced(model, random_states(model, rng), inputs)
        assert np.isnan(after).any(axis=1).mean() > 0.5


def test_widths_that_are_no_whole_vector_agree():
    model = ARZModel(PAPER_HIGHWAY, replace(load_parameters("paper"), name="other", gamma=1.7))
    rng = np.random.default_rng(0)
    states, inputs = random_states(model, rng), random_inputs(model, rng)
    whole = advanced(model, states, inputs)
    for width in (1, 3, 7, 77):
        part = advanced(model, states[:width], inputs)
        np.testing.assert_allclose(part / unit(model), whole[:width] / unit(model), atol=1e-13)
