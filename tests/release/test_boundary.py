import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.config import resolve
from dptse_env.estimators import Measurement
from dptse_env.model import ARZModel, load_parameters
from dptse_env.parts import make_parts
from dptse_env.process import QueryProcess
from dptse_env.release.boundary import BOUNDARIES, NominalBoundary, PrivateBoundary, TrueBoundary
from dptse_env.release.nominal import nominal_inputs
from dptse_env.release.traffic_table import TrafficTable
from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary

ONE, CENTRE = np.zeros(1, dtype=np.int64), 0.5 * SHORT_HIGHWAY.speed_limit


def model(reference_speed=CENTRE):
    return ARZModel(SHORT_HIGHWAY, load_parameters("w99-3lane"), reference_speed=reference_speed)


@pytest.fixture(scope="module")
def traffic():
    traffic = TrafficTable(SHORT_HIGHWAY, (0, 1), RecordLibrary())
    traffic.load([0, 1])
    return traffic


def take(boundary, released, arz):
    """Have an episode's boundary segments released, (1, R, 2), and nothing of the road."""
    nothing = np.zeros((1, arz.rows.n_rows, 2))
    values = np.concatenate([nothing, released], axis=1)
    observed = np.ones(values.shape[:2], dtype=bool)
    centre = np.nan if arz.reference_speed is None else arz.reference_speed
    places = np.full((1, arz.n_segments + arz.n_boundaries), centre)
    boundary.update(ONE, Measurement(observed, values, np.ones(values.shape), places))


def at(boundary, time, index=0, episode=0):
    return boundary.inputs(np.array([episode]), np.array([index]), np.array([time]))[0]


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("true", TrueBoundary), ("nominal", NominalBoundary), ("private", PrivateBoundary)],
)
def test_a_kind_by_its_name(traffic, kind, expected):
    boundary = BOUNDARIES[kind](traffic, model(), 1)
    assert type(boundary) is expected
    assert boundary.void_reasons == (("boundary_inputs",) if kind == "true" else ())


def test_true_inputs_are_those_of_the_boundary_segments(traffic):
    arz = model(None)
    boundary = TrueBoundary(traffic, arz, 1)
    for index in range(2):
        boundary.load(index)
    for index, time in ((0, 0), (0, 150), (1, 150), (1, 240)):
        ends = traffic.complete(index)[[time], arz.n_segments :]
        expected = arz.boundary_inputs(ends[..., 0], ends[..., 1])[0]
        np.testing.assert_array_equal(at(boundary, time, index), expected)
    assert (at(boundary, 150, 0) != at(boundary, 150, 1)).any()


def test_nominal_inputs_are_the_same_for_every_seed(traffic):
    boundary, table = NominalBoundary(traffic, model(), 1), nominal_inputs(SHORT_HIGHWAY, model())
    for time in (0, 120, 240):
        for index in range(2):
            np.testing.assert_array_equal(at(boundary, time, index), table[time])


def test_private_inputs_are_nominal_at_first_and_then_the_last_release(traffic):
    arz, n = model(), SHORT_HIGHWAY.n_boundaries
    boundary, table = PrivateBoundary(traffic, arz, 2), nominal_inputs(SHORT_HIGHWAY, arz)
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


def test_a_released_mean_speed_is_taken_as_it_is(traffic):
    arz, n = model(None), SHORT_HIGHWAY.n_boundaries
    boundary = PrivateBoundary(traffic, arz, 1)
    released = np.stack([np.full((1, n), 30.0), np.full((1, n), 60.0)], axis=-1)
    take(boundary, released, arz)
    expected = arz.boundary_inputs(released[..., 0], released[..., 1])[0]
    np.testing.assert_array_equal(at(boundary, 1), expected)


@pytest.mark.parametrize("reference_speed", [None, CENTRE])
@given(data=st.data())
def test_whatever_noise_makes_of_a_release_gives_inputs_that_a_road_can_have(
    traffic, reference_speed, data
):
    arz = model(reference_speed)
    size = st.floats(-1e7, 1e7) | st.sampled_from([0.0, -1e-300, 1e-300, 9.999, 10.0])
    released = data.draw(arrays(float, (1, arz.n_boundaries, 2), elements=size))
    boundary = PrivateBoundary(traffic, arz, 1)
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


def test_a_negative_density_demands_nothing_and_leaves_the_exits_free(traffic):
    arz = model()
    boundary = PrivateBoundary(traffic, arz, 1)
    take(boundary, np.full((1, arz.n_boundaries, 2), -400.0), arz)
    inputs, layout = at(boundary, 1), arz.layout
    np.testing.assert_array_equal(inputs[layout.entry_inputs], 0.0)
    np.testing.assert_array_equal(inputs[layout.exit_inputs], 0.0)


def test_hardly_a_vehicle_says_nothing_of_a_speed(traffic):
    """Below one vehicle a segment the flow is noise: what is there drives freely."""
    arz, n = model(), SHORT_HIGHWAY.n_boundaries
    boundary, free = PrivateBoundary(traffic, arz, 1), arz.parameters.free_flow_speed
    for density, speed in ((9.9, free), (10.1, CENTRE - 40.0)):
        released = np.stack([np.full((1, n), density), np.full((1, n), -40.0 * density)], axis=-1)
        take(boundary, released, arz)
        expected = arz.boundary_inputs(released[..., 0], np.full((1, n), speed))[0]
        np.testing.assert_allclose(at(boundary, 1), expected, rtol=1e-12)


def test_nobody_drives_backwards_or_faster_than_drivers_do(traffic):
    arz, n = model(), SHORT_HIGHWAY.n_boundaries
    boundary, density = PrivateBoundary(traffic, arz, 1), np.full((1, n), 60.0)
    for noisy, speed in ((-30.0, 0.0), (1e3, arz.largest_speed)):
        flow = density * (noisy - CENTRE)
        take(boundary, np.stack([density, flow], axis=-1), arz)
        expected = arz.boundary_inputs(density, np.full((1, n), speed))[0]
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
    release, predict = private.release.mechanism.release, private.estimator.predict

    def spy_release(episodes, values):
        released.append(release(episodes, values))
        return released[-1].copy()

    def spy_predict(episodes, given):
        inputs.append(given.copy())
        predict(episodes, given)

    private.release.mechanism.release, private.estimator.predict = spy_release, spy_predict
    for _ in range(5):
        private.step(ONE, np.zeros((1, 6), dtype=np.int8))
    np.testing.assert_array_equal(inputs[0][0], nominal_inputs(SHORT_HIGHWAY, private.model)[100])
    other = PrivateBoundary(private.traffic, private.model, 1)
    for k in range(4):
        take(other, released[k][:, SHORT_HIGHWAY.n_segments :], private.model)
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
    rows = slice(record.rows(101).start, record.rows(160).stop)
    expected = np.zeros(record.n_vehicles, dtype=int)
    for vehicle, segment in zip(record.vehicle[rows], record.segment[rows], strict=True):
        expected[vehicle] += segment in observed
    exposures = playing.release.contributions.exposures_of(0, 1)
    np.testing.assert_array_equal(exposures, np.minimum(expected, 5))
    assert (expected > 5).any()
