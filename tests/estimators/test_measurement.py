"""The measurement that estimators are given, and what they refuse."""

import numpy as np
import pytest

from dptse_env.estimators import ESTIMATORS, Measurement
from tests.helpers import Road
from tests.model.roads import model_of

from .episodes import random_streams, simulate, started


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observed": np.zeros((2, 4), bool)}, r"observed .* \(k, 5\), got \(2, 4\)"),
        ({"values": np.zeros((2, 5))}, r"values .* \(2, 5, 2\), got \(2, 5\)"),
        ({"sigma": np.ones(3)}, r"sigma .* \(2, 5, 2\) .*, got \(3,\)"),
        ({"sigma": np.array([[1.0, 1.0]] * 4 + [[1.0, -2.0]])}, "sigma must be finite and >= 0"),
        ({"centre": np.ones((2, 4))}, r"centre .* \(2, 5\) .*, got \(2, 4\)"),
        ({"centre": np.full(5, np.nan)}, "centre must be finite"),
    ],
)
def test_bad_measurements_are_named(changes, message):
    good = {
        "observed": np.ones((2, 5), bool),
        "values": np.zeros((2, 5, 2)),
        "sigma": np.ones(2),
        "centre": np.ones(5),
    }
    model = model_of(Road(n_mainline=5), reference_speed=50.0)
    with pytest.raises(ValueError, match=message):
        Measurement.of(model, **{**good, **changes})


def test_what_a_measurement_leaves_out_is_filled_in():
    observed, values, sigma = np.ones((2, 5), bool), np.zeros((2, 5, 2)), np.array([3.0, 4.0])
    flows = model_of(Road(n_mainline=5), reference_speed=50.0)
    given = Measurement.of(flows, observed, values, sigma)
    np.testing.assert_array_equal(given.sigma, np.broadcast_to(sigma, (2, 5, 2)))
    np.testing.assert_array_equal(given.centre, np.full((2, 5), 50.0))
    speeds = model_of(Road(n_mainline=5))
    given = Measurement.of(speeds, observed, values, sigma, np.full(5, 7.0))
    assert np.isnan(given.centre).all()  # speeds have no centre


def test_boundary_columns_are_left_out():
    parts = np.ones((2, 7), bool), np.ones((2, 7, 2)), np.ones((2, 7, 2)), np.ones((2, 6))
    own = Measurement(*parts).on_road(5, 4)
    assert [array.shape for array in own] == [(2, 5), (2, 5, 2), (2, 5, 2), (2, 4)]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_an_estimator_checks_the_shapes_that_it_is_given(name):
    estimator, one = started(name, "compiled", simulate(n_steps=1)), np.arange(1)
    with pytest.raises(ValueError, match=r"states must have shape \(1, 38\), got \(1, 37\)"):
        estimator.reset(one, np.zeros((1, 37)), random_streams(1))
    with pytest.raises(ValueError, match=r"inputs must have shape \(1, 9\), got \(9,\)"):
        estimator.predict(one, np.zeros(9))
