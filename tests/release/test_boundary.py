import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.config import resolve
from dptse_env.estimators import Measurement
from dptse_env.model import ARZModel, load_parameters
from dptse_env.parts import make_model, make_parts, make_release
from dptse_env.process import QueryProcess
from dptse_env.release.boundary import (
    BOUNDARIES,
    NominalBoundary,
    PrivateBoundary,
    TrueBoundary,
    free_flow_density,
    nominal_flows,
    nominal_inputs,
    nominal_state,
)
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY, DemandDistribution, randomised

from .worlds import ONE

CENTRE = 0.5 * SHORT_HIGHWAY.speed_limit


def make(kind, speeds="flow", n_episodes=1):
    """A boundary of the short road, and its model; of released flows or mean speeds."""
    privacy = {"preset": "capped", "boundary_inputs": kind, "speed_release": speeds}
    keywords = {"privacy": privacy, "traffic_seeds": "0:2", "parameters": "w99-3lane"}
    config = resolve("short-highway", keywords)
    release = make_release(config, n_episodes)
    model = make_model(config)
    boundary = BOUNDARIES[kind](release.task, release.traffic, model)
    for index in release.traffic.load([0, 1]):
        boundary.load(index)
    return boundary, model


def take(boundary, released, arz, centre=None):
    """Have an episode's boundary segments released, (1, R, 2), and nothing of the road."""
    nothing = np.zeros((1, arz.rows.n_rows, 2))
    values = np.concatenate([nothing, released], axis=1)
    observed = np.ones(values.shape[:2], dtype=bool)
    if centre is None:
        centre = np.nan if arz.reference_speed is None else arz.reference_speed
    places = np.broadcast_to(centre, (1, arz.n_segments + arz.n_boundaries))
    boundary.update(ONE, Measurement(observed, values, np.ones(values.shape), places))


def at(boundary, time, index=0, episode=0):
    return boundary.inputs(np.array([episode]), np.array([index]), np.array([time]))[0]


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("true", TrueBoundary), ("nominal", NominalBoundary), ("private", PrivateBoundary)],
)
def test_a_kind_by_its_name(kind, expected):
    boundary, _ = make(kind)
    assert type(boundary) is expected
    assert boundary.void_reasons == (("boundary_inputs",) if kind == "true" else ())


def test_true_inputs_are_those_of_the_boundary_segments():
    boundary, arz = make("true", "mean")
    for index, time in ((0, 0), (0, 150), (1, 150), (1, 240)):
        ends = boundary.traffic.complete(index)[[time], arz.n_segments :]
        expected = arz.boundary_inputs(ends[..., 0], ends[..., 1])[0]
        np.testing.assert_array_equal(at(boundary, time, index), expected)
    assert (at(boundary, 150, 0) != at(boundary, 150, 1)).any()


def test_nominal_inputs_are_the_same_for_every_seed():
    boundary, arz = make("nominal")
    table = nominal_inputs(SHORT_HIGHWAY, arz)
    for time in (0, 120, 240):
        for index in range(2):
            np.testing.assert_array_equal(at(boundary, time, index), table[time])


def test_private_inputs_are_nominal_at_first_and_then_the_last_release():
    (boundary, arz), n = make("private", n_episodes=2), SHORT_HIGHWAY.n_boundaries
    table = nominal_inputs(SHORT_HIGHWAY, arz)
    np.testing.assert_array_equal(at(boundary, 7), table[7])
    density, speed = np.full((1, n), 30.0), np.linspace(20.0, 90.0, n)[None]
    flow = density * (speed - CENTRE)
    take(boundary, np.stack([density, flow], axis=-1), arz)
    expected = arz.boundary_inputs(density, speed)[0]
    for time in (8, 9):  # until the next release
        np.testing.assert_allclose(at(boundary, time), expected, rtol=1e-12)
    np.testing.assert_array_equal(at(boundary, 8, episode=1), table[8])  # nothing released yet
    take(boundary, np.stack([2 * density, 2 * flow], axis=-1), arz)
    expected = arz.boundary_inputs(2 * density, speed)[0]
    np.testing.assert_allclose(at(boundary, 9), expected, rtol=1e-12)
    boundary.reset(ONE)
    np.testing.assert_array_equal(at(boundary, 3), table[3])


def test_a_released_mean_speed_is_taken_as_it_is():
    (boundary, arz), n = make("private", "mean"), SHORT_HIGHWAY.n_boundaries
    released = np.stack([np.full((1, n), 30.0), np.full((1, n), 60.0)], axis=-1)
    take(boundary, released, arz)
    expected = arz.boundary_inputs(released[..., 0], released[..., 1])[0]
    np.testing.assert_array_equal(at(boundary, 1), expected)


@pytest.fixture(scope="module")
def private():
    return {speeds: make("private", speeds) for speeds in ("mean", "flow")}


@pytest.mark.parametrize("speeds", ["mean", "flow"])
@given(data=st.data())
def test_whatever_noise_makes_of_a_release_gives_inputs_that_a_road_can_have(private, speeds, data):
    boundary, arz = private[speeds]
    size = st.floats(-1e7, 1e7) | st.sampled_from([0.0, -1e-300, 1e-300, 9.999, 10.0])
    released = data.draw(arrays(float, (1, arz.n_boundaries, 2), elements=size))
    take(boundary, released, arz)
    inputs = at(boundary, 1)
    layout, v_f = arz.layout, arz.parameters.free_flow_speed
    assert np.isfinite(inputs).all()
    assert (inputs >= 0.0).all()
    assert (inputs[layout.entry_inputs + 1] <= arz.largest_speed).all()  # w, of the CFL condition
    assert (inputs[layout.entry_inputs] <= arz.entry_jam_density * 1.1 * v_f).all()
    assert (inputs[layout.exit_inputs] <= arz.exit_jam_density).all()
    state = arz.project(np.full((1, arz.n_states), 30.0))
    assert np.isfinite(arz.step(state, inputs[None])).all()


def test_a_negative_density_demands_nothing_and_leaves_the_exits_free():
    boundary, arz = make("private")
    take(boundary, np.full((1, arz.n_boundaries, 2), -400.0), arz)
    inputs, layout = at(boundary, 1), arz.layout
    np.testing.assert_array_equal(inputs[layout.entry_inputs], 0.0)
    np.testing.assert_array_equal(inputs[layout.exit_inputs], 0.0)


def test_hardly_a_vehicle_says_nothing_of_a_speed():
    """Below one vehicle a segment the flow is noise: what is there drives freely."""
    (boundary, arz), n = make("private"), SHORT_HIGHWAY.n_boundaries
    free = arz.parameters.free_flow_speed
    for density, speed in ((9.9, free), (10.1, CENTRE - 40.0)):
        released = np.stack([np.full((1, n), density), np.full((1, n), -40.0 * density)], axis=-1)
        take(boundary, released, arz)
        expected = arz.boundary_inputs(released[..., 0], np.full((1, n), speed))[0]
        np.testing.assert_allclose(at(boundary, 1), expected, rtol=1e-12)


def test_nobody_drives_backwards_or_faster_than_drivers_do():
    (boundary, arz), n = make("private"), SHORT_HIGHWAY.n_boundaries
    density = np.full((1, n), 60.0)
    for noisy, speed in ((-30.0, 0.0), (1e3, arz.largest_speed)):
        flow = density * (noisy - CENTRE)
        take(boundary, np.stack([density, flow], axis=-1), arz)
        expected = arz.boundary_inputs(density, np.full((1, n), speed))[0]
        np.testing.assert_allclose(at(boundary, 1), expected, rtol=1e-12)


def test_a_flow_is_read_around_the_centre_of_its_own_release():
    """Not around the road's, as where centres are predictions."""
    (boundary, arz), n = make("private"), SHORT_HIGHWAY.n_boundaries
    density, speed = np.full((1, n), 30.0), np.linspace(20.0, 90.0, n)[None]
    centre = np.append(np.full(arz.n_segments, CENTRE), np.linspace(70.0, 30.0, n))
    flow = density * (speed - centre[arz.n_segments :])
    take(boundary, np.stack([density, flow], axis=-1), arz, centre)
    expected = arz.boundary_inputs(density, speed)[0]
    np.testing.assert_allclose(at(boundary, 1), expected, rtol=1e-12)


# --- in the decision process ----------------------------------------------------------------------


def process(boundary, **privacy):
    keywords = {"traffic_seeds": "0:2", "horizon": 100, "random_start": True}
    settings = {"preset": "capped", "boundary_inputs": boundary, **privacy}
    config = resolve("short-highway", {**keywords, "privacy": settings})
    return QueryProcess(make_parts(config, 1))


def test_boundary_segments_are_released_at_every_step_and_drive_the_next():
    private = process("private")
    private.reset(ONE, [np.random.default_rng(3)], {"traffic_seed": 1, "start": 100})
    released, inputs = [], []
    release, predict = private.release.release, private.estimator.predict

    def spy_release(request):
        released.append(release(request))
        return released[-1]

    def spy_predict(episodes, given):
        inputs.append(given.copy())
        predict(episodes, given)

    private.release.release, private.estimator.predict = spy_release, spy_predict
    for _ in range(5):
        private.step(ONE, np.zeros((1, 6), dtype=np.int8))
    np.testing.assert_array_equal(inputs[0][0], nominal_inputs(SHORT_HIGHWAY, private.model)[100])
    other = PrivateBoundary(private.release.task, private.traffic, private.model)
    for k in range(4):
        take(other, released[k].values[:, SHORT_HIGHWAY.n_segments :], private.model)
        np.testing.assert_array_equal(inputs[k + 1][0], at(other, 0))


@pytest.mark.parametrize("boundary", ["nominal", "private"])
def test_appearances_on_boundary_segments_are_charged(boundary):
    """By hand: with nobody queried, only fixed sensors and released boundaries count."""
    playing = process(boundary, cap=5)
    playing.reset(ONE, [np.random.default_rng(3)], {"traffic_seed": 1, "start": 100})
    for _ in range(60):
        playing.step(ONE, np.zeros((1, 6), dtype=np.int8))
    record = playing.traffic.record(1)
    observed = set(SHORT_HIGHWAY.fixed_sensors)
    if boundary == "private":
        observed |= set(range(SHORT_HIGHWAY.n_segments, record.n_columns))
    rows = (record.step > 100) & (record.step <= 160)
    expected = np.zeros(record.n_vehicles, dtype=int)
    for vehicle, segment in zip(record.vehicle[rows], record.segment[rows], strict=True):
        expected[vehicle] += segment in observed
    (exposures,) = playing.release.private(ONE, np.array([1]))["exposures"]
    np.testing.assert_array_equal(exposures, np.minimum(expected, 5))
    assert (expected > 5).any()


# --- the published demand -------------------------------------------------------------------------


@pytest.fixture(params=["paper", "w99-3lane"])
def model(request):
    return ARZModel(PAPER_HIGHWAY, load_parameters(request.param))


def test_flows_add_up_along_the_road():
    flows = nominal_flows(PAPER_HIGHWAY, 0.0)
    entering, leaving_first = 2050.0 + 320.0, 0.1 * (2050.0 + 320.0)
    np.testing.assert_allclose(flows[:3], 2050.0)
    np.testing.assert_allclose(flows[3:6], entering)
    np.testing.assert_allclose(flows[6:9], entering - leaving_first)
    before_second_exit = entering - leaving_first + 300.0
    np.testing.assert_allclose(flows[9:12], before_second_exit)
    np.testing.assert_allclose(flows[12:15], 0.9 * before_second_exit)
    np.testing.assert_allclose(flows[15:], [320.0, 300.0, leaving_first, 0.1 * before_second_exit])


@pytest.mark.parametrize(
    ("time", "rate"), [(0, 2050), (199, 2050), (200, 6050), (399, 6050), (400, 2050), (700, 2050)]
)
def test_the_demand_of_the_moment_counts(time, rate):
    assert nominal_flows(PAPER_HIGHWAY, time)[0] == rate


def test_a_distribution_counts_with_its_base():
    random = dataclasses.replace(PAPER_HIGHWAY, demand=DemandDistribution(PAPER_HIGHWAY.demand))
    np.testing.assert_array_equal(nominal_flows(random, 0.0), nominal_flows(PAPER_HIGHWAY, 0.0))


def test_the_density_carries_the_flow_freely(model):
    flow = np.full(19, 250.0)
    density = free_flow_density(model, flow)
    v_f, gamma = model.parameters.free_flow_speed, model.parameters.gamma
    speed = v_f * (1.0 - (density / model.jam_density) ** gamma)
    np.testing.assert_allclose(density * speed, flow, rtol=1e-3)
    critical = model.jam_density * (1.0 + gamma) ** (-1.0 / gamma)
    assert (density < critical).all()
    np.testing.assert_allclose(free_flow_density(model, np.full(19, 1e6)), critical)


def test_the_nominal_state_hardly_moves_under_its_own_demand(model):
    state = nominal_state(PAPER_HIGHWAY, model, 0.0)[None]
    flows = nominal_flows(PAPER_HIGHWAY, 0.0)
    v_f = model.parameters.free_flow_speed
    inputs = np.array([[flows[0], v_f, 20.0, flows[15], v_f, flows[16], v_f, 2.0, 2.0]])
    after = state
    for _ in range(100):
        after = model.step(after, inputs)
    # Ramps merge with a w of v_f as well, so only the drop of speed behind a merge is left.
    np.testing.assert_allclose(model.density(after), model.density(state), rtol=0.02, atol=0.1)


def test_nominal_inputs_are_the_published_demand_at_every_second(model):
    inputs, layout = nominal_inputs(PAPER_HIGHWAY, model), model.layout
    v_f = model.parameters.free_flow_speed
    assert inputs.shape == (701, model.n_inputs)
    for time in range(701):
        rate = 6050.0 if 200 <= time < 400 else 2050.0
        np.testing.assert_allclose(inputs[time, layout.entry_inputs], [rate, 320.0, 300.0])
    np.testing.assert_array_equal(inputs[:, layout.entry_inputs + 1], v_f)


def test_behind_the_exits_the_flow_that_reaches_them_is_carried_freely(model):
    inputs, layout = nominal_inputs(PAPER_HIGHWAY, model), model.layout
    v_f, gamma, jam = (
        model.parameters.free_flow_speed, model.parameters.gamma, model.exit_jam_density,
    )  # fmt: skip
    for time in (0, 150, 450):
        flows = nominal_flows(PAPER_HIGHWAY, time)
        density = inputs[time, layout.exit_inputs]
        carried = density * v_f * (1.0 - (density / jam) ** gamma)
        np.testing.assert_allclose(carried, flows[[14, 17, 18]], rtol=1e-3)


def test_nominal_inputs_know_neither_incident_nor_draws():
    model = ARZModel(PAPER_HIGHWAY, load_parameters("w99-3lane"))
    drawn = randomised(PAPER_HIGHWAY)
    assert drawn != PAPER_HIGHWAY
    np.testing.assert_array_equal(
        nominal_inputs(drawn, model), nominal_inputs(PAPER_HIGHWAY, model)
    )
