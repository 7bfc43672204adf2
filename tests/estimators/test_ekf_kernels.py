"""Compiled filters agree with the model about what is on a nearly empty road."""

import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.simple import estimated_traffic
from dptse_env.model.parameters import VACUUM

from .episodes import simulate, started


@pytest.mark.parametrize("name", ["ekf", "ukf", "mhe"])
def test_the_estimate_of_a_nearly_empty_road_is_the_models(name):
    """Below VACUUM a cell has the free speed, whatever its psi is."""
    episodes = simulate("paper", n=8, n_steps=1)
    model = episodes.model
    estimator = started(name, "compiled", episodes, EstimatorSettings(bounds="box"))
    share = np.array([0.0, 0.5, 1.0, 1.0 + 1e-9, 2.0, 1e3, 1e10, 2e11]) * VACUUM
    density = share[:, None] * model.jam_density
    w = np.linspace(0.0, 2.0 * model.speed_scale, 19)
    states = np.stack([density, w * density], axis=-1).reshape(8, -1)
    states[:4, 1::2] += 1e-6  # more than the vacuum's density could carry
    estimator._filters.means[:] = states
    shown = estimator.estimate()
    expected_density, expected_speed = estimated_traffic(model, states)
    np.testing.assert_array_equal(shown.density, expected_density)
    np.testing.assert_allclose(shown.speed, expected_speed, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(shown.speed[:3], model.speed_scale)
    assert np.isfinite(shown.speed_std).all()
