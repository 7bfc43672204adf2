"""Measurement, bounds and boundary inputs of `ARZModel`."""

import numpy as np
import pytest

from dptse_env.model.parameters import MEASUREMENT_FLOOR

from .roads import HIGHWAY, PAPER, W99, model_of, random_states

both_sets = pytest.mark.parametrize("parameters", [PAPER, W99], ids=lambda p: p.name)


@both_sets
def test_measures_density_and_speed_of_occupied_segments(parameters):
    model = model_of(HIGHWAY, parameters)
    rng = np.random.default_rng(0)
    density = rng.uniform(0.02, 0.9, (5, 19)) * model.jam_density
    speed = rng.uniform(0.0, 100.0, (5, 19))
    states = model.states(density, speed)
    np.testing.assert_allclose(model.measure(states)[..., 0], density)
    np.testing.assert_allclose(model.measure(states)[..., 1], speed, atol=1e-9)
    np.testing.assert_allclose(model.density(states), density)
    np.testing.assert_allclose(model.speed(states), speed, atol=1e-9)


@both_sets
def test_measurement_jacobian_is_that_of_central_differences(parameters):
    model = model_of(HIGHWAY, parameters)
    rng = np.random.default_rng(1)
    floor = MEASUREMENT_FLOOR * model.jam_density
    density = rng.uniform(0.0, 1.0, (50, 19)) ** 3 * model.jam_density
    density[np.abs(density - floor) < 1e-3] += 0.01
    states = model.states(density, rng.uniform(0.0, 100.0, (50, 19)))
    jacobian = model.measurement_jacobian(states)
    for column, h in ((0, 1e-5), (1, 1e-3)):
        shift = np.zeros(38)
        shift[column::2] = h
        numeric = (model.measure(states + shift) - model.measure(states - shift)) / (2 * h)
        np.testing.assert_allclose(jacobian[..., column], numeric, rtol=1e-5, atol=1e-6)


def test_measurement_of_nearly_empty_segments_is_tame():
    model = model_of(HIGHWAY)
    density = np.full((1, 19), 1e-3)
    states = model.states(density, np.full((1, 19), 102.0))
    slope = np.abs(model.measurement_jacobian(states)[0, :, 1, 0])
    assert np.all(slope == 0.0)
    floor = MEASUREMENT_FLOOR * model.jam_density
    steepest = model.states(floor[None] * 1.001, np.full((1, 19), 102.0))
    slope = np.abs(model.measurement_jacobian(steepest)[0, :, 1, 0]) * model.jam_density
    assert np.all(slope < 1.01 * 102.0 / MEASUREMENT_FLOOR)
    assert np.all(np.isfinite(model.measure(np.zeros((1, 38)))))


@both_sets
@pytest.mark.parametrize("reference_speed", [0.0, 51.0])
def test_with_a_reference_speed_the_centred_flow_is_measured(parameters, reference_speed):
    model, plain = (
        model_of(HIGHWAY, parameters, reference_speed=v) for v in (reference_speed, None)
    )
    rng = np.random.default_rng(5)
    density = rng.uniform(0.0, 1.0, (5, 19)) ** 2 * model.jam_density
    density[0] = 0.0
    states = model.states(density, rng.uniform(0.0, 100.0, (5, 19)))
    flow = density * (model.speed(states) - reference_speed)
    measured = model.measure(states)
    np.testing.assert_array_equal(measured[..., 0], density)
    np.testing.assert_allclose(measured[..., 1], flow, rtol=1e-12, atol=1e-9)
    # Density and speed stay what they are, for those who ask for these.
    np.testing.assert_array_equal(model.traffic(states), plain.measure(states))
    np.testing.assert_array_equal(
        model.traffic_jacobian(states), plain.measurement_jacobian(states)
    )
    jam, v_f = model.density_scale, parameters.free_flow_speed
    np.testing.assert_array_equal(model.measurement_scale, [jam, jam * v_f])
    np.testing.assert_array_equal(plain.measurement_scale, [jam, v_f])


@both_sets
def test_the_flows_jacobian_is_that_of_central_differences(parameters):
    model = model_of(HIGHWAY, parameters, reference_speed=51.0)
    rng = np.random.default_rng(6)
    density = rng.uniform(0.001, 1.0, (50, 19)) ** 3 * model.jam_density
    states = model.states(density, rng.uniform(0.0, 100.0, (50, 19)))
    states[0, 0::2] = -1.0  # a vacuum has no pressure
    jacobian = model.measurement_jacobian(states)
    # A small step: below 1 veh/km the pressure of a gamma below 1 bends without bound.
    for column, h in ((0, 1e-6), (1, 1e-3)):
        shift = np.zeros(38)
        shift[column::2] = h
        numeric = (model.measure(states + shift) - model.measure(states - shift)) / (2 * h)
        np.testing.assert_allclose(jacobian[..., column], numeric, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf, "fast"])
def test_a_reference_speed_that_is_none_is_refused(bad):
    with pytest.raises(ValueError, match=r"model\.reference_speed must be .*, got "):
        model_of(HIGHWAY, reference_speed=bad)


@both_sets
def test_cone_holds_speed_and_w(parameters):
    model = model_of(HIGHWAY, parameters)
    rng = np.random.default_rng(2)
    wild = rng.normal(0.0, 3.0, (200, 38)) * np.tile([300.0, 30_000.0], 19)
    states = model.project(wild)
    density, w = model.density(states), model.cells(states).w
    assert np.all((density >= 1.0) & (density <= model.jam_density))
    backwards = model.relations.pressure(density, model.jam_density) - w
    assert np.all(backwards <= 1e-9)
    assert np.all(w <= 1.1 * parameters.free_flow_speed * (1.0 + 1e-12))
    assert np.all(w >= 0.4 * parameters.free_flow_speed * (1.0 - 1e-12))
    np.testing.assert_array_equal(model.project(states), states)


def test_box_is_the_papers():
    model = model_of(HIGHWAY)
    wild = np.random.default_rng(3).normal(0.0, 3.0, (200, 38)) * np.tile([300.0, 30_000.0], 19)
    states = model.project(wild, "box")
    upper = np.stack([model.jam_density, 102.0 * model.jam_density], -1).ravel()
    np.testing.assert_array_equal(states, np.clip(wild, 0.0, upper))


def test_projection_leaves_states_inside_alone():
    model = model_of(HIGHWAY)
    states = random_states(model, 50, np.random.default_rng(4))
    inside = (model.density(states) >= 1.0) & (model.cells(states).w >= 0.4 * 102.0)
    assert 0.5 < inside.mean() < 1.0
    moved = np.abs(model.project(states) - states).reshape(50, 19, 2)[inside]
    assert moved.max() < 1e-9


def test_other_bounds_are_refused():
    model = model_of(HIGHWAY)
    with pytest.raises(ValueError, match="bounds must be 'cone' or 'box', got 'sphere'"):
        model.project(np.zeros((1, 38)), "sphere")


def test_boundary_inputs_follow_the_order_of_the_input_vector():
    model = model_of(HIGHWAY)
    density = np.array([[30.0, 40.0, 6.0, 7.0, 8.0, 9.0]])
    speed = np.array([[90.0, 80.0, 70.0, 60.0, 50.0, 40.0]])
    inputs = model.boundary_inputs(density, speed)[0]
    w_in = 90.0 + 102.0 * (30.0 / 333.0) ** 2
    w_on = [70.0 + 102.0 * (6.0 / 111.0) ** 2, 60.0 + 102.0 * (7.0 / 111.0) ** 2]
    expected = [2700.0, w_in, 40.0, 420.0, w_on[0], 420.0, w_on[1], 8.0, 9.0]
    np.testing.assert_allclose(inputs, expected)


def test_empty_boundary_cell_demands_nothing():
    model = model_of(HIGHWAY)
    inputs = model.boundary_inputs(np.zeros((1, 6)), np.full((1, 6), np.nan))[0]
    np.testing.assert_array_equal(inputs, [0, 102, 0, 0, 102, 0, 102, 0, 0])


def test_boundary_w_never_breaks_the_cfl_condition():
    model = model_of(HIGHWAY)
    inputs = model.boundary_inputs(np.full((1, 6), 300.0), np.full((1, 6), 150.0))[0]
    np.testing.assert_allclose(inputs[[1, 4, 6]], 1.1 * 102.0)
