"""Blocks of observations: their values, scales and order."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import Estimate
from dptse_env.release import Corrected, PrivacySettings, Queries
from dptse_env.spaces.observations import (
    AGE_CAP,
    ObservationEncoding,
    PublicState,
)
from dptse_env.traffic import Conditions, Corridor, Demand, Geometry, Loops, Scales
from tests.helpers import SumRelease
from tests.release.worlds import task_of

N, S = 4, 6
ROAD = Corridor(
    "road",
    Geometry(N, on_ramps=(1,), off_ramps=(2,), exit_shares=(0.1,)),
    Conditions(Demand(((0.0, 1000.0),), (100.0,)), duration=100),
    Scales(density_scale=100.0, speed_scale=50.0, average_dwell=8.0),
    fixed_sensors=(3, 5),
)


def encoding(blocks=("default",), epsilon=0.1, model=Corrected, **changes):
    settings, queries = PrivacySettings(epsilon=epsilon), Queries.make(N, 2)
    task = task_of(model, settings, ROAD, queries)
    return ObservationEncoding(task, blocks, **changes)


def state(k=2, fill=1.0):
    def full(*shape):
        return np.full((k, *shape), fill)

    return PublicState(
        estimate=Estimate(50 * full(S), 25 * full(S), 10 * full(S), 5 * full(S)),
        released=np.dstack([20 * full(S), 10 * full(S)]),
        innovations=np.dstack([np.arange(S) * full(S), -np.arange(S) * full(S)]),
        age=np.array([[0, 3, AGE_CAP, 10 * AGE_CAP]] * k),
        queried=np.array([[True, False, True, False]] * k),
        picked=np.array([[False, True, False, False]] * k),
    )


def test_blocks_hold_what_their_names_say():
    encoder = encoding(picks_one_by_one=True)
    observation = encoder.encode(state())
    expected = {
        "density": [0.5] * S,
        "speed": [0.5] * S,
        "density_log_std": [np.log(0.1)] * S,
        "speed_log_std": [np.log(0.1)] * S,
        "released_density": [0.2] * N,
        "released_speed": [0.2] * N,
        "density_innovation": [0, 1, 2, 3],
        "speed_innovation": [0, -1, -2, -3],
        "age": [0, 0.05, 1, 1],
        "queried": [1, 0, 1, 0],
        "fixed_density_innovation": [3, 5],
        "fixed_speed_innovation": [-3, -5],
        "bandwidth": [0.5],
        "epsilon": [-1],
        "picked": [0, 1, 0, 0],
    }
    assert list(encoder.slices) == list(expected)
    for name, values in expected.items():
        block = encoder.block(observation, name)
        np.testing.assert_allclose(block, [values, values], rtol=1e-6, err_msg=name)
    assert sum(map(len, expected.values())) == observation.shape[1]


@pytest.mark.parametrize("fill", [0.0, 1e9])
def test_observations_stay_inside_the_space(fill):
    encoder = encoding()
    with np.errstate(invalid="ignore"):
        observation = encoder.encode(state(1, abs(fill)))
    assert observation.dtype == np.float32
    assert encoder.space.contains(observation[0])


def test_a_released_flow_has_its_own_name_and_scale():
    encoder = encoding(epsilon=5.0, model=SumRelease)
    assert "released_speed" not in encoder.slices
    assert list(encoder.slices).index("released_flow") == 5
    released = np.dstack([np.full((2, S), 20.0), np.full((2, S), -2500.0)])
    shown = state()._replace(released=released)
    observation = encoder.encode(shown)
    np.testing.assert_allclose(encoder.block(observation, "released_flow"), [[-0.5] * N] * 2)
    np.testing.assert_allclose(encoder.block(observation, "epsilon"), np.log10(5.0), rtol=1e-6)


def test_loops_show_what_they_reported_last_and_where_they_stand():
    loops = Loops(positions=(0.0, 0.2, 0.4), ramps=(1,), interval=30)
    road = replace(ROAD, loops=loops)
    task = task_of(Corrected, PrivacySettings(epsilon=0.1), road, Queries.make(N, 2))
    encoder, plain = ObservationEncoding(task), encoding()
    assert [*encoder.slices][len(plain.slices) :] == [
        "loop_flow", "loop_speed", "loop_age", "loop_position"
    ]  # fmt: skip
    reported = [[1200.0, 25.0], [0.0, np.nan], [np.nan, np.nan], [1e6, 1e6]]
    shown = state()._replace(readings=np.array([reported] * 2), reading_age=np.array([0.0, 0.5]))
    observation = encoder.encode(shown)
    assert encoder.space.contains(observation[0])
    for name, values in {
        "loop_flow": [[1200.0 / 5000.0, 0.0, -1.0, 4.0]] * 2,
        "loop_speed": [[0.5, -1.0, -1.0, 4.0]] * 2,
        "loop_age": [[0.0], [0.5]],
        "loop_position": [[0.0, 0.5, 1.0, 0.25]] * 2,
    }.items():
        block = encoder.block(observation, name)
        np.testing.assert_allclose(block, values, rtol=1e-6, err_msg=name)
    size = plain.space.shape[0]
    np.testing.assert_array_equal(observation[:, :size], plain.encode(state()))
    chosen = encoding(["loop_flow", "loop_speed", "loop_age", "loop_position", "age"])
    assert chosen.encode(state()).shape == (2, 1 + N)


def test_blocks_can_be_chosen_in_any_order_and_stand_once():
    encoder = encoding(("age", "speed"))
    assert list(encoder.slices) == ["age", "speed"]
    observation = encoder.encode(state())
    assert observation.shape == (2, N + S)
    np.testing.assert_allclose(encoder.block(observation, "age"), [[0, 0.05, 1, 1]] * 2)
    assert encoder.space.contains(observation[0])
    for blocks in (("age", "age"), ("default", "age")):
        with pytest.raises(ValueError, match="observation has two blocks named 'age'"):
            encoding(blocks)
    for blocks in ((), ("loop_flow",)):
        with pytest.raises(ValueError, match=r"^observation must be blocks that have numbers on"):
            encoding(blocks)
