"""Rows of a measurement: averages over one or several neighbouring segments."""

import numpy as np
import pytest

from dptse_env.model import ARZModel, MeasurementRows

from .roads import HIGHWAY, W99, random_states

ROWS = MeasurementRows(np.array([0, 3, 4, 13, 16]), np.array([1, 2, 3, 2, 1]), 19)


def test_a_row_is_the_average_of_its_segments():
    values = np.random.default_rng(0).normal(size=(4, 19, 2))
    averages = ROWS.averages(values)
    for m, (first, span) in enumerate(zip(ROWS.first, ROWS.span, strict=True)):
        np.testing.assert_allclose(averages[:, m], values[:, first : first + span].mean(axis=1))


def test_single_rows_are_the_segments():
    single = MeasurementRows.single(19)
    assert single.are_single
    assert not ROWS.are_single
    values = np.random.default_rng(0).normal(size=(4, 19, 2))
    np.testing.assert_array_equal(single.averages(values), values)


@pytest.mark.parametrize(
    ("first", "span"), [(-1, 1), (18, 2), (3, 0), (19, 1)], ids=["before", "beyond", "empty", "out"]
)
def test_a_row_off_the_road_is_refused(first, span):
    with pytest.raises(ValueError, match=r"rows\[1\] must cover segments in 0\.\.18, got"):
        MeasurementRows(np.array([0, first]), np.array([1, span]), 19)


def test_mean_speeds_have_no_rows_of_several_segments():
    with pytest.raises(ValueError, match=r"model\.rows must be single segments"):
        ARZModel(HIGHWAY, W99, rows=ROWS)


@pytest.mark.parametrize("demand_states", [False, True])
def test_a_measurement_averages_flows_around_the_centre_of_each_segment(demand_states):
    rng = np.random.default_rng(3)
    model = ARZModel(HIGHWAY, W99, 1.0, 51.0, ROWS, demand_states)
    states = model.project(random_states(model, 6, rng))
    centre = rng.uniform(0.0, 100.0, (6, 19))
    density, speed = model.density(states), model.speed(states)
    expected = np.stack([density, density * (speed - centre)], axis=-1)
    np.testing.assert_allclose(
        model.measure(states, centre), ROWS.averages(expected), rtol=1e-9, atol=1e-6
    )
    matrix = model.measurement_matrix(states, centre)
    for component in range(model.n_states):
        size = 1e-4 * model.state_scale[component]
        step = size * (np.arange(model.n_states) == component)
        change = model.measure(states + step, centre) - model.measure(states - step, centre)
        np.testing.assert_allclose(
            matrix[..., component], change / (2.0 * size), rtol=1e-3, atol=1e-3
        )
