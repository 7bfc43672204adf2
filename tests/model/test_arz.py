import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dptse_env.model.model import ARZModel
from dptse_env.model.parameters import ARZParameters

from .roads import (
    HIGHWAY,
    NO_RELAXATION,
    PAPER,
    STRAIGHT,
    UNEVEN,
    W99,
    Road,
    model_of,
    random_inputs,
    random_states,
)

seeds = st.integers(0, 2**32 - 1)
both_sets = pytest.mark.parametrize("parameters", [PAPER, W99], ids=lambda p: p.name)

both_roads = pytest.mark.parametrize("road", [HIGHWAY, UNEVEN], ids=["highway", "uneven"])


def uniform(model: ARZModel, density: float, w: float):
    """State and inputs of a straight road in one condition everywhere."""
    rho = np.full((1, model.n_segments), density)
    speed = w - float(model.relations.pressure(np.array(density), model.jam_density[0]))
    states = model.states(rho, np.full_like(rho, speed))
    demand = model.relations.demand(np.array(density), np.array(w), model.jam_density[0])
    return states, np.array([[float(demand), w, density]])


# Equilibrium and relaxation -----------------------------------------------------------------------


@both_sets
def test_uniform_equilibrium_is_a_fixed_point(parameters):
    model = model_of(STRAIGHT, parameters)
    for filling in (0.01, 0.1, 0.3, 0.6, 0.9, 1.0):
        density = filling * parameters.jam_density
        states, inputs = uniform(model, density, parameters.free_flow_speed)
        np.testing.assert_allclose(model.step(states, inputs), states, rtol=1e-12, atol=1e-9)


@both_sets
@pytest.mark.parametrize(("filling", "w_share"), [(0.2, 0.9), (0.2, 1.1), (0.05, 0.5)])
def test_uniform_road_relaxes_by_the_closed_form(parameters, filling, w_share):
    model = model_of(STRAIGHT, parameters)
    v_f, density = parameters.free_flow_speed, filling * parameters.jam_density
    w_0 = max(w_share * v_f, float(model.relations.pressure(density, model.jam_density[0])))
    states, _ = uniform(model, density, w_0)
    for k in range(50):
        w = v_f + (w_0 - v_f) * (1.0 - 1.0 / parameters.relaxation_time) ** k
        expected, inputs = uniform(model, density, w)
        np.testing.assert_allclose(states, expected, rtol=1e-10)
        states = model.step(states, inputs)


def test_equilibrium_drivers_obey_the_first_order_godunov_scheme():
    model = model_of(STRAIGHT)
    jam, v_f, gamma = PAPER.jam_density, PAPER.free_flow_speed, PAPER.gamma
    rng = np.random.default_rng(1)
    rho = rng.uniform(0.0, jam, 15)
    states = model.states(rho[None], v_f * (1.0 - (rho[None] / jam) ** gamma))

    def flow(density):
        return density * v_f * (1.0 - (density / jam) ** gamma)

    critical = jam * (1.0 + gamma) ** (-1.0 / gamma)

    def godunov(left, right):  # exact Riemann solution of the concave scalar law
        if left <= right:
            return min(flow(left), flow(right))
        if right <= critical <= left:
            return flow(critical)
        return max(flow(left), flow(right))

    for _ in range(200):
        outer_left, outer_right = rng.uniform(0.0, jam, 2)
        demand = flow(min(outer_left, critical))
        states = model.step(states, np.array([[demand, v_f, outer_right]]))
        padded = [outer_left, *rho, outer_right]
        flows = np.array([godunov(a, b) for a, b in itertools.pairwise(padded)])
        rho = rho - (1.0 / 3600.0 / 0.1) * np.diff(flows)
        np.testing.assert_allclose(model.density(states)[0], rho, atol=1e-9)
        np.testing.assert_allclose(states[0, 1::2], v_f * states[0, 0::2], rtol=1e-9, atol=1e-9)


# Balances and bounds ------------------------------------------------------------------------------


@both_sets
@both_roads
@given(seed=seeds)
def test_vehicles_are_balanced(road, parameters, seed):
    model = model_of(road, parameters)
    rng = np.random.default_rng(seed)
    states, inputs = random_states(model, 4, rng), random_inputs(model, 4, rng)
    flux = model.fluxes(states, inputs)
    change = (model.step(states, inputs) - states)[:, 0::2] @ model.layout.lengths
    through = flux.source.sum(axis=1) - flux.outflow[:, model.layout.exits].sum(axis=1)
    np.testing.assert_allclose(change, through / 3600.0, atol=1e-9)


@both_roads
@given(seed=seeds)
def test_relative_flow_is_balanced_without_relaxation(road, seed):
    model = model_of(road, NO_RELAXATION)
    rng = np.random.default_rng(seed)
    states, inputs = random_states(model, 4, rng), random_inputs(model, 4, rng)
    flux = model.fluxes(states, inputs)
    change = (model.step(states, inputs) - states)[:, 1::2] @ model.layout.lengths
    leaving = flux.relative_outflow[:, model.layout.exits].sum(axis=1)
    through = (flux.relative_source.sum(axis=1) - leaving) / 3600.0
    np.testing.assert_allclose(change, through, rtol=1e-11, atol=1e-9 * PAPER.free_flow_speed)


@both_sets
@both_roads
@given(seed=seeds)
def test_density_stays_positive_and_w_within_its_bounds(road, parameters, seed):
    model = model_of(road, parameters)

    def w_of(states):  # the plain quotient, in what counts as a vacuum too
        rho, psi = states[:, 0::2], states[:, 1::2]
        return np.divide(psi, rho, np.full_like(rho, parameters.free_flow_speed), where=rho > 0.0)

    rng = np.random.default_rng(seed)
    states = random_states(model, 4, rng)
    for _ in range(20):
        inputs = random_inputs(model, 4, rng)
        w_in = inputs[:, model.layout.entry_inputs + 1]
        before = np.concatenate(
            [w_of(states), w_in, np.full((4, 1), parameters.free_flow_speed)], axis=1
        )
        states = model.step(states, inputs)
        w = w_of(states)
        assert np.all(states >= 0.0)
        assert np.all(w >= before.min(axis=1, keepdims=True) - 1e-9)
        assert np.all(w <= before.max(axis=1, keepdims=True) + 1e-9)


@both_sets
@given(seed=seeds)
def test_nobody_drives_backwards_when_no_w_exceeds_free_flow(parameters, seed):
    model = model_of(HIGHWAY, parameters)
    rng = np.random.default_rng(seed)
    v_f = parameters.free_flow_speed
    states = random_states(model, 4, rng)
    states[:, 1::2] = np.minimum(states[:, 1::2], v_f * states[:, 0::2])
    for _ in range(20):
        inputs = random_inputs(model, 4, rng)
        columns = model.layout.entry_inputs + 1
        inputs[:, columns] = np.minimum(inputs[:, columns], v_f)
        states = model.step(states, inputs)
        rho, psi = states[:, 0::2], states[:, 1::2]
        backwards = rho * model.relations.pressure(rho, model.jam_density) - psi
        assert np.all(backwards <= 1e-9 * parameters.jam_density * v_f)


def test_empty_road_stays_empty_and_finite():
    model = model_of(HIGHWAY)
    states = np.zeros((1, model.n_states))
    inputs = model.boundary_inputs(np.zeros((1, 6)), np.full((1, 6), np.nan))
    assert np.all(np.isfinite(inputs))
    np.testing.assert_array_equal(model.step(states, inputs), states)
    assert np.all(np.isfinite(model.jacobian(states, inputs)))
    np.testing.assert_array_equal(model.speed(states), PAPER.free_flow_speed)


def test_a_full_entrance_turns_demand_away():
    model = model_of(STRAIGHT)
    states, inputs = uniform(model, PAPER.jam_density, PAPER.free_flow_speed)
    inputs[0, 0] = 5000.0
    assert model.fluxes(states, inputs).source[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_a_blocked_exit_holds_everyone():
    model = model_of(STRAIGHT)
    states, inputs = uniform(model, 50.0, PAPER.free_flow_speed)
    inputs[0, 2] = PAPER.jam_density
    assert model.fluxes(states, inputs).outflow[0, -1] == pytest.approx(0.0, abs=1e-9)
    inputs[0, 2] = 0.0
    free = 50.0 * model.speed(states)[0, -1]
    assert model.fluxes(states, inputs).outflow[0, -1] == pytest.approx(free)


# Units, batches, steps ----------------------------------------------------------------------------


def test_metres_and_seconds_give_the_same_trajectory():
    rng = np.random.default_rng(3)
    model = model_of(HIGHWAY)
    si = ARZModel(
        # The model divides T by 3600 s/h; a length in m s/h makes T / l come out in s/m.
        replace(HIGHWAY, segment_length=100.0 / 3600.0),
        ARZParameters("si", PAPER.free_flow_speed / 3.6, PAPER.jam_density / 1000.0, 2.0, 60.0),
    )
    to_si = np.tile([1.0 / 1000.0, 1.0 / 3600.0], model.n_segments)  # veh/m, veh/s
    flow, speed, density = 1.0 / 3600.0, 1.0 / 3.6, 1.0 / 1000.0
    inputs_to_si = np.array([flow, speed, density, flow, speed, flow, speed, density, density])
    states = random_states(model, 3, rng)
    states_si = states * to_si
    for _ in range(100):
        inputs = random_inputs(model, 3, rng)
        states = model.step(states, inputs)
        states_si = si.step(states_si, inputs * inputs_to_si)
    np.testing.assert_allclose(states_si / to_si, states, rtol=1e-9, atol=1e-9)


@both_sets
def test_a_batch_equals_a_loop(parameters):
    model = model_of(HIGHWAY, parameters)
    rng = np.random.default_rng(4)
    states, inputs = random_states(model, 8, rng), random_inputs(model, 8, rng)
    after, jacobian = model.step(states, inputs), model.jacobian(states, inputs)
    for i in range(8):
        one = slice(i, i + 1)
        np.testing.assert_allclose(model.step(states[one], inputs[one]), after[one], rtol=1e-14)
        np.testing.assert_allclose(
            model.jacobian(states[one], inputs[one]), jacobian[one], rtol=1e-13, atol=1e-13
        )


def test_smaller_steps_approach_the_same_motion():
    rng = np.random.default_rng(5)
    coarse, fine = model_of(HIGHWAY, time_step=0.1), model_of(HIGHWAY, time_step=0.01)
    states, inputs = random_states(coarse, 1, rng), random_inputs(coarse, 1, rng)
    slow = states
    for _ in range(10):
        states = coarse.step(states, inputs)
    for _ in range(100):
        slow = fine.step(slow, inputs)
    assert np.abs(states - slow)[:, 0::2].max() < 0.01 * PAPER.jam_density


@pytest.mark.parametrize("time_step", [1.77, 2.0, 0.0, -1.0, float("nan")])
def test_a_step_too_long_names_the_longest_admissible(time_step):
    with pytest.raises(ValueError, match=r"model.time_step must be > 0 and at most 1.76 s \(CFL"):
        model_of(HIGHWAY, PAPER, time_step)


def test_the_step_named_is_admissible():
    assert model_of(HIGHWAY, PAPER, 1.76).time_step == 1.76


def test_strong_relaxation_bounds_the_step_too():
    fast = replace(PAPER, relaxation_time=0.5)
    with pytest.raises(ValueError, match=r"at most 0.43 s"):
        model_of(HIGHWAY, fast)


def test_one_cell_is_a_road():
    model = model_of(Road(n_mainline=1), PAPER)
    states = model.step(np.zeros((1, 2)), np.array([[1000.0, 102.0, 0.0]]))
    assert states[0, 0] == pytest.approx(1000.0 / 3600.0 / 0.1)
