"""Measurements, bounds and boundary inputs of `ARZModel`, and rows as kernels write them."""

import numpy as np
import pytest

from dptse_env.model import ARZModel, MeasurementRows
from dptse_env.model.parameters import MEASUREMENT_FLOOR
from dptse_env.model.step import write_row
from tests.helpers import UNEVEN, compiled, pairwise

from .roads import HIGHWAY, PAPER, W99, model_of, random_states, scattered_states

write_row = compiled(write_row)

both_sets = pytest.mark.parametrize("parameters", [PAPER, W99], ids=lambda p: p.name)
ROWS = MeasurementRows(np.array([0, 3, 4, 13, 16]), np.array([1, 2, 3, 2, 1]), 19)
UNEVEN_ROWS = MeasurementRows(np.array([6, 0, 2]), np.array([2, 1, 3]), 15)


def occupied(model, n, rng):
    """States of traffic that is not a vacuum, with the speeds of it."""
    density = rng.uniform(0.02, 0.9, (n, model.n_segments)) * model.jam_density
    speed = rng.uniform(0.0, 100.0, density.shape)
    return model.states(density, speed), density, speed


@both_sets
def test_measures_density_and_speed_of_occupied_segments(parameters):
    model = model_of(HIGHWAY, parameters)
    states, density, speed = occupied(model, 5, np.random.default_rng(0))
    measured = model.measure(states)
    np.testing.assert_allclose(measured[..., 0], density)
    np.testing.assert_allclose(measured[..., 1], speed, atol=1e-9)
    np.testing.assert_allclose(model.density(states), density)
    np.testing.assert_allclose(model.speed(states), speed, atol=1e-9)


@pytest.mark.parametrize("reference_speed", [0.0, 51.0])
def test_rows_of_flows_average_what_segments_carry_around_a_centre(reference_speed):
    model = model_of(HIGHWAY, W99, reference_speed=reference_speed, rows=ROWS)
    rng = np.random.default_rng(5)
    states, density, speed = occupied(model, 6, rng)
    centre = rng.uniform(0.0, 100.0, (6, 19))
    for given, v_0 in ((None, reference_speed), (centre, centre)):
        expected = ROWS.averages(np.stack([density, density * (speed - v_0)], axis=-1))
        found = model.measure(states, given)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-6)
    jam, v_f = model.density_scale, W99.free_flow_speed
    np.testing.assert_array_equal(model.measurement_scale, [jam, jam * v_f])
    np.testing.assert_array_equal(model_of(HIGHWAY, W99).measurement_scale, [jam, v_f])
    # Density and speed stay what they are, for those who ask for these.
    np.testing.assert_allclose(model.traffic(states)[..., 1], speed, atol=1e-9)


@pytest.mark.parametrize(
    ("parameters", "release", "demand"),
    pairwise([PAPER, W99], ["speeds", "flows", "rows"], [False, True]),
)
def test_the_measurement_matrix_is_that_of_central_differences(parameters, release, demand):
    model = model_of(
        HIGHWAY, parameters, reference_speed=None if release == "speeds" else 51.0,
        rows=ROWS if release == "rows" else None, demand_states=demand,
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


@pytest.mark.parametrize(
    ("road", "release", "demand"),
    [("highway", "speeds", False), ("highway", "flows", True), ("uneven", "flows", False)],
)
def test_a_kernels_row_is_the_models_measurement_linearised(road, release, demand):
    """Empty segments and negative densities among them, as a filter may have."""
    network, rows = (HIGHWAY, ROWS) if road == "highway" else (UNEVEN, UNEVEN_ROWS)
    if release == "speeds":
        rows = MeasurementRows.single(rows.n_segments)
    speed = None if release == "speeds" else 51.0
    model = ARZModel(network, W99, reference_speed=speed, rows=rows, demand_states=demand)
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
        for m, (first, span) in enumerate(zip(rows.first, rows.span, strict=True)):
            write_row(model.road, model.state_scale, state, centre[i], m, weights, constants)
            covered = slice(2 * first, 2 * (first + span))
            written, unit = weights[:, : 2 * span], model.state_scale[covered]
            np.testing.assert_allclose(written, matrix[i, m][:, covered], rtol=1e-12, atol=1e-12)
            found = written @ (state[covered] / unit) + constants
            np.testing.assert_allclose(found, values[i, m], rtol=1e-11, atol=1e-11)


def test_the_measurement_of_nearly_empty_segments_is_tame():
    model, fast = model_of(HIGHWAY), np.full((1, 19), 102.0)
    nearly_empty = model.states(np.full((1, 19), 1e-3), fast)
    assert np.all(model.traffic_jacobian(nearly_empty)[..., 1, 0] == 0.0)
    floor = MEASUREMENT_FLOOR * model.jam_density
    slope = model.traffic_jacobian(model.states(floor[None] * 1.001, fast))[0, :, 1, 0]
    assert np.all(np.abs(slope) * model.jam_density < 1.01 * 102.0 / MEASUREMENT_FLOOR)
    assert np.all(np.isfinite(model.measure(np.zeros((1, 38)))))


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf, "fast"])
def test_a_reference_speed_that_is_none_is_refused(bad):
    with pytest.raises(ValueError, match=r"model\.reference_speed must be .*, got "):
        model_of(HIGHWAY, reference_speed=bad)


def test_mean_speeds_have_no_rows_of_several_segments():
    with pytest.raises(ValueError, match=r"model\.rows must be single segments"):
        ARZModel(HIGHWAY, W99, rows=ROWS)


@both_sets
def test_the_cone_holds_speed_and_w_and_leaves_what_is_inside_alone(parameters):
    model, rng = model_of(HIGHWAY, parameters), np.random.default_rng(2)
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


def test_the_box_is_the_papers():
    model = model_of(HIGHWAY)
    wild = np.random.default_rng(3).normal(0.0, 3.0, (200, 38)) * model.state_scale
    upper = np.stack([model.jam_density, 102.0 * model.jam_density], -1).ravel()
    np.testing.assert_array_equal(model.project(wild, "box"), np.clip(wild, 0.0, upper))
    with pytest.raises(ValueError, match="bounds must be 'cone' or 'box', got 'sphere'"):
        model.project(np.zeros((1, 38)), "sphere")


def test_demand_factors_begin_at_one_and_are_projected_into_their_bounds():
    model = model_of(HIGHWAY, W99, demand_states=True)
    assert (model.n_demand_states, model.n_states) == (3, 41)
    states = model.states(np.ones((2, 19)), np.ones((2, 19)))
    np.testing.assert_array_equal(model.demand_factors(states), np.ones((2, 3)))
    np.testing.assert_array_equal(model.state_scale[-3:], np.ones(3))
    model.demand_factors(states)[:] = [[-1.0, 0.5, 9.0], [0.05, 1.0, 3.0]]
    for bounds in ("cone", "box"):
        projected = model.demand_factors(model.project(states, bounds))
        np.testing.assert_array_equal(projected, [[0.1, 0.5, 3.0], [0.1, 1.0, 3.0]])


def test_boundary_inputs_follow_the_order_of_the_input_vector():
    model = model_of(HIGHWAY)
    np.testing.assert_allclose(model.entry_jam_density, [333.0, 111.0, 111.0])
    density = np.array([[30.0, 40.0, 6.0, 7.0, 8.0, 9.0]])
    speed = np.array([[90.0, 80.0, 70.0, 60.0, 50.0, 40.0]])
    inputs = model.boundary_inputs(density, speed)[0]
    w_in = 90.0 + 102.0 * (30.0 / 333.0) ** 2
    w_on = [70.0 + 102.0 * (6.0 / 111.0) ** 2, 60.0 + 102.0 * (7.0 / 111.0) ** 2]
    expected = [2700.0, w_in, 40.0, 420.0, w_on[0], 420.0, w_on[1], 8.0, 9.0]
    np.testing.assert_allclose(inputs, expected)


def test_a_congested_boundary_cell_demands_its_capacity():
    model = model_of(HIGHWAY)
    demand, w = model.boundary_inputs(np.full((1, 6), 300.0), np.full((1, 6), 2.0))[0, :2]
    critical = 333.0 * (w / 306.0) ** 0.5
    assert demand == pytest.approx(critical * w * 2.0 / 3.0)


def test_an_empty_boundary_cell_demands_nothing_and_w_never_breaks_the_cfl_condition():
    model = model_of(HIGHWAY)
    for rho in (0.0, -5.0):  # noise may take a density below zero
        inputs = model.boundary_inputs(np.full((1, 6), rho), np.full((1, 6), np.nan))[0]
        np.testing.assert_array_equal(inputs, [0, 102, rho, 0, 102, 0, 102, rho, rho])
    inputs = model.boundary_inputs(np.full((1, 6), 300.0), np.full((1, 6), 150.0))[0]
    np.testing.assert_allclose(inputs[[1, 4, 6]], 1.1 * 102.0)
