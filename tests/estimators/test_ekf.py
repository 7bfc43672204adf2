"""Both backends of the extended Kalman filter, and each against the other."""

import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.simple import estimated_traffic
from dptse_env.model.parameters import VACUUM
from tests.helpers import pairwise

from .episodes import RELEASES, SIGMA, run, scale_of, simulate, started, tell

both_backends = pytest.mark.parametrize("backend", ["compiled", "reference"])


@pytest.mark.parametrize(
    ("parameters", "bounds", "release"),
    pairwise(["paper", "w99-3lane"], ["cone", "box"], RELEASES, n=4),
)
def test_backends_agree_over_an_episode(parameters, bounds, release):
    episodes = simulate(parameters, n_steps=300, release=release)
    compiled = started("ekf", "compiled", episodes, EstimatorSettings(bounds=bounds))
    reference = started("ekf", "reference", episodes, EstimatorSettings(bounds=bounds))
    scale = scale_of(episodes.model)
    tolerance = {"rtol": 0.0, "atol": 1e-9}
    for k in range(300):
        if bounds == "box":
            # There w has no bound, and states that break the CFL condition blow up rounding: both
            # take each step from the same state, and P, near 100 on the way, keeps fewer digits.
            one = reference.filters[0]
            one.x, one.P = compiled.states[0] / scale, compiled.covariances[0]
        run(compiled, episodes, [k])
        run(reference, episodes, [k])
        np.testing.assert_allclose(compiled.states / scale, reference.states / scale, **tolerance)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, **tolerance)
        np.testing.assert_allclose(
            compiled.covariances, reference.covariances, rtol=1e-9, atol=1e-6
        )
    a, b = compiled.estimate(), reference.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-6, atol=1e-6)


@both_backends
def test_measurements_help(backend):
    episodes = simulate(n=2, n_steps=200)
    model, errors = episodes.model, {}
    for name in ("ekf", "open_loop"):
        own = "compiled" if name == "open_loop" else backend
        filters, gaps = started(name, own, episodes), []
        for k in range(200):
            run(filters, episodes, [k])
            gaps.append(filters.estimate().density - model.density(episodes.truth[k]))
        errors[name] = np.sqrt(np.mean(np.square(gaps)))
    assert errors["ekf"] < 0.9 * errors["open_loop"]


@pytest.mark.parametrize(
    ("backend", "poison"),
    pairwise(["compiled", "reference"], [np.nan, np.inf, -1.0, "indefinite"], rest=False),
)
def test_a_broken_covariance_is_found(backend, poison):
    episodes = simulate(n_steps=5)
    ekf = started("ekf", backend, episodes)
    run(ekf, episodes, range(3))
    kept = ekf.filters.covariances if backend == "compiled" else ekf.filters[0].P[None]
    if poison == "indefinite":
        kept[0, 20, 4] = kept[0, 4, 20] = 10.0
    else:
        kept[0, 20, 20] = poison
    tell(ekf, episodes.everyone, episodes.observed[4], episodes.values[4], SIGMA)
    assert ekf.diverged.tolist() == [True]
    np.testing.assert_array_equal(ekf.covariances[0], 1e-3 * np.eye(38))


def update_of_a_nearly_empty_road(backend, filling):
    """An update in the box, every segment measured: the filter, and its density's deviations."""
    episodes = simulate(n_steps=1)
    start = episodes.start.copy()
    start[:, 0::2] = filling * episodes.model.jam_density
    settings = EstimatorSettings(bounds="box")
    ekf = started("ekf", backend, episodes, settings, start)
    values = np.tile([0.4, 60.0], (1, 19, 1))
    tell(ekf, episodes.everyone, np.ones((1, 19), bool), values, SIGMA)
    return ekf, ekf.estimate().density_std[0]


# What is known of a density with the prior's deviation that one sensor has measured.
ONCE_MEASURED = 1.0 / np.sqrt(1.0 / (1e-3 * 400.0**2) + 1.0 / SIGMA[0] ** 2)


@both_backends
@pytest.mark.parametrize("filling", [0.0, 1e-6, 1e-3])
def test_the_speed_of_a_nearly_empty_segment_tells_nothing_of_its_density(backend, filling):
    """Its derivative, psi / rho^2, would: h and its Jacobian take the density for a floor."""
    ekf, deviations = update_of_a_nearly_empty_road(backend, filling)
    assert not ekf.diverged.any()
    assert np.isfinite(ekf.innovations).all()
    np.testing.assert_allclose(deviations, ONCE_MEASURED, rtol=1e-9)


def test_without_the_floor_a_filter_is_sure_of_what_it_cannot_know(monkeypatch):
    monkeypatch.setattr("dptse_env.model.model.MEASUREMENT_FLOOR", 1e-9)
    _, deviations = update_of_a_nearly_empty_road("reference", 1e-3)
    assert deviations.max() < 0.02 * ONCE_MEASURED


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
    estimator.filters.means[:] = states
    shown = estimator.estimate()
    expected_density, expected_speed = estimated_traffic(model, states)
    np.testing.assert_array_equal(shown.density, expected_density)
    np.testing.assert_allclose(shown.speed, expected_speed, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(shown.speed[:3], model.speed_scale)
    assert np.isfinite(shown.speed_std).all()


# Recorded traffic ---------------------------------------------------------------------------------


def errors(name, backend, episodes):
    """Density error from 60 s on, the estimator at the end, its largest variance on the way."""
    estimator, squares, peak = started(name, backend, episodes), [], 0.0
    density = episodes.model.density(episodes.truth)
    for k in range(len(episodes.inputs)):
        run(estimator, episodes, [k])
        assert not estimator.diverged.any()
        if name == "ekf":
            peak = max(peak, estimator.covariances[0].diagonal().max())
        if k >= 60:
            squares.append((estimator.estimate().density[0, :15] - density[k, 0, :15]) ** 2)
    return np.sqrt(np.mean(squares)), estimator, peak


@pytest.mark.parametrize("release", RELEASES)
def test_backends_agree_and_the_filter_beats_walk_and_model(release, recordings):
    recorded = recordings[release]
    compiled_error, compiled, _ = errors("ekf", "compiled", recorded)
    reference_error, reference, _ = errors("ekf", "reference", recorded)
    scale = scale_of(recorded.model)
    np.testing.assert_allclose(compiled.states / scale, reference.states / scale, atol=1e-9)
    np.testing.assert_allclose(compiled.covariances, reference.covariances, atol=1e-9)
    assert compiled_error == pytest.approx(reference_error, abs=1e-6)
    assert compiled_error < errors("random_walk", "compiled", recorded)[0]
    assert compiled_error < 0.7 * errors("open_loop", "compiled", recorded)[0]


@pytest.mark.slow
def test_the_least_w_keeps_the_filter_sound(recorded, monkeypatch):
    """Without it, nearly empty and standing cells blow the covariance up."""
    error, _, peak = errors("ekf", "reference", recorded)
    assert peak < 100.0
    monkeypatch.setattr("dptse_env.model.model.LEAST_W", 0.0)
    unsound_error, _, unsound_peak = errors("ekf", "reference", recorded)
    assert unsound_peak > 1e4
    assert unsound_error > error
