"""Compiled filters agree with the model about densities, speeds and their Jacobians."""

import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.simple import estimated_traffic
from dptse_env.model.model import make_road_arrays
from dptse_env.model.parameters import VACUUM
from dptse_env.model.step import released
from tests.estimators.parts import compiled

from .episodes import RELEASES, model_of, scale_of, simulate, started

released = compiled(released)


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


@pytest.mark.parametrize("release", RELEASES)
@pytest.mark.parametrize("parameters", ["paper", "w99-3lane"])
def test_a_release_and_its_derivatives_are_the_models(parameters, release):
    model, rng = model_of(parameters, release), np.random.default_rng(0)
    shape = (20, model.n_segments)
    density = rng.uniform(0.0, 1.0, shape) ** 3 * model.jam_density
    density[rng.random(shape) < 0.1] = 0.0
    states = model.states(density, rng.uniform(0.0, 1.1, shape) * model.speed_scale)
    states -= 0.01 * scale_of(model) * (rng.random(states.shape) < 0.1)  # some negative
    road = make_road_arrays(model)
    centre = np.nan if model.reference_speed is None else model.reference_speed
    found = np.array(
        [
            [released(road, s, *pair, centre) for s, pair in enumerate(state.reshape(-1, 2))]
            for state in states
        ]
    )
    atol = 1e-12 * road.second_scale
    np.testing.assert_allclose(found[..., 0], model.measure(states)[..., 1], rtol=0.0, atol=atol)
    n, S = shape
    matrix = model.measurement_matrix(states)[:, :, 1].reshape(n, S, S, 2)
    by_state = matrix[:, np.arange(S), np.arange(S)]
    np.testing.assert_allclose(found[..., 1:], by_state, rtol=1e-12, atol=1e-12)
