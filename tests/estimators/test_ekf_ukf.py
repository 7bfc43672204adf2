"""Extended and unscented Kalman filters beside their references, and both beside textbooks."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    EstimatorSettings,
)
from dptse_env.estimators.simple import estimated_traffic
from dptse_env.model.parameters import VACUUM
from tests.helpers import pairwise

from .helpers import (
    PLAIN,
    RICH,
    run,
    simulate,
    started,
    step,
    update,
)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
@pytest.mark.parametrize(
    ("release", "bounds", "settings"),
    [("rows", "cone", RICH), ("flow", "cone", PLAIN), ("speed", "box", PLAIN)],
)
def test_backends_take_the_same_steps(name, release, bounds, settings):
    """In the box w has no bound: there states break the CFL condition and blow up rounding."""
    in_box = bounds == "box"
    episodes = simulate("published" if in_box else "w99-3lane", n_steps=100, release=release)
    settings = replace(settings, bounds=bounds)
    compiled, reference = (started(name, kind, episodes, settings) for kind in BACKENDS)
    one, scale = reference.filters[0], compiled.model.state_scale
    assert compiled.model.n_demand_states == (0 if settings.demand is None else 3)
    # The UKF amplifies rounding everywhere, its reference against itself as well.
    tolerance = 1e-6 if in_box and name == "ukf" else 1e-9
    close, far = {"rtol": tolerance, "atol": tolerance}, {"rtol": 1e-9, "atol": 1e3 * tolerance}

    def compare():
        assert not np.any(compiled.diverged | reference.diverged)
        np.testing.assert_allclose(compiled.states / scale, reference.states / scale, **close)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, **close)
        np.testing.assert_allclose(  # P is near 100 on the way in the box
            compiled.covariances, reference.covariances, **(far if in_box else close)
        )

    for k in range(100):
        if in_box or name == "ukf":  # from the same state, so that rounding does not grow
            one.x, one.P = compiled.states[0] / scale, compiled.covariances[0]
        for each in (compiled, reference):
            step(each, episodes, k)
        compare()
        if k % 7 == 0:  # for a second update the UKF makes new points
            for each in (compiled, reference):
                update(each, episodes, k, observed=~episodes.observed[k])
            compare()
    for a, b in zip(compiled.estimate(), reference.estimate(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
@pytest.mark.parametrize(
    ("backend", "poison"),
    pairwise(BACKENDS, [np.nan, np.inf, -1.0, "indefinite"], rest=False),
)
def test_a_broken_covariance_is_found(name, backend, poison):
    episodes = simulate(n_steps=5)
    filters = started(name, backend, episodes)
    run(filters, episodes, range(3))
    kept = filters.filters.covariances if backend == "compiled" else filters.filters[0].P[None]
    if poison == "indefinite":
        kept[0, 20, 4] = kept[0, 4, 20] = 10.0
    else:
        kept[0, 20, 20] = poison
    update(filters, episodes, 4)
    assert filters.diverged.tolist() == [True]
    np.testing.assert_array_equal(filters.covariances[0], 1e-3 * np.eye(38))


@pytest.mark.parametrize("name", ["ekf", "ukf", "mhe"])
def test_the_estimate_of_a_nearly_empty_road_is_the_models(name):
    """Below VACUUM a cell has the free speed, whatever its psi is."""
    episodes = simulate("published", n=8, n_steps=1)
    model = episodes.model
    estimator = started(name, "compiled", episodes, EstimatorSettings(bounds="box"))
    share = np.array([0.0, 0.5, 1.0, 1.0 + 1e-9, 2.0, 1e3, 1e10, 2e11]) * VACUUM
    density = share[:, None] * model.jam_density
    w = np.linspace(0.0, 2.0 * model.speed_scale, 19)
    states = np.stack([density, w * density], axis=-1).reshape(8, -1)
    states[:4, 1::2] += 1e-6  # more than the vacuum's density could carry
    estimator.filters.means[:] = states
    shown = estimator.estimate()
    expected_density, expected_speed = estimated_traffic(model, states)
    np.testing.assert_array_equal(shown.density, expected_density)
    np.testing.assert_allclose(shown.speed, expected_speed, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(shown.speed[:3], model.speed_scale)
    assert np.isfinite(shown.speed_std).all()
