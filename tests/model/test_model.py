"""Measurements, bounds and boundary inputs of `ARZModel`."""

import numpy as np
import pytest

from dptse_env.model import ARZModel
from dptse_env.model.parameters import MEASUREMENT_FLOOR
from tests.helpers import pairwise

from .oracle import CHANNELS, HIGHWAY, PUBLISHED, W99, random_states

both_sets = pytest.mark.parametrize("parameters", [PUBLISHED, W99], ids=lambda p: p.name)


@both_sets
def test_measures_density_and_speed_of_segments_or_averages_of_flows_around_a_centre(parameters):
    model, rng = ARZModel(HIGHWAY.road, parameters), np.random.default_rng(5)
    density = rng.uniform(0.02, 0.9, (6, 19)) * model.jam_density
    speed, centre = rng.uniform(0.0, 100.0, (2, 6, 19))
    states, scale = model.states(density, speed), model.density_scale
    traffic = np.stack([density, speed], axis=-1)
    np.testing.assert_allclose(model.measure(states), traffic, atol=1e-9)
    np.testing.assert_allclose(model.density(states), density)
    np.testing.assert_allclose(model.speed(states), speed, atol=1e-9)
    np.testing.assert_array_equal(model.measurement_scale, [scale, model.speed_scale])
    flows = ARZModel(HIGHWAY.road, parameters, centre=51.0, channels=CHANNELS)
    for given, v_0 in ((None, 51.0), (centre, centre)):
        expected = flows.averages(np.stack([density, density * (speed - v_0)], axis=-1))
        np.testing.assert_allclose(flows.measure(states, given), expected, rtol=1e-9, atol=1e-6)
    np.testing.assert_array_equal(flows.measurement_scale, [scale, scale * model.speed_scale])
    # Density and speed stay what they are, for those who ask for these.
    np.testing.assert_allclose(flows.traffic(states), traffic, atol=1e-9)


@pytest.mark.parametrize(
    ("parameters", "release", "memory"),
    pairwise([PUBLISHED, W99], ["speeds", "flows", "rows"], [None, 20.0]),
)
def test_the_measurement_matrix_is_that_of_central_differences(parameters, release, memory):
    speed = None if release == "speeds" else 51.0
    model = ARZModel(
        HIGHWAY.road, parameters, centre=speed,
        channels=CHANNELS if release == "rows" else None, demand_memory=memory,
    )  # fmt: skip
    rng, floor = np.random.default_rng(1), MEASUREMENT_FLOOR * model.jam_density
    density = rng.uniform(0.0, 1.0, (20, 19)) ** 3 * model.jam_density
    density[np.abs(density - floor) < 1e-2] += 0.02
    states = model.states(np.maximum(density, 1e-3), rng.uniform(0.0, 100.0, (20, 19)))
    centre = None if release != "rows" else rng.uniform(0.0, 100.0, (20, 19))
    matrix = model.measurement_matrix(states, centre)
    for component in range(model.n_states):
        # A small step: below 1 veh/km the pressure of a gamma below 1 bends without bound.
        size = 1e-3 if component % 2 else 1e-6
        step = size * (np.arange(model.n_states) == component)
        change = model.measure(states + step, centre) - model.measure(states - step, centre)
        numeric = change / (2.0 * size)
        np.testing.assert_allclose(matrix[..., component], numeric, rtol=1e-4, atol=1e-3)


def test_impossible_sensors_are_refused():
    for bad in (-1.0, np.nan, np.inf, "fast"):
        with pytest.raises(ValueError, match=r"model\.centre must be .*, got "):
            ARZModel(HIGHWAY.road, PUBLISHED, centre=bad)
    with pytest.raises(ValueError, match=r"model\.channels must be segments"):
        ARZModel(HIGHWAY.road, W99, channels=CHANNELS)  # mean speeds have no sum


@both_sets
def test_the_cone_holds_speed_and_w_and_leaves_what_is_inside_alone(parameters):
    model, rng = ARZModel(HIGHWAY.road, parameters), np.random.default_rng(2)
    states = model.project(rng.normal(0.0, 3.0, (200, 38)) * model.state_scale)
    density, psi = model.components(states)
    w = psi / density
    assert np.all((density >= 1.0) & (density <= model.jam_density))
    assert np.all(model.pressure(density) - w <= 1e-9)
    assert np.all(w <= 1.1 * parameters.free_flow_speed * (1.0 + 1e-12))
    assert np.all(w >= 0.4 * parameters.free_flow_speed * (1.0 - 1e-12))
    np.testing.assert_array_equal(model.project(states), states)
    states = random_states(model, 50, rng)
    density, psi = model.components(states)
    inside = (density >= 1.0) & (psi >= 0.4 * model.speed_scale * density)
    assert 0.5 < inside.mean() < 1.0
    moved = np.abs(model.project(states) - states).reshape(50, 19, 2)[inside]
    assert moved.max() < 1e-9


def test_the_box_is_the_papers_and_factors_have_bounds_of_their_own():
    model = ARZModel(HIGHWAY.road, PUBLISHED, demand_memory=20.0)
    assert (model.n_demand_states, model.n_states) == (3, 41)
    np.testing.assert_array_equal(model.state_scale[-3:], np.ones(3))
    wild = np.random.default_rng(3).normal(0.0, 3.0, (200, 41)) * model.state_scale
    upper = np.stack([model.jam_density, 102.0 * model.jam_density], -1).ravel()
    projected = model.project(wild, "box")
    np.testing.assert_array_equal(projected[:, :38], np.clip(wild[:, :38], 0.0, upper))
    for bounds in ("cone", "box"):
        factors = model.demand_factors(model.project(wild, bounds))
        np.testing.assert_array_equal(factors, np.clip(wild[:, 38:], 0.1, 3.0))
    begun = model.states(np.ones((2, 19)), np.ones((2, 19)))
    np.testing.assert_array_equal(model.demand_factors(begun), np.ones((2, 3)))
    with pytest.raises(ValueError, match="bounds must be 'cone' or 'box', got 'sphere'"):
        model.project(begun, "sphere")


def test_boundary_inputs_follow_the_order_of_the_input_vector():
    model = ARZModel(HIGHWAY.road, PUBLISHED)
    jam = model.arz.jam[model.road.entry_cells]
    np.testing.assert_allclose(jam, [333.0, 111.0, 111.0])
    density = np.array([[30.0, 40.0, 6.0, 7.0, 8.0, 9.0]])
    speed = np.array([[90.0, 80.0, 70.0, 60.0, 50.0, 40.0]])
    inputs = model.boundary_inputs(density, speed)[0]
    w_in = 90.0 + 102.0 * (30.0 / 333.0) ** 2
    w_on = [70.0 + 102.0 * (6.0 / 111.0) ** 2, 60.0 + 102.0 * (7.0 / 111.0) ** 2]
    expected = [2700.0, w_in, 40.0, 420.0, w_on[0], 420.0, w_on[1], 8.0, 9.0]
    np.testing.assert_allclose(inputs, expected)


def test_a_boundary_cell_demands_its_capacity_or_nothing_and_w_keeps_the_cfl_condition():
    def inputs(density, speed):
        return ARZModel(HIGHWAY.road, PUBLISHED).boundary_inputs(
            np.full((1, 6), density), np.full((1, 6), speed)
        )[0]

    demand, w = inputs(300.0, 2.0)[:2]
    critical = 333.0 * (w / 306.0) ** 0.5
    assert demand == pytest.approx(critical * w * 2.0 / 3.0)
    np.testing.assert_allclose(inputs(300.0, 150.0)[[1, 4, 6]], 1.1 * 102.0)
    for rho in (0.0, -5.0):  # noise may take a density below zero
        empty = [0, 102, rho, 0, 102, 0, 102, rho, rho]
        np.testing.assert_array_equal(inputs(rho, np.nan), empty)
