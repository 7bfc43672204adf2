"""Boundary inputs: true, nominal and private, and the states and flows of the published demand."""

import dataclasses

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.estimators import Measurement
from dptse_env.measurement.boundary import (
    BOUNDARIES,
    PrivateBoundary,
    free_flow_density,
    nominal_flows,
    nominal_inputs,
    nominal_state,
)
from dptse_env.model import ARZModel, load_parameters
from dptse_env.parts import make_model, make_release
from dptse_env.process import QueryProcess
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY, DemandDistribution, randomised
from tests.release.worlds import ONE

CENTRE = 0.5 * SHORT_HIGHWAY.geometry.speed_limit
R = SHORT_HIGHWAY.geometry.n_cells - SHORT_HIGHWAY.geometry.n_segments


def make(kind, preset="capped", n_episodes=1):
    """A boundary of the short road, and its model; `corrected` releases mean speeds."""
    privacy = {"preset": preset, "boundary_inputs": kind}
    keywords = {"privacy": privacy, "traffic_seeds": "0:2", "parameters": "w99-3lane"}
    config = resolve("short-plain", keywords)
    release, model = make_release(config, n_episodes), make_model(config)
    boundary = BOUNDARIES[kind](release.task, release.traffic, model)
    release.traffic.load([0, 1])
    return boundary, model


def take(boundary, density, speed, centre=None):
    """Have an episode's boundary segments released, (1, R), and nothing of the road.

    Speeds are released as they are, or as flows around a centre of each segment.
    """
    model = boundary.model
    if centre is not None:
        speed = density * (speed - centre)
    values = np.zeros((1, model.channels.size + R, 2))
    values[:, model.channels.size :, 0], values[:, model.channels.size :, 1] = density, speed
    places = np.full((1, model.n_segments + R), np.nan if centre is None else CENTRE)
    places[:, model.n_segments :] = np.nan if centre is None else centre
    observed = np.ones(values.shape[:2], dtype=bool)
    boundary.update(ONE, Measurement(observed, values, np.ones(values.shape), places))


def at(boundary, time, index=0, episode=0):
    return boundary.inputs(np.array([episode]), np.array([index]), np.array([time]))[0]


def test_true_inputs_are_those_of_the_boundary_segments_and_nominal_ones_the_demand():
    true, model = make("true", "corrected")
    nominal, _ = make("nominal")
    table = nominal_inputs(SHORT_HIGHWAY, model)
    for index, time in ((0, 0), (0, 150), (1, 150), (1, 240)):
        ends = true.traffic.complete(index)[[time], model.n_segments :]
        expected = model.boundary_inputs(ends[..., 0], ends[..., 1])[0]
        np.testing.assert_array_equal(at(true, time, index), expected)
        np.testing.assert_array_equal(at(nominal, time, index), table[time])
    assert (at(true, 150, 0) != at(true, 150, 1)).any()


def test_private_inputs_are_nominal_at_first_and_then_the_last_release_around_its_own_centre():
    boundary, model = make("private", n_episodes=2)
    table = nominal_inputs(SHORT_HIGHWAY, model)
    np.testing.assert_array_equal(at(boundary, 7), table[7])
    speed, centre = np.linspace(20.0, 90.0, R)[None], np.linspace(70.0, 30.0, R)
    for density in (np.full((1, R), 30.0), np.full((1, R), 60.0)):
        take(boundary, density, speed, centre)
        expected = model.boundary_inputs(density, speed)[0]
        for time in (8, 9):  # until the next release
            np.testing.assert_allclose(at(boundary, time), expected, rtol=1e-12)
    np.testing.assert_array_equal(at(boundary, 8, episode=1), table[8])  # nothing released yet
    boundary.reset(ONE)
    np.testing.assert_array_equal(at(boundary, 3), table[3])


@pytest.mark.parametrize(
    ("preset", "density", "speed", "read_density", "read_speed"),
    [
        ("capped", -400.0, 30.0, 0.0, "free"),
        ("capped", 9.9, 10.0, 9.9, "free"),  # less than a vehicle: the flow is noise
        ("capped", 10.1, 10.0, 10.1, 10.0),
        ("capped", 60.0, -30.0, 60.0, 0.0),
        ("capped", 60.0, 1e3, 60.0, "largest"),
        ("capped", 1e7, CENTRE, "jam", CENTRE),
        ("corrected", 9.9, -30.0, 9.9, 0.0),
        ("corrected", 1e7, 1e7, "jam", "largest"),
    ],
)
def test_a_release_is_read_within_what_a_road_can_hold(
    preset, density, speed, read_density, read_speed
):
    boundary, model = make("private", preset)
    take(boundary, np.full((1, R), density), speed, CENTRE if preset == "capped" else None)
    jam = model.arz.jam[model.n_segments :]
    named = {"free": model.parameters.free_flow_speed, "largest": model.largest_speed, "jam": jam}
    read = (np.full((1, R), named.get(each, each)) for each in (read_density, read_speed))
    np.testing.assert_allclose(at(boundary, 1), model.boundary_inputs(*read)[0], rtol=1e-12)


def test_boundary_segments_are_released_at_every_step_and_drive_the_next():
    privacy = {"preset": "capped", "boundary_inputs": "private"}
    keywords = {"traffic_seeds": "0:2", "horizon": 100, "random_start": True, "privacy": privacy}
    process = QueryProcess(resolve("short-plain", keywords))
    process.reset(ONE, [np.random.default_rng(3)], {"traffic_seed": 1, "start": 100})
    released, inputs = [], []
    release, predict = process.release.release, process.estimator.predict

    def spy_release(request):
        released.append(release(request))
        return released[-1]

    def spy_predict(episodes, given):
        inputs.append(given.copy())
        predict(episodes, given)

    process.release.release, process.estimator.predict = spy_release, spy_predict
    for _ in range(5):
        process.step(ONE, np.zeros((1, 6), dtype=np.int8))
    np.testing.assert_array_equal(inputs[0][0], nominal_inputs(SHORT_HIGHWAY, process.model)[100])
    other = PrivateBoundary(process.release.task, process.traffic, process.model)
    for measured, following in zip(released, inputs[1:], strict=False):
        assert measured.observed[:, -R:].all()
        other.update(ONE, measured)
        np.testing.assert_array_equal(following[0], at(other, 0))


# --- the published demand -------------------------------------------------------------------------


@pytest.fixture(params=["published", "w99-3lane"])
def model(request):
    return ARZModel(PAPER_HIGHWAY.road, load_parameters(request.param))


def test_flows_add_up_along_the_road_at_the_demand_of_the_moment():
    for time, rate in ((0.0, 2050.0), (199, 2050.0), (200, 6050.0), (399, 6050.0), (400, 2050.0)):
        flows, entering = nominal_flows(PAPER_HIGHWAY, time), rate + 320.0
        before_second_exit = 0.9 * entering + 300.0
        mainline = [rate, entering, 0.9 * entering, before_second_exit, 0.9 * before_second_exit]
        np.testing.assert_allclose(flows[:15], np.repeat(mainline, 3))
        np.testing.assert_allclose(flows[15:], [320, 300, 0.1 * entering, 0.1 * before_second_exit])


def test_shares_of_exits_that_the_demand_has_by_time_go_before_the_road_s():
    shares = ((0.0, 0.1), (200.0, 0.5)), ((0.0, 0.2),)
    demand = dataclasses.replace(PAPER_HIGHWAY.conditions.demand, exit_shares=shares)
    flows = nominal_flows(PAPER_HIGHWAY.replaced(demand=demand), np.array([100, 300]))
    np.testing.assert_allclose(flows[:, 17], [237.0, 3185.0])
    np.testing.assert_allclose(flows[:, 18], 0.2 * flows[:, 11])


def test_a_distribution_counts_with_its_base_and_neither_incident_nor_draws_count(model):
    random = PAPER_HIGHWAY.replaced(demand=DemandDistribution(PAPER_HIGHWAY.conditions.demand))
    expected = nominal_inputs(PAPER_HIGHWAY, model)
    for road in (random, randomised(PAPER_HIGHWAY)):
        assert road != PAPER_HIGHWAY
        np.testing.assert_array_equal(nominal_inputs(road, model), expected)


def test_the_density_carries_the_flow_freely(model):
    flow = np.full(19, 250.0)
    density = free_flow_density(model, flow)
    v_f, gamma = model.parameters.free_flow_speed, model.parameters.gamma
    speed = v_f * (1.0 - (density / model.jam_density) ** gamma)
    np.testing.assert_allclose(density * speed, flow, rtol=1e-3)
    critical = model.jam_density * (1.0 + gamma) ** (-1.0 / gamma)
    assert (density < critical).all()
    np.testing.assert_allclose(free_flow_density(model, np.full(19, 1e6)), critical)


def test_nominal_inputs_are_the_demand_and_the_nominal_state_hardly_moves_under_them(model):
    inputs, road, v_f = (
        nominal_inputs(PAPER_HIGHWAY, model), model.road, model.parameters.free_flow_speed,
    )  # fmt: skip
    assert inputs.shape == (701, model.n_inputs)
    rates = [[6050.0 if 200 <= t < 400 else 2050.0, 320.0, 300.0] for t in range(701)]
    np.testing.assert_allclose(inputs[:, road.entry_inputs], rates)
    np.testing.assert_array_equal(inputs[:, road.entry_inputs + 1], v_f)
    # Behind the exits the flow that reaches them is carried freely.
    jam, density = model.arz.jam[road.exit_cells], inputs[:, road.exit_inputs]
    carried = density * v_f * (1.0 - (density / jam) ** model.parameters.gamma)
    flows = nominal_flows(PAPER_HIGHWAY, np.arange(701))
    free = inputs[:, road.entry_inputs[0]] < 3000.0
    np.testing.assert_allclose(carried[free], flows[free][:, [14, 17, 18]], rtol=1e-3)
    state = nominal_state(PAPER_HIGHWAY, model, 0.0)[None]
    after = state
    for _ in range(100):
        after = model.step(after, inputs[:1])
    # Ramps merge with a w of v_f as well, so only the drop of speed behind a merge is left.
    np.testing.assert_allclose(model.density(after), model.density(state), rtol=0.02, atol=0.1)
