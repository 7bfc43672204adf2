"""Extended and unscented Kalman filters on rows of several segments, and with demand states."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import BACKENDS, DemandSettings, EstimatorSettings

from .episodes import simulate, started, tell
from .rows import N_STEPS, PLAIN, RICH, RowEpisodes, averaged, every_row, update, with_rows

both_filters = pytest.mark.parametrize("name", ["ekf", "ukf"])
both_backends = pytest.mark.parametrize("backend", BACKENDS)
both_settings = pytest.mark.parametrize("settings", [PLAIN, RICH], ids=["plain", "rich"])


def assert_agree(compiled, reference):
    tolerance, scale = {"rtol": 0.0, "atol": 1e-9}, compiled.model.state_scale
    assert not np.any(compiled.diverged | reference.diverged)
    np.testing.assert_allclose(compiled.states / scale, reference.states / scale, **tolerance)
    np.testing.assert_allclose(compiled.covariances, reference.covariances, **tolerance)
    np.testing.assert_allclose(compiled.innovations, reference.innovations, **tolerance)


@both_filters
@both_settings
def test_backends_agree_on_rows_that_overlap(name, settings):
    """The UKF amplifies rounding: both of its backends start each step from the same state."""
    episodes = averaged()
    compiled, reference = (started(name, kind, episodes, settings) for kind in BACKENDS)
    assert compiled.model.n_demand_states == (3 if settings is RICH else 0)
    one, scale = reference.filters[0], compiled.model.state_scale
    for k in range(N_STEPS):
        if name == "ukf":
            one.x, one.P = compiled.states[0] / scale, compiled.covariances[0]
        for estimator in (compiled, reference):
            estimator.predict(episodes.everyone, episodes.inputs[k])
            update(estimator, episodes, k)
        assert_agree(compiled, reference)
        if k % 7 == 0:  # another update in the same step, which the UKF makes new points for
            for estimator in (compiled, reference):
                update(estimator, episodes, k, ~episodes.observed[k])
            assert_agree(compiled, reference)
    a, b = compiled.estimate(), reference.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-6, atol=1e-6)


# A Kalman filter in plain numpy -------------------------------------------------------------------

SEEN = {"a pair": [(4, 2)], "what overlaps": [(4, 2), (5, 3), (5, 1), (16, 1)]}
# So little uncertainty that the model is linear within it.
SMALL, STEP_NOISE, GROWTH, COUNT_NOISE = 1e-5, (2e-5, 1e-5), 5e-5, 1e-7
FACTOR, WALK = 1e-3, 1e-5  # deviations of demand factors


def derivative(function, x, scale):
    """The Jacobian of a function of a state by central differences, both normalised by a scale."""
    columns = []
    for i in range(x.size):
        step = np.zeros_like(x)
        step[i] = 1e-5 * scale[i]
        columns.append((function(x + step) - function(x - step)) / 2e-5)
    return np.stack(columns, axis=-1)


def textbook(model, name, x, inputs, values, sigma, centre, rows):
    """Mean, covariance and innovations of a step, normalised; the UKF's gain leaves Q out."""
    scale, v_f, S = model.state_scale, model.speed_scale, model.n_segments
    rho_m, unit = model.density_scale, model.density_scale * np.array([1.0, v_f])
    n_factors = model.n_states - 2 * S
    variance = np.square([SMALL] * 2 * S + [FACTOR] * n_factors)
    noise = np.tile(np.square(STEP_NOISE), S)
    noise[0::2] += GROWTH**2 * x[0 : 2 * S : 2] / rho_m
    noise = np.concatenate([noise, np.full(n_factors, WALK**2)])

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
    covariance = of_points + np.diag(noise)
    known = covariance if name == "ekf" else of_points
    H = derivative(look, mean * scale, scale)
    R = np.square(sigma / unit)
    for i, (first, span) in enumerate(rows):
        density = (mean * scale)[0 : 2 * S : 2][first : first + span].mean()
        R[i, 0] += COUNT_NOISE * density / model.network.segment_length / span / rho_m**2
    spread = H @ known @ H.T + np.diag(R.ravel())
    residual = (values / unit).ravel() - look(mean * scale)
    gain = known @ H.T @ np.linalg.inv(spread)
    innovations = (residual / np.sqrt(np.diag(spread))).reshape(-1, 2)
    return mean + gain @ residual, covariance - gain @ spread @ gain.T, innovations


@both_filters
@both_backends
@pytest.mark.parametrize("seen", SEEN.values(), ids=SEEN.keys())
def test_an_update_is_that_of_a_kalman_filter(name, backend, seen):
    episodes = averaged(1)
    settings = EstimatorSettings(
        process_noise=STEP_NOISE,
        density_growth=GROWTH,
        count_noise=COUNT_NOISE,
        initial_variance=SMALL**2,
        demand=DemandSettings(deviation=FACTOR, walk=WALK),
    )
    estimator = started(name, backend, episodes, settings)
    model, rng = estimator.model, np.random.default_rng(2)
    inputs, centre = episodes.inputs[0], episodes.centre[0]
    x = np.concatenate([episodes.start[0], np.ones(3)])
    ids = list(zip(model.rows.first.tolist(), model.rows.span.tolist(), strict=True))
    places = [ids.index(row) for row in seen]
    sigma = np.ones((1, model.rows.n_rows, 2))
    sigma[:] = SMALL * model.measurement_scale * rng.uniform(0.5, 2.0, sigma.shape)
    after = model.step(x[None], inputs)
    values = model.measure(after, centre) + sigma * rng.normal(size=sigma.shape)
    observed = np.zeros((1, model.rows.n_rows), bool)
    observed[:, places] = True

    estimator.predict(episodes.everyone, inputs)
    tell(estimator, episodes.everyone, observed, values, sigma, centre)
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


# Single rows --------------------------------------------------------------------------------------


@both_filters
@both_backends
def test_segments_measured_singly_are_those_of_a_model_without_rows(name, backend):
    """Also where further rows could be measured and are not."""
    plain = simulate(n_steps=20, release="flow")
    S = plain.model.n_segments
    more = with_rows(plain.model, every_row(S, plain.model.network.n_mainline))
    without = started(name, backend, plain)
    given = started(name, backend, replace(plain, model=more))
    observed, values = np.zeros((1, more.rows.n_rows), bool), np.zeros((1, more.rows.n_rows, 2))
    sigma = np.tile(plain.sigma, (1, more.rows.n_rows, 1))
    centre = np.full((1, S), more.reference_speed)
    for k in range(20):
        observed[:, :S], values[:, :S] = plain.observed[k], plain.values[k]
        for estimator in (without, given):
            estimator.predict(plain.everyone, plain.inputs[k])
        tell(without, plain.everyone, plain.observed[k], plain.values[k], plain.sigma)
        tell(given, plain.everyone, observed, values, sigma, centre)
        np.testing.assert_allclose(given.states, without.states, rtol=1e-12)
        np.testing.assert_allclose(given.covariances, without.covariances, rtol=0.0, atol=1e-14)
        innovations = given.innovations[:, :S]
        np.testing.assert_allclose(innovations, without.innovations, rtol=0.0, atol=1e-12)
        np.testing.assert_array_equal(given.innovations[:, S:], 0.0)


# Demand states ------------------------------------------------------------------------------------


def underestimated(n_steps: int = 150, factor: float = 1.3) -> RowEpisodes:
    """Light traffic made by the model under more demand than the filters are told of."""
    episodes, rng = averaged(n_steps), np.random.default_rng(3)
    model, shape = episodes.model, episodes.sigma.shape
    density = np.full((1, model.n_boundaries), 0.05) * model.density_scale
    density[:, 2:] /= 3.0  # ramps have one lane
    told = model.boundary_inputs(density, np.full(density.shape, 0.9 * model.speed_scale))
    true = told.copy()
    true[:, model.layout.entry_inputs] *= factor
    state, truth = model.project(episodes.start), []
    for _ in range(n_steps):
        state = model.step(state, true)
        truth.append(state)
    exact = [model.measure(x, v_0) for x, v_0 in zip(truth, episodes.centre, strict=True)]
    sigma = np.broadcast_to([4.0, 200.0], shape)
    values = np.stack(exact) + sigma * rng.normal(size=shape)
    inputs = np.repeat(told[None], n_steps, axis=0)
    return replace(episodes, inputs=inputs, values=values, truth=np.stack(truth), sigma=sigma)


@both_filters
def test_demand_states_recover_the_demand_and_lower_the_error(name):
    episodes = underestimated()
    quiet = EstimatorSettings(process_noise=(1e-3, 1e-3))
    errors, factors = {}, []
    for label, demand in (("without", None), ("with", DemandSettings(walk=0.01))):
        estimator = started(name, "compiled", episodes, replace(quiet, demand=demand))
        gaps = []
        for k in range(len(episodes.inputs)):
            estimator.predict(episodes.everyone, episodes.inputs[k])
            update(estimator, episodes, k)
            truth = episodes.model.density(episodes.truth[k])
            if k >= 50:
                gaps.append(estimator.estimate().density - truth)
                if demand is not None:
                    factors.append(estimator.states[0, 2 * episodes.model.n_segments :])
        errors[label] = np.sqrt(np.mean(np.square(gaps)))
    np.testing.assert_allclose(np.mean(factors[50:], axis=0), 1.3, atol=0.1)
    assert errors["with"] < 0.8 * errors["without"]
