import numpy as np
import pytest

from dptse_env.estimators import BACKENDS, ESTIMATORS
from dptse_env.estimators.batch import checked_episodes, checked_measurements

from .episodes import random_streams, simulate, started


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
        ({"sigma": np.ones(3)}, r"sigma must have shape \(2,\), got \(3,\)"),
        ({"sigma": np.array([1.0, -1.0])}, r"sigma\[1\] must be finite and >= 0, got -1\.0"),
        ({"sigma": np.array([np.inf, 1.0])}, r"sigma\[0\] must be finite and >= 0, got inf"),
    ],
)
def test_bad_measurements_are_named(changes, message):
    good = {
        "episodes": np.arange(2),
        "observed": np.ones((2, 5), bool),
        "values": np.zeros((2, 5, 2)),
        "sigma": np.ones(2),
    }
    with pytest.raises(ValueError, match=message):
        checked_measurements(2, 5, **{**good, **changes})


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_checks_what_it_is_given(name, backend):
    estimator, one = started(name, backend, simulate(n_steps=1)), np.arange(1)
    with pytest.raises(ValueError, match=r"states must have shape \(1, 38\), got \(1, 37\)"):
        estimator.reset(one, np.zeros((1, 37)), random_streams(1))
    with pytest.raises(ValueError, match=r"inputs must have shape \(1, 9\), got \(9,\)"):
        estimator.predict(one, np.zeros(9))
    with pytest.raises(ValueError, match=r"episodes must be in 0\.\.0, got 1"):
        estimator.predict(np.array([1]), np.zeros((1, 9)))
