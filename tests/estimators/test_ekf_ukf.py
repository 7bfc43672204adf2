"""Extended and unscented Kalman filters beside their references, and both beside textbooks."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    EstimatorSettings,
)
from dptse_env.estimators.simple import estimated_traffic
from dptse_env.model.parameters import VACUUM
from tests.helpers import fast_and_slow, pairwise

from .helpers import (
    PLAIN,
    RELEASES,
    RICH,
    SPEEDS,
    recorded,
    run,
    simulate,
    started,
    step,
    update,
)

both_filters = pytest.mark.parametrize("name", ["ekf", "ukf"])
both_backends = pytest.mark.parametrize("backend", BACKENDS)


# Beside the references ----------------------------------------------------------------------------


def take_steps(name, episodes, settings, tolerance=1e-9, anew=True, again=0):
    """Compare both backends over episodes.

    Args:
        name: The filter.
        episodes: One episode.
        settings: Its settings.
        tolerance: Largest difference of what is normalised.
        anew: Whether both take each step from the same state, so that rounding does not grow.
        again: Steps after which the rows not observed before come in a second update.
    """
    compiled, reference = (started(name, kind, episodes, settings) for kind in BACKENDS)
    assert compiled.model.n_demand_states == (0 if settings.demand is None else 3)
    one, scale = reference.filters[0], compiled.model.state_scale
    close, far = {"rtol": tolerance, "atol": tolerance}, {"rtol": 1e-9, "atol": 1e3 * tolerance}

    def compare():
        assert not np.any(compiled.diverged | reference.diverged)
        np.testing.assert_allclose(compiled.states / scale, reference.states / scale, **close)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, **close)
        wide = settings.bounds == "box"  # P is near 100 on the way
        np.testing.assert_allclose(
            compiled.covariances, reference.covariances, **(far if wide else close)
        )

    for k in range(len(episodes.inputs)):
        if anew:
            one.x, one.P = compiled.states[0] / scale, compiled.covariances[0]
        for each in (compiled, reference):
            step(each, episodes, k)
        compare()
        if again and k % again == 0:  # the UKF makes new points for it
            for each in (compiled, reference):
                update(each, episodes, k, observed=~episodes.observed[k])
            compare()
    for a, b in zip(compiled.estimate(), reference.estimate(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


FAST = [
    (name, *case)
    for name in ("ekf", "ukf")
    for case in (("rows", "cone", RICH), ("flow", "cone", PLAIN), ("speed", "box", PLAIN))
]


@pytest.mark.parametrize(
    ("name", "release", "bounds", "settings"),
    fast_and_slow(product(["ekf", "ukf"], RELEASES, ["cone", "box"], [PLAIN, RICH]), FAST),
)
def test_backends_take_the_same_steps(name, release, bounds, settings):
    """In the box w has no bound: there states break the CFL condition and blow up rounding.

    The UKF amplifies it everywhere, its reference against itself as well.
    """
    parameters = "published" if bounds == "box" else "w99-3lane"
    episodes = simulate(parameters, n_steps=100, release=release)
    tolerance = 1e-6 if (name, bounds) == ("ukf", "box") else 1e-9
    anew = (name, bounds) != ("ekf", "cone")
    take_steps(name, episodes, replace(settings, bounds=bounds), tolerance, anew, again=7)


@pytest.mark.parametrize("release", ["speed", "flow"])
def test_the_ekfs_agree_over_a_recorded_episode_and_beat_walk_and_model(release):
    episodes, errors = recorded(release), {}
    density, n = episodes.model.density(episodes.truth), len(episodes.inputs)
    take_steps("ekf", replace(episodes, inputs=episodes.inputs[:400]), PLAIN, anew=False)
    for name in ("ekf", "random_walk", "open_loop"):
        estimator, squares = started(name, "compiled", episodes), []
        for k in range(n):
            step(estimator, episodes, k)
            squares.append((estimator.estimate().density - density[k])[:, :15] ** 2)
        errors[name] = np.sqrt(np.mean(squares[60:]))
    assert errors["ekf"] < errors["random_walk"]
    assert errors["ekf"] < 0.7 * errors["open_loop"]


# Beside a Kalman filter in plain numpy ------------------------------------------------------------

# So little uncertainty that the model is linear within it.


# Soundness ----------------------------------------------------------------------------------------


@both_filters
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


@pytest.mark.parametrize(
    ("backend", "filling"), pairwise(BACKENDS, [0.0, 1e-6, 1e-3], n=4, rest=False)
)
def test_the_speed_of_a_nearly_empty_segment_tells_nothing_of_its_density(backend, filling):
    """Its derivative, psi / rho^2, would: h and its Jacobian take the density for a floor."""
    episodes = simulate(n_steps=1)
    start = episodes.start.copy()
    start[:, 0::2] = filling * episodes.model.jam_density
    ekf = started("ekf", backend, episodes, EstimatorSettings(bounds="box"), start)
    values = np.tile([0.4, 60.0], (1, 19, 1))
    update(ekf, episodes, 0, observed=np.ones((1, 19), bool), values=values)
    assert not ekf.diverged.any()
    assert np.isfinite(ekf.innovations).all()
    # What is known of a density with the prior's deviation that one sensor has measured.
    expected = 1.0 / np.sqrt(1.0 / (1e-3 * 400.0**2) + 1.0 / SPEEDS[0] ** 2)
    np.testing.assert_allclose(ekf.estimate().density_std, expected, rtol=1e-9)


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
