"""Extended and unscented Kalman filters beside their references, and both beside textbooks."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    DemandSettings,
    EstimatorSettings,
    SigmaPointSettings,
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


@pytest.mark.slow
@pytest.mark.parametrize("release", ["speed", "flow"])
def test_the_ukfs_agree_over_a_recorded_episode(release):
    """At alpha 0.3 rounding dies out; with speeds it grows on the way, even between references.

    How far depends on the processor.
    """
    take_steps("ukf", recorded(release), PLAIN)
    settings = EstimatorSettings(ukf=SigmaPointSettings(alpha=0.3))
    take_steps("ukf", recorded(release), settings, 1e-5, anew=False)


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

SEEN = {"a pair": [(4, 2)], "what overlaps": [(4, 2), (5, 3), (5, 1), (16, 1)]}
# So little uncertainty that the model is linear within it.
SMALL, STEP_NOISE, VEHICLE_NOISE = 1e-5, (2e-5, 1e-5), (5e-5, 3e-5)
FACTOR, MEMORY = 1e-3, 50.0  # deviation and memory [s] of demand factors


def derivative(function, x, scale):
    """The Jacobian of a function of a state by central differences, both normalised by a scale."""
    columns = []
    for i in range(x.size):
        change = 1e-5 * scale[i] * (np.arange(x.size) == i)
        columns.append((function(x + change) - function(x - change)) / 2e-5)
    return np.stack(columns, axis=-1)


def textbook(model, name, x, inputs, values, sigma, centre, rows):
    """Mean, covariance and innovations of a step, normalised; the UKF's gain leaves Q out."""
    scale, v_f, S = model.state_scale, model.speed_scale, model.n_segments
    unit = model.density_scale * np.array([1.0, v_f])
    n_factors = model.n_states - 2 * S
    variance = np.square([SMALL] * 2 * S + [FACTOR] * n_factors)
    of_factors = FACTOR**2 * (1.0 - np.exp(-2.0 / MEMORY))
    noise = np.diag([*np.tile(np.square(STEP_NOISE), S), *np.full(n_factors, of_factors)])
    of_vehicles, of_psi = np.square(VEHICLE_NOISE)
    for s, (rho, psi) in enumerate(x[: 2 * S].reshape(S, 2) / unit):
        block = of_vehicles * np.outer([rho, psi], [rho, psi]) / rho + np.diag([0.0, of_psi * rho])
        noise[2 * s : 2 * s + 2, 2 * s : 2 * s + 2] += block

    def move(x):
        return model.step(x[None], inputs[None])[0] / scale

    def look(x):
        rho, psi = x[0 : 2 * S : 2], x[1 : 2 * S : 2]
        pressure = v_f * (rho / model.jam_density) ** model.parameters.gamma
        flow, numbers = psi - rho * (pressure + centre), []
        for first, span in rows:
            inside = slice(first, first + span)
            numbers += [rho[inside].sum() / span / unit[0], flow[inside].sum() / span / unit[1]]
        return np.array(numbers)

    F = derivative(move, x, scale)
    mean, of_points = move(x), F @ np.diag(variance) @ F.T
    covariance = of_points + noise
    known = covariance if name == "ekf" else of_points
    H = derivative(look, mean * scale, scale)
    R = np.square(sigma / unit)
    spread = H @ known @ H.T + np.diag(R.ravel())
    residual = (values / unit).ravel() - look(mean * scale)
    gain = known @ H.T @ np.linalg.inv(spread)
    innovations = (residual / np.sqrt(np.diag(spread))).reshape(-1, 2)
    return mean + gain @ residual, covariance - gain @ spread @ gain.T, innovations


@both_filters
@both_backends
@pytest.mark.parametrize("seen", SEEN.values(), ids=SEEN.keys())
def test_an_update_is_that_of_a_kalman_filter(name, backend, seen):
    """On rows of several segments, with noise that grows with the density, and demand states."""
    episodes = simulate(n_steps=1, release="rows")
    settings = EstimatorSettings(
        process_noise=STEP_NOISE,
        vehicle_noise=VEHICLE_NOISE,
        initial_variance=SMALL**2,
        demand=DemandSettings(deviation=FACTOR, memory=MEMORY),
    )
    estimator = started(name, backend, episodes, settings)
    model, rng = estimator.model, np.random.default_rng(2)
    inputs, centre = episodes.inputs[0], episodes.centre[0]
    x = np.concatenate([episodes.start[0], np.ones(3)])
    ids = list(zip(model.channels.first.tolist(), model.channels.span.tolist(), strict=True))
    places = [ids.index(row) for row in seen]
    scale = SMALL * model.measurement_scale
    sigma = scale * rng.uniform(0.5, 2.0, (1, model.channels.size, 2))
    after = model.step(x[None], inputs)
    values = model.measure(after, centre) + sigma * rng.normal(size=sigma.shape)
    observed = np.zeros((1, model.channels.size), bool)
    observed[:, places] = True

    step(estimator, episodes, 0, observed=observed, values=values, sigma=sigma)
    mean, covariance, innovations = textbook(
        model, name, x, inputs[0], values[0, places], sigma[0, places], centre[0], seen
    )
    found, scale = estimator.states[0] / model.state_scale, model.state_scale
    assert np.abs(mean - after[0] / scale).max() > 0.1 * SMALL
    deviations = np.sqrt(np.diag(covariance))
    gap = estimator.covariances[0] - covariance
    assert np.abs((found - mean) / deviations).max() < 1e-3
    assert np.abs(gap / np.outer(deviations, deviations)).max() < 1e-3
    np.testing.assert_allclose(estimator.innovations[0, places], innovations, rtol=0.0, atol=1e-3)


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
