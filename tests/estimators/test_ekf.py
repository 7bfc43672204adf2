"""Both backends of the extended Kalman filter, and each against the other."""

from dataclasses import dataclass

import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings, make_estimator
from dptse_env.model import ARZModel, load_parameters

from .episodes import SIGMA, random_streams, simulate

both_backends = pytest.mark.parametrize("backend", ["compiled", "reference"])
both_sets = pytest.mark.parametrize("parameters", ["paper", "w99-3lane"])
both_bounds = pytest.mark.parametrize("bounds", ["cone", "box"])


def started(backend, episodes, **settings):
    n = len(episodes.start)
    filters = make_estimator("ekf", backend, episodes.model, n, EstimatorSettings(**settings))
    filters.reset(episodes.everyone, episodes.start, random_streams(n))
    return filters


def run(filters, episodes, steps, sigma=SIGMA, watch=lambda _: None):
    for k in steps:
        filters.predict(episodes.everyone, episodes.inputs[k])
        filters.update(episodes.everyone, episodes.observed[k], episodes.values[k], sigma)
        watch(k)


# Against the oracle -------------------------------------------------------------------------------


@both_sets
@both_bounds
def test_backends_agree_over_an_episode(parameters, bounds):
    episodes = simulate(parameters)
    compiled = started("compiled", episodes, bounds=bounds)
    reference = started("reference", episodes, bounds=bounds)
    model = episodes.model
    scale = np.tile([model.density_scale, model.density_scale * model.speed_scale], 19)
    # In the box w has no bound: states that break the CFL condition blow up rounding.
    tolerance = {"rtol": 0.0, "atol": 1e-9 if bounds == "cone" else 1e-6}
    for k in range(700):
        run(compiled, episodes, [k])
        run(reference, episodes, [k])
        np.testing.assert_allclose(compiled.states / scale, reference.states / scale, **tolerance)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, **tolerance)
    np.testing.assert_allclose(compiled.covariances, reference.covariances, **tolerance)
    a, b = compiled.estimate(), reference.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-6, atol=1e-6)


@dataclass(frozen=True)
class BlockedCell:
    """One segment that nobody enters or leaves: its dynamics are linear."""

    n_mainline: int = 1
    on_ramps: tuple[int, ...] = ()
    off_ramps: tuple[int, ...] = ()
    exit_shares: tuple[float, ...] = ()
    segment_length: float = 0.1
    segment_lanes: tuple[int, ...] = (3,)
    lanes: int = 3
    ramp_lanes: int = 1


@both_backends
def test_equals_the_textbook_kalman_filter_where_all_is_linear(backend):
    """Below the density that a measurement takes at least, the speed is linear in psi too."""
    parameters = load_parameters("paper")
    model = ARZModel(BlockedCell(), parameters)
    v_f, rho_m, tau = 102.0, 333.0, 60.0
    settings = EstimatorSettings(process_noise=(2e-5, 2e-5), initial_variance=1e-9)
    ekf = make_estimator("ekf", backend, model, 1, settings)
    floor = 0.01 * rho_m
    f = np.array([[1.0, 0.0], [v_f / tau, 1.0 - 1.0 / tau]])
    q = np.diag([(2e-5 * rho_m) ** 2, (2e-5 * rho_m * v_f) ** 2])
    h = np.array([[1.0, 0.0], [0.0, 1.0 / floor]])
    offset = np.array([0.0, -v_f * 0.01**2])
    sigma = np.array([0.2, 6.0])
    x, p = np.array([2.0, 200.0]), np.diag([1e-9 * rho_m**2, 1e-9 * (rho_m * v_f) ** 2])

    everyone, rng = np.arange(1), np.random.default_rng(0)
    ekf.reset(everyone, x[None], random_streams(1))
    inputs = np.array([[0.0, v_f, 1.2 * rho_m]])
    for _ in range(300):
        z = np.array([2.0, 2.0 * v_f / floor]) + offset + sigma * rng.normal(size=2)
        ekf.predict(everyone, inputs)
        ekf.update(everyone, np.ones((1, 1), bool), z[None, None], sigma)
        x, p = f @ x, f @ p @ f.T + q
        s = h @ p @ h.T + np.diag(sigma**2)
        residual = z - h @ x - offset
        np.testing.assert_allclose(ekf.innovations[0, 0], residual / np.sqrt(np.diag(s)), atol=1e-9)
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ residual, p - gain @ s @ gain.T
        assert 1.0 < x[0] < floor
        assert x[1] < 1.1 * v_f * x[0]
        np.testing.assert_allclose(ekf.states[0], x, rtol=1e-9)
    unit = np.array([rho_m, rho_m * v_f])
    np.testing.assert_allclose(ekf.covariances[0] * np.outer(unit, unit), p, rtol=1e-9)


@both_backends
def test_worthless_measurements_leave_the_model_alone(backend):
    episodes = simulate(n_steps=100)
    ekf = started(backend, episodes)
    alone = make_estimator("open_loop", backend, episodes.model, 1)
    alone.reset(episodes.everyone, episodes.start, random_streams(1))
    for filters in (ekf, alone):
        run(filters, episodes, range(100), sigma=np.array([1e12, 1e12]))
    np.testing.assert_allclose(ekf.states, alone.states, rtol=1e-9)


@both_backends
def test_an_empty_set_of_measurements_changes_nothing(backend):
    episodes = simulate(n_steps=50)
    ekf = started(backend, episodes)
    run(ekf, episodes, range(49))
    ekf.predict(episodes.everyone, episodes.inputs[49])
    states, covariances = ekf.states, ekf.covariances
    nothing = np.zeros((1, 19), bool)
    ekf.update(episodes.everyone, nothing, np.full((1, 19, 2), np.nan), SIGMA)
    np.testing.assert_allclose(ekf.states, states, rtol=1e-14)
    np.testing.assert_array_equal(ekf.covariances, covariances)
    np.testing.assert_array_equal(ekf.innovations, 0.0)
    assert not ekf.diverged.any()


@both_backends
def test_values_of_unobserved_segments_are_not_looked_at(backend):
    episodes = simulate(n_steps=30)
    a, b = started(backend, episodes), started(backend, episodes)
    hidden = np.where(episodes.observed[..., None], episodes.values, np.nan)
    for k in range(30):
        for filters, values in ((a, episodes.values), (b, hidden)):
            filters.predict(episodes.everyone, episodes.inputs[k])
            filters.update(episodes.everyone, episodes.observed[k], values[k], SIGMA)
    np.testing.assert_array_equal(a.states, b.states)
    np.testing.assert_array_equal(a.innovations, b.innovations)
    np.testing.assert_array_equal(b.innovations[~episodes.observed[29]], 0.0)


@both_backends
def test_measurements_help(backend):
    episodes = simulate(n=2, n_steps=200)
    model, errors = episodes.model, {}
    for name in ("ekf", "open_loop"):
        filters = make_estimator(name, backend, model, 2)
        filters.reset(episodes.everyone, episodes.start, random_streams(2))
        gaps = []
        for k in range(200):
            run(filters, episodes, [k])
            gaps.append(filters.estimate().density - model.density(episodes.truth[k]))
        errors[name] = np.sqrt(np.mean(np.square(gaps)))
    assert errors["ekf"] < 0.9 * errors["open_loop"]


# Soundness ----------------------------------------------------------------------------------------


@both_sets
def test_covariance_stays_symmetric_and_definite(parameters):
    episodes = simulate(parameters, n=2)
    ekf = started("compiled", episodes)

    def check(_):
        covariances = ekf.covariances
        np.testing.assert_array_equal(covariances, covariances.swapaxes(1, 2))
        assert np.linalg.eigvalsh(covariances).min() >= -1e-10
        assert not ekf.diverged.any()

    run(ekf, episodes, range(700), watch=check)


@both_sets
@both_bounds
@pytest.mark.parametrize("filling", [0.0, 1.0], ids=["empty", "jam"])
@pytest.mark.parametrize("backend", ["compiled", "reference"])
def test_adversarial_starts_and_noise_stay_finite_and_within_bounds(
    backend, parameters, bounds, filling
):
    steps = 700 if backend == "compiled" else 60
    episodes = simulate(parameters, n=2, n_steps=steps, noise=10.0)
    model = episodes.model
    ekf = started(backend, episodes, bounds=bounds)
    density = np.full((2, 19), filling) * model.jam_density
    ekf.reset(episodes.everyone, model.states(density, np.zeros((2, 19))), random_streams(2))

    def check(_):
        states = ekf.states
        np.testing.assert_allclose(model.project(states, bounds), states, rtol=1e-12)
        estimate = ekf.estimate()
        for field in ("density", "speed", "density_std", "speed_std"):
            assert np.isfinite(getattr(estimate, field)).all()
        assert np.isfinite(ekf.innovations).all()

    run(ekf, episodes, range(steps), watch=check)


@both_backends
def test_divergence_is_flagged_and_ends_at_the_prior(backend):
    episodes = simulate(n=3, n_steps=20)
    ekf, healthy = started(backend, episodes), started(backend, episodes)
    run(ekf, episodes, range(10))
    run(healthy, episodes, range(10))
    poisoned = episodes.values[10].copy()
    poisoned[1, 14, 0] = np.nan
    everyone = episodes.everyone
    for filters, values in ((ekf, poisoned), (healthy, episodes.values[10])):
        filters.predict(everyone, episodes.inputs[10])
        filters.update(everyone, episodes.observed[10], values, SIGMA)
    assert ekf.diverged.tolist() == [False, True, False]
    np.testing.assert_allclose(ekf.states[1], episodes.start[1], rtol=1e-12)
    np.testing.assert_array_equal(ekf.covariances[1], 1e-3 * np.eye(38))
    np.testing.assert_array_equal(ekf.innovations[1], 0.0)
    for i in (0, 2):
        np.testing.assert_array_equal(ekf.states[i], healthy.states[i])
    run(ekf, episodes, [11])
    assert not ekf.diverged.any()


@both_backends
@pytest.mark.parametrize("poison", [np.nan, np.inf, -1.0, "indefinite"])
def test_a_broken_covariance_is_found(backend, poison):
    episodes = simulate(n_steps=5)
    ekf = started(backend, episodes)
    run(ekf, episodes, range(3))
    kept = ekf._filters.covariances if backend == "compiled" else ekf._filters[0].P[None]
    if poison == "indefinite":
        kept[0, 20, 4] = kept[0, 4, 20] = 10.0
    else:
        kept[0, 20, 20] = poison
    ekf.update(episodes.everyone, episodes.observed[4], episodes.values[4], SIGMA)
    assert ekf.diverged.tolist() == [True]
    np.testing.assert_array_equal(ekf.covariances[0], 1e-3 * np.eye(38))


def test_non_finite_inputs_diverge_instead_of_crashing():
    episodes = simulate(n_steps=2)
    for backend in ("compiled", "reference"):
        ekf = started(backend, episodes)
        ekf.predict(episodes.everyone, np.full((1, 9), np.nan))
        ekf.update(episodes.everyone, episodes.observed[0], episodes.values[0], SIGMA)
        assert ekf.diverged.tolist() == [True]
        assert np.isfinite(ekf.states).all()


# Batches ------------------------------------------------------------------------------------------


@both_backends
def test_a_batch_equals_a_loop_to_the_bit(backend):
    episodes = simulate(n=4, n_steps=60)
    batch = started(backend, episodes)
    run(batch, episodes, range(60))
    for i in range(4):
        one = make_estimator("ekf", backend, episodes.model, 1)
        alone = np.arange(1)
        one.reset(alone, episodes.start[i : i + 1], random_streams(1))
        for k in range(60):
            one.predict(alone, episodes.inputs[k, i : i + 1])
            row = slice(i, i + 1)
            one.update(alone, episodes.observed[k, row], episodes.values[k, row], SIGMA)
        np.testing.assert_array_equal(one.states[0], batch.states[i])
        np.testing.assert_array_equal(one.covariances[0], batch.covariances[i])
        np.testing.assert_array_equal(one.innovations[0], batch.innovations[i])


@both_backends
def test_only_the_episodes_named_are_touched(backend):
    episodes = simulate(n=4, n_steps=20)
    ekf = started(backend, episodes)
    run(ekf, episodes, range(10))
    states, covariances, innovations = ekf.states, ekf.covariances, ekf.innovations.copy()
    some = np.array([3, 1])
    ekf.predict(some, episodes.inputs[10, some])
    ekf.update(some, episodes.observed[10, some], episodes.values[10, some], SIGMA)
    ekf.reset(np.array([1]), episodes.start[[1]], random_streams(1))
    for i in (0, 2):
        np.testing.assert_array_equal(ekf.states[i], states[i])
        np.testing.assert_array_equal(ekf.covariances[i], covariances[i])
        np.testing.assert_array_equal(ekf.innovations[i], innovations[i])
    np.testing.assert_allclose(ekf.states[1], episodes.start[1], rtol=1e-12)
    assert not np.array_equal(ekf.states[3], states[3])


@both_backends
def test_the_same_episode_gives_the_same_result(backend):
    episodes = simulate(n_steps=50)
    first, second = started(backend, episodes), started(backend, episodes)
    run(first, episodes, range(50))
    np.random.default_rng().normal(size=100)
    run(second, episodes, range(50))
    np.testing.assert_array_equal(first.states, second.states)
    second.reset(episodes.everyone, episodes.start, random_streams(1))
    run(second, episodes, range(50))
    np.testing.assert_array_equal(first.states, second.states)


@both_backends
def test_shapes_are_checked(backend):
    ekf = started(backend, simulate(n_steps=1))
    everyone = np.arange(1)
    with pytest.raises(ValueError, match=r"states must have shape \(1, 38\), got \(1, 37\)"):
        ekf.reset(everyone, np.zeros((1, 37)), random_streams(1))
    with pytest.raises(ValueError, match=r"inputs must have shape \(1, 9\), got \(9,\)"):
        ekf.predict(everyone, np.zeros(9))
    with pytest.raises(ValueError, match=r"episodes must be in 0\.\.0, got 1"):
        ekf.predict(np.array([1]), np.zeros((1, 9)))
