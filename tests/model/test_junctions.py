from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from .roads import PAPER, Road, model_of, random_inputs, random_states

MERGE = Road(n_mainline=4, on_ramps=(2,), ramp_lanes=3)
DIVERGE = Road(n_mainline=4, off_ramps=(2,), exit_shares=(0.1,))
MAIN, DOWN, RAMP = 1, 2, 4
seeds = st.integers(0, 2**32 - 1)


def drawn(model, seed, n=8):
    rng = np.random.default_rng(seed)
    return random_states(model, n, rng), random_inputs(model, n, rng)


@given(seed=seeds)
def test_merge_with_an_empty_ramp_is_a_plain_face(seed):
    model, plain = model_of(MERGE), model_of(Road(n_mainline=4))
    states, inputs = drawn(model, seed)
    states[:, 2 * RAMP :] = 0.0
    merged = model.fluxes(states, inputs)
    straight = plain.fluxes(states[:, :8], inputs[:, :3])
    np.testing.assert_allclose(merged.outflow[:, :4], straight.outflow, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(merged.outflow[:, RAMP], 0.0)


@given(seed=seeds)
def test_swapping_the_branches_swaps_their_flows(seed):
    model = model_of(MERGE)
    states, inputs = drawn(model, seed)
    swapped = states.reshape(-1, 5, 2).copy()
    swapped[:, [MAIN, RAMP]] = swapped[:, [RAMP, MAIN]]
    a = model.fluxes(states, inputs)
    b = model.fluxes(swapped.reshape(-1, 10), inputs)
    for flows, other in ((a.outflow, b.outflow), (a.relative_outflow, b.relative_outflow)):
        np.testing.assert_allclose(flows[:, MAIN], other[:, RAMP], rtol=1e-12)
        np.testing.assert_allclose(flows[:, RAMP], other[:, MAIN], rtol=1e-12)


@given(seed=seeds)
def test_merge_is_proportional_and_leaves_no_room_unused(seed):
    model = model_of(MERGE)
    states, inputs = drawn(model, seed)
    cells, flux = model.cells(states), model.fluxes(states, inputs)
    total, w = model.merged(cells)
    supply = model.relations.supply(w[:, 0], cells.speed[:, DOWN], model.jam_density[DOWN])
    sent = flux.outflow[:, MAIN] + flux.outflow[:, RAMP]
    np.testing.assert_allclose(sent, np.minimum(total[:, 0], supply), rtol=1e-12, atol=1e-9)
    crossed = flux.outflow[:, MAIN] * cells.demand[:, RAMP]
    np.testing.assert_allclose(
        crossed, flux.outflow[:, RAMP] * cells.demand[:, MAIN], rtol=1e-12, atol=1e-6
    )


@given(seed=seeds)
def test_diverge_that_nobody_takes_is_a_plain_face(seed):
    plain = model_of(Road(n_mainline=4))
    for share, tolerance in ((0.0, 1e-9), (1e-12, 1e-6)):
        model = model_of(replace(DIVERGE, exit_shares=(share,)))
        states, inputs = drawn(model, seed)
        states[:, 2 * RAMP + 1] += 1.0  # a ramp that takes in something, however little
        flux = model.fluxes(states, inputs)
        straight = plain.fluxes(states[:, :8], inputs[:, :3])
        moving = model.cells(states).speed[:, RAMP] > 1.0
        rows = moving if share > 0.0 else slice(None)
        np.testing.assert_allclose(
            flux.outflow[rows, :4], straight.outflow[rows], rtol=1e-9, atol=tolerance
        )


@given(seed=seeds)
def test_diverge_splits_by_share_and_keeps_w(seed):
    model = model_of(DIVERGE)
    states, inputs = drawn(model, seed)
    flux, w = model.fluxes(states, inputs), model.cells(states).w
    inflow = flux.outflow @ model.layout.routing.T
    relative = flux.relative_outflow @ model.layout.routing.T
    np.testing.assert_allclose(inflow[:, DOWN], 0.9 * flux.outflow[:, MAIN], rtol=1e-12)
    np.testing.assert_allclose(inflow[:, RAMP], 0.1 * flux.outflow[:, MAIN], rtol=1e-12)
    np.testing.assert_allclose(relative[:, RAMP], inflow[:, RAMP] * w[:, MAIN], rtol=1e-12)


@given(seed=seeds)
def test_neither_branch_of_a_diverge_takes_more_than_it_can(seed):
    model = model_of(DIVERGE)
    states, inputs = drawn(model, seed)
    cells, flux = model.cells(states), model.fluxes(states, inputs)
    for branch, share in ((DOWN, 0.9), (RAMP, 0.1)):
        supply = model.relations.supply(
            cells.w[:, MAIN], cells.speed[:, branch], model.jam_density[branch]
        )
        assert np.all(share * flux.outflow[:, MAIN] <= supply * (1.0 + 1e-12))


def test_a_blocked_ramp_stops_the_mainline():
    model = model_of(DIVERGE)
    density, speed = np.full((1, 5), 50.0), np.full((1, 5), 90.0)
    density[0, RAMP], speed[0, RAMP] = PAPER.jam_density / 3.0, 0.0
    inputs = np.array([[0.0, PAPER.free_flow_speed, 0.0, 0.0]])
    blocked = model.fluxes(model.states(density, speed), inputs).outflow[0, MAIN]
    assert abs(blocked) < 1e-9
    density[0, RAMP], speed[0, RAMP] = 20.0, 60.0
    assert model.fluxes(model.states(density, speed), inputs).outflow[0, MAIN] > 1000.0


def test_a_ramp_of_one_lane_holds_a_third():
    model = model_of(Road(n_mainline=4, on_ramps=(2,)))
    np.testing.assert_allclose(model.jam_density, [333.0, 333.0, 333.0, 333.0, 111.0])
    np.testing.assert_allclose(model.entry_jam_density, [333.0, 111.0])
