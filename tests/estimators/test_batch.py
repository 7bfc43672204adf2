import numpy as np
import pytest

from dptse_env.estimators.batch import checked_episodes, checked_measurements
from tests.model.roads import Road, model_of

from .episodes import EVERY, random_streams, simulate, started


def test_episodes_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"episodes must be in 0\.\.2, got 3"):
        checked_episodes(np.array([0, 3]), 3)
    with pytest.raises(ValueError, match=r"episodes must be in 0\.\.2, got -1"):
        checked_episodes(np.array([-1]), 3)
    with pytest.raises(ValueError, match=r"vector of indices, got shape \(1, 1\)"):
        checked_episodes(np.array([[1]]), 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observed": np.zeros((2, 4), bool)}, r"observed must have shape \(2, 5\), got \(2, 4\)"),
        ({"values": np.zeros((2, 5))}, r"values must have shape \(2, 5, 2\), got \(2, 5\)"),
        (
            {"sigma": np.ones(3)},
            r"sigma must have shape \(2, 5, 2\) or broadcast to it, got \(3,\)",
        ),
        (
            {"sigma": np.broadcast_to(np.array([1.0, 1.0, 1.0, 1.0, -2.0])[:, None], (2, 5, 2))},
            r"sigma must be finite and >= 0, got -2\.0",
        ),
        ({"centre": np.ones((2, 4))}, r"centre must have shape \(2, 5\) or .*, got \(2, 4\)"),
        ({"centre": np.full(5, np.nan)}, r"centre must be finite, got nan"),
    ],
)
def test_bad_measurements_are_named(changes, message):
    good = {
        "episodes": np.arange(2),
        "observed": np.ones((2, 5), bool),
        "values": np.zeros((2, 5, 2)),
        "sigma": np.ones(2),
        "centre": np.ones(5),
    }
    model = model_of(Road(n_mainline=5), reference_speed=50.0)
    with pytest.raises(ValueError, match=message):
        checked_measurements(2, model, **{**good, **changes})


def test_what_measurements_leave_out_is_filled_in():
    model = model_of(Road(n_mainline=5), reference_speed=50.0)
    values = np.zeros((2, 5, 2))
    sigma = np.array([3.0, 4.0])
    given = checked_measurements(2, model, np.arange(2), np.ones((2, 5), bool), values, sigma, None)
    np.testing.assert_array_equal(given.sigma, np.broadcast_to(sigma, (2, 5, 2)))
    np.testing.assert_array_equal(given.centre, np.full((2, 5), 50.0))
    speeds = model_of(Road(n_mainline=5))
    given = checked_measurements(
        2, speeds, np.arange(2), np.ones((2, 5), bool), values, sigma, np.full(5, 7.0)
    )
    assert np.isnan(given.centre).all()  # speeds have no centre


@pytest.mark.parametrize(("name", "backend"), EVERY[::2])
def test_an_estimator_checks_what_it_is_given(name, backend):
    estimator, one = started(name, backend, simulate(n_steps=1)), np.arange(1)
    with pytest.raises(ValueError, match=r"states must have shape \(1, 38\), got \(1, 37\)"):
        estimator.reset(one, np.zeros((1, 37)), random_streams(1))
    with pytest.raises(ValueError, match=r"inputs must have shape \(1, 9\), got \(9,\)"):
        estimator.predict(one, np.zeros(9))
    with pytest.raises(ValueError, match=r"episodes must be in 0\.\.0, got 1"):
        estimator.predict(np.array([1]), np.zeros((1, 9)))
