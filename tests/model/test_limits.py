"""Consequences of the equations: equilibria, balances, bounds, and the limits of each face."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dptse_env.model import ARZModel, ARZParameters
from tests.helpers import UNEVEN, Road, pairwise

from .oracle import Oracle
from .roads import (
    HIGHWAY,
    NO_RELAXATION,
    PAPER,
    STRAIGHT,
    W99,
    model_of,
    random_inputs,
    random_states,
)

seeds = st.integers(0, 2**32 - 1)
share = st.floats(0.01, 1.0)
both_sets = pytest.mark.parametrize("parameters", [PAPER, W99], ids=lambda p: p.name)
both_roads = pytest.mark.parametrize("road", [HIGHWAY, UNEVEN], ids=["highway", "uneven"])
MERGE = Road(n_mainline=4, on_ramps=(2,), ramp_lanes=3)
DIVERGE = Road(n_mainline=4, off_ramps=(2,), exit_shares=(0.1,))
MAIN, DOWN, RAMP = 1, 2, 4


def drawn(model, seed, n=4):
    rng = np.random.default_rng(seed)
    return random_states(model, n, rng), random_inputs(model, n, rng)


def uniform(model, density, w):
    """State and inputs of a straight road in one condition everywhere."""
    rho, jam = np.full((1, model.n_segments), density), model.jam_density[0]
    demand = Oracle(model.network, model.parameters).demand(np.array(density), w, jam)
    states = model.states(rho, w - model.pressure(rho))
    return states, np.array([[float(demand), w, density]])


def outflows(model, states, inputs):
    """Flow [veh/h] out of each cell that nobody enters, by what it holds a step later."""
    change = (model.step(states, inputs) - states)[:, : 2 * model.n_segments : 2]
    return -change * model.layout.lengths * 3600.0 / model.time_step


# Relations ----------------------------------------------------------------------------------------


@given(gamma=st.floats(0.3, 4.0), w=share, x=share)
def test_demand_and_supply_are_continuous_and_never_fall(gamma, w, x):
    relations, w = Oracle(STRAIGHT, replace(PAPER, gamma=gamma)), np.array(1.1 * 102.0 * w)
    critical, capacity = relations.critical_density(w, 333.0), relations.capacity(w, 333.0)
    around = critical * (1.0 + np.array([-1e-9, 1e-9]))
    np.testing.assert_allclose(relations.demand(around, w, 333.0), capacity, rtol=1e-6)
    around = w * gamma / (1.0 + gamma) * (1.0 + np.array([-1e-9, 1e-9]))
    np.testing.assert_allclose(relations.supply(w, around, 333.0), capacity, rtol=1e-6)
    flow = np.linspace(0.0, 1.5, 2001) * 333.0
    assert (flow * (w - relations.pressure(flow, 333.0)) <= capacity * (1.0 + 1e-12)).all()
    many = np.linspace(0.0, 1.2, 500)
    for rising in (
        relations.demand(many * 333.0, w, 333.0),
        relations.supply(w, many * w, 333.0),
        relations.supply(many * 102.0, np.array(x * 102.0), 333.0),
    ):
        assert np.all(np.diff(rising) >= -1e-9 * rising.max())


# Equilibrium and relaxation -----------------------------------------------------------------------


@both_sets
def test_a_uniform_equilibrium_is_a_fixed_point(parameters):
    model = model_of(STRAIGHT, parameters)
    for filling in (0.01, 0.1, 0.3, 0.6, 0.9, 1.0):
        density = filling * parameters.jam_density
        states, inputs = uniform(model, density, parameters.free_flow_speed)
        np.testing.assert_allclose(model.step(states, inputs), states, rtol=1e-12, atol=1e-9)


@both_sets
@pytest.mark.parametrize(("filling", "w_share"), [(0.2, 0.9), (0.2, 1.1), (0.05, 0.5)])
def test_a_uniform_road_relaxes_by_the_closed_form(parameters, filling, w_share):
    model = model_of(STRAIGHT, parameters)
    v_f, density = parameters.free_flow_speed, filling * parameters.jam_density
    w_0 = max(w_share * v_f, float(model.pressure(density)[0]))
    states, _ = uniform(model, density, w_0)
    for k in range(50):
        w = v_f + (w_0 - v_f) * (1.0 - 1.0 / parameters.relaxation_time) ** k
        expected, inputs = uniform(model, density, w)
        np.testing.assert_allclose(states, expected, rtol=1e-10)
        states = model.step(states, inputs)


def test_equilibrium_drivers_obey_the_first_order_godunov_scheme():
    model, rng = model_of(STRAIGHT), np.random.default_rng(1)
    jam, v_f, gamma = PAPER.jam_density, PAPER.free_flow_speed, PAPER.gamma
    critical, rho = jam * (1.0 + gamma) ** (-1.0 / gamma), rng.uniform(0.0, jam, 15)

    def flow(density):
        return density * v_f * (1.0 - (density / jam) ** gamma)

    def godunov(left, right):  # exact Riemann solution of the concave scalar law
        if left <= right:
            return min(flow(left), flow(right))
        return flow(critical) if right <= critical <= left else max(flow(left), flow(right))

    states = model.states(rho[None], v_f * (1.0 - (rho[None] / jam) ** gamma))
    for _ in range(200):
        first, last = rng.uniform(0.0, jam, 2)
        states = model.step(states, np.array([[flow(min(first, critical)), v_f, last]]))
        flows = [godunov(a, b) for a, b in itertools.pairwise([first, *rho, last])]
        rho = rho - (1.0 / 3600.0 / 0.1) * np.diff(flows)
        np.testing.assert_allclose(model.density(states)[0], rho, atol=1e-9)
        np.testing.assert_allclose(states[0, 1::2], v_f * states[0, 0::2], rtol=1e-9, atol=1e-9)


# Balances and bounds ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("road", "parameters"), pairwise([HIGHWAY, UNEVEN], [PAPER, W99, NO_RELAXATION])
)
@given(seed=seeds)
def test_what_the_road_holds_changes_by_what_passes_its_ends(road, parameters, seed):
    model = model_of(road, parameters)
    states, inputs = drawn(model, seed)
    w, q, _, source = Oracle(road, parameters).flows(states, inputs)
    entering, w_in = np.array(list(source.values())).swapaxes(0, 1)
    lengths, exits = model.layout.lengths, model.layout.exits
    change = model.step(states, inputs) - states
    through = (entering.sum(axis=0) - q[exits].sum(axis=0)) / 3600.0
    np.testing.assert_allclose(change[:, 0::2] @ lengths, through, atol=1e-9)
    if np.isinf(parameters.relaxation_time):
        through = ((entering * w_in).sum(axis=0) - (q * w)[exits].sum(axis=0)) / 3600.0
        atol = 1e-9 * parameters.free_flow_speed
        np.testing.assert_allclose(change[:, 1::2] @ lengths, through, rtol=1e-11, atol=atol)


@both_sets
@both_roads
@given(seed=seeds)
def test_density_stays_positive_and_w_within_its_bounds(road, parameters, seed):
    model, v_f = model_of(road, parameters), parameters.free_flow_speed

    def w_of(states):  # the plain quotient, in what counts as a vacuum too
        rho, psi = model.components(states)
        return np.divide(psi, rho, np.full_like(rho, v_f), where=rho > 0.0)

    rng = np.random.default_rng(seed)
    states = random_states(model, 4, rng)
    for _ in range(20):
        inputs = random_inputs(model, 4, rng)
        w_in = inputs[:, model.layout.entry_inputs + 1]
        before = np.concatenate([w_of(states), w_in, np.full((4, 1), v_f)], axis=1)
        states = model.step(states, inputs)
        w = w_of(states)
        assert np.all(states >= 0.0)
        assert np.all(w >= before.min(axis=1, keepdims=True) - 1e-9)
        assert np.all(w <= before.max(axis=1, keepdims=True) + 1e-9)


@both_sets
@given(seed=seeds)
def test_nobody_drives_backwards_when_no_w_exceeds_free_flow(parameters, seed):
    model, v_f = model_of(HIGHWAY, parameters), parameters.free_flow_speed
    states, _ = drawn(model, seed)
    states[:, 1::2] = np.minimum(states[:, 1::2], v_f * states[:, 0::2])
    for k in range(20):
        inputs = random_inputs(model, 4, np.random.default_rng([seed, k]))
        columns = model.layout.entry_inputs + 1
        inputs[:, columns] = np.minimum(inputs[:, columns], v_f)
        states = model.step(states, inputs)
        rho, psi = model.components(states)
        assert np.all(rho * model.pressure(rho) - psi <= 1e-9 * parameters.jam_density * v_f)


def test_an_empty_road_stays_empty_and_finite():
    model = model_of(HIGHWAY)
    states = np.zeros((1, model.n_states))
    inputs = model.boundary_inputs(np.zeros((1, 6)), np.full((1, 6), np.nan))
    np.testing.assert_array_equal(model.step(states, inputs), states)
    assert np.all(np.isfinite(model.jacobian(states, inputs)))
    np.testing.assert_array_equal(model.speed(states), PAPER.free_flow_speed)


def test_a_full_entrance_turns_demand_away_and_a_blocked_exit_holds_everyone():
    model = model_of(STRAIGHT)
    states, inputs = uniform(model, PAPER.jam_density, PAPER.free_flow_speed)
    inputs[0, 0] = 5000.0
    np.testing.assert_allclose(model.step(states, inputs), states, rtol=1e-12)
    states, inputs = uniform(model, 50.0, PAPER.free_flow_speed)
    for outside, flow in ((PAPER.jam_density, 0.0), (0.0, 50.0 * model.speed(states)[0, 0])):
        inputs[0, [0, 2]] = 0.0, outside
        held = model.step(states, inputs)[:, 0::2] @ model.layout.lengths * 3600.0
        before = states[:, 0::2] @ model.layout.lengths * 3600.0
        np.testing.assert_allclose(before - held, flow, atol=1e-6)


# Junctions ----------------------------------------------------------------------------------------


@given(seed=seeds)
def test_a_merge_with_an_empty_ramp_is_a_plain_face(seed):
    model, plain = model_of(MERGE), model_of(Road(n_mainline=4))
    states, inputs = drawn(model, seed)
    states[:, 2 * RAMP :], inputs[:, 3] = 0.0, 0.0
    merged, straight = model.step(states, inputs), plain.step(states[:, :8], inputs[:, :3])
    np.testing.assert_allclose(merged[:, :8], straight, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(merged[:, 8:], 0.0)


@given(seed=seeds)
def test_a_merge_is_proportional_and_leaves_no_room_unused(seed):
    model, oracle = model_of(MERGE), Oracle(MERGE, PAPER)
    states, inputs = drawn(model, seed)
    # Nobody enters the branches: they hold less by what they send.
    states[:, 0:2], inputs[:, [0, 3]] = 0.0, 0.0
    main, ramp = outflows(model, states, inputs)[:, [MAIN, RAMP]].T
    w, v, D = oracle.cells(states)
    total = D[MAIN] + D[RAMP]
    mixed = (D[MAIN] * w[MAIN] + D[RAMP] * w[RAMP]) / np.where(total > 0.0, total, 1.0)
    supply = oracle.supply(mixed, v[DOWN], model.jam_density[DOWN])
    np.testing.assert_allclose(main + ramp, np.minimum(total, supply), rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(main * D[RAMP], ramp * D[MAIN], rtol=1e-9, atol=1.0)


@pytest.mark.parametrize(("exit_share", "tolerance"), [(0.0, 1e-9), (1e-12, 1e-6)])
@given(seed=seeds)
def test_a_diverge_that_nobody_takes_is_a_plain_face(exit_share, tolerance, seed):
    plain, model = (
        model_of(Road(n_mainline=4)),
        model_of(replace(DIVERGE, exit_shares=(exit_share,))),
    )
    states, inputs = drawn(model, seed)
    if exit_share > 0.0:  # a ramp that takes in something, however little
        states[:, 2 * RAMP : 2 * RAMP + 2] = 30.0, 30.0 * 102.0
    through, straight = model.step(states, inputs), plain.step(states[:, :8], inputs[:, :3])
    np.testing.assert_allclose(through[:, :8], straight, rtol=1e-9, atol=100.0 * tolerance)


@given(seed=seeds)
def test_a_diverge_splits_by_share_and_no_branch_takes_more_than_it_can(seed):
    model, oracle = model_of(DIVERGE), Oracle(DIVERGE, PAPER)
    states, inputs = drawn(model, seed)
    states[:, 0:2], inputs[:, 0] = 0.0, 0.0  # nobody enters the cell ahead of the diverge
    w, v, _ = oracle.cells(states)
    flow = outflows(model, states, inputs)[:, MAIN]
    branches = states.copy()
    branches[:, [2 * MAIN, 2 * MAIN + 1]] = 0.0
    without = outflows(model, branches, inputs)
    for branch, part in ((DOWN, 0.9), (RAMP, 0.1)):
        entered = (without - outflows(model, states, inputs))[:, branch]
        np.testing.assert_allclose(entered, part * flow, rtol=1e-9, atol=1e-6)
        supply = oracle.supply(w[MAIN], v[branch], model.jam_density[branch])
        assert np.all(entered <= supply * (1.0 + 1e-9) + 1e-6)


def test_a_blocked_ramp_stops_the_mainline():
    model = model_of(DIVERGE)
    density, speed = np.full((1, 5), 50.0), np.full((1, 5), 90.0)
    density[0, 0] = 0.0
    inputs = np.array([[0.0, PAPER.free_flow_speed, 0.0, 0.0]])
    for on_ramp, low, high in (
        ((PAPER.jam_density / 3.0, 0.0), 0.0, 1e-6),
        ((20.0, 60.0), 1e3, 1e4),
    ):
        density[0, RAMP], speed[0, RAMP] = on_ramp
        flow = outflows(model, model.states(density, speed), inputs)[0, MAIN]
        assert low - 1e-6 <= flow <= high


# Units and steps ----------------------------------------------------------------------------------


def test_metres_and_seconds_give_the_same_trajectory():
    rng, model = np.random.default_rng(3), model_of(HIGHWAY)
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


@pytest.mark.parametrize("time_step", [1.77, 0.0, -1.0, float("nan")])
def test_a_step_too_long_names_the_longest_admissible(time_step):
    model = model_of(HIGHWAY, PAPER, time_step)
    with pytest.raises(ValueError, match=r"CFL condition needs a time step > 0 and at most 1.76 s"):
        model.road  # noqa: B018
    assert model_of(HIGHWAY, PAPER, 1.76).road.relaxation > 0


def test_strong_relaxation_and_the_shortest_segment_bound_the_step_too():
    with pytest.raises(ValueError, match=r"at most 0.43 s"):
        model_of(HIGHWAY, replace(PAPER, relaxation_time=0.5)).require_time_step()
    with pytest.raises(ValueError, match=r"on 0.08 km their CFL condition"):
        model_of(UNEVEN, PAPER, 1.6).require_time_step()
