"""Both moving horizon estimators, and each against the other."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from dptse_env.estimators import EstimatorSettings, HorizonSettings
from dptse_env.estimators.horizon import assemble, natural_residual, normalised_bounds, solve
from tests.cases import pairwise

from .conftest import ORDERS
from .episodes import RELEASES, SIGMA, run, scale_of, simulate, started

both_backends = pytest.mark.parametrize("backend", ["compiled", "reference"])
both_releases = pytest.mark.parametrize("release", RELEASES)
both_linearisations = pytest.mark.parametrize("linearisation", ["paper", "trajectory"])


def mhe_of(backend, episodes, start=None, **horizon):
    settings = EstimatorSettings(mhe=HorizonSettings(**horizon))
    return started("mhe", backend, episodes, settings, start)


# Against the oracles ------------------------------------------------------------------------------


def n_held(compiled, episode=0):
    """Number of components of the solution that a bound holds."""
    windows = compiled._windows
    z = windows.solution[episode, : windows.length[episode], : compiled.model.n_states]
    return int(((z == windows.lower) | (z == windows.upper)).sum())


def agree(episodes, steps, tolerance=1e-9, **horizon):
    """Run both backends, compare every step; returns bounds held and programs passed on."""
    compiled = mhe_of("compiled", episodes, **horizon)
    reference = mhe_of("reference", episodes, **horizon)
    scale, held = scale_of(episodes.model), []
    for k in steps:
        run(compiled, episodes, [k])
        run(reference, episodes, [k])
        gap = np.abs(compiled.states - reference.states) / scale
        assert gap.max() <= tolerance, (k, gap.max())
        np.testing.assert_allclose(
            compiled.covariances, reference.covariances, rtol=0, atol=tolerance
        )
        np.testing.assert_allclose(
            compiled.innovations, reference.innovations, rtol=0, atol=1e3 * tolerance
        )
        assert not np.any(compiled.fallback | reference.fallback)
        held.append(n_held(compiled))
    a, b = compiled.estimate(), reference.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-5, atol=1e-5)
    return np.array(held), compiled.n_passed_on


@pytest.mark.parametrize(
    ("bounds", "linearisation", "release", "order"),
    pairwise(["cone", "box"], ["paper", "trajectory"], RELEASES, ORDERS, n=4),
    indirect=["order"],
)
@pytest.mark.usefixtures("order")
def test_backends_agree(bounds, linearisation, release):
    """Over the growth of the window, and while it moves on."""
    episodes = simulate(n_steps=40, noise=2.0, release=release)
    held, passed_on = agree(episodes, range(40), bounds=bounds, linearisation=linearisation)
    assert held.max() >= 3
    assert passed_on == 0


@pytest.mark.slow
@pytest.mark.usefixtures("order")
@pytest.mark.parametrize(
    ("release", "linearisation", "tolerance"),
    [("speed", "paper", 1e-9), ("speed", "trajectory", 5e-9), ("flow", "paper", 1e-9)],
)
def test_backends_agree_over_a_recorded_episode(release, linearisation, tolerance, recordings):
    """Rounding is all: H has a condition of 1e7, and along the trajectory it feeds back."""
    recorded = recordings[release]
    steps = range(len(recorded.inputs))
    held, _ = agree(recorded, steps, tolerance=tolerance, linearisation=linearisation)
    assert np.mean(held > 0) > 0.5


def bounded_window(seed=0, release="speed", horizon=10):
    """A window of which many bounds bind, and the estimator that has it."""
    episodes = simulate(n_steps=14, noise=10.0, seed=seed, release=release)
    empty = episodes.model.states(np.zeros((1, 19)), np.zeros((1, 19)))
    mhe = mhe_of("compiled", episodes, empty, horizon=horizon)
    run(mhe, episodes, range(horizon + 1))
    return mhe


@pytest.mark.usefixtures("order")
@both_releases
def test_the_minimum_is_another_solvers(release):
    # The other solver takes minutes for the default horizon.
    mhe = bounded_window(release=release, horizon=4)
    H, q = assemble(mhe.window(0))
    lower, upper = (np.tile(b, 5) for b in normalised_bounds(mhe.model, "box"))
    z = mhe._windows.solution[0, :5, :38].ravel()
    factor = np.linalg.cholesky(H).T
    other = lsq_linear(factor, np.linalg.solve(factor.T, -q / 2), (lower, upper + 1e-15), "bvls")
    np.testing.assert_allclose(z, other.x, atol=1e-9)
    assert ((z == lower) | (z == upper)).sum() >= 3
    assert natural_residual(H, q, lower, upper, z) < 1e-9
    np.testing.assert_allclose(mhe.covariances[0], np.linalg.inv(H)[-38:, -38:], atol=1e-12)


def test_h_is_the_objectives():
    """z' H z + q' z differs from the sum of the paper's eq. 14 by a constant."""
    rng, window = np.random.default_rng(1), bounded_window().window(0)
    H, q = assemble(window)

    def objective(x):
        total = np.sum((x[0] - window.arrival) ** 2 / window.arrival_variance)
        for i, one in enumerate(x):
            gap = window.targets[i] - window.rows[i] @ one
            total += np.sum((gap**2 / window.noise[i])[window.observed[i]])
        steps = zip(window.transitions, window.offsets, window.process_variance, strict=True)
        for (A, c, variance), one, after in zip(steps, x, x[1:], strict=False):
            total += np.sum((after - A @ one - c) ** 2 / variance)
        return total

    constant = objective(np.zeros((11, 38)))
    for _ in range(3):
        x = rng.normal(size=(11, 38))
        z = x.ravel()
        assert z @ H @ z + q @ z == pytest.approx(objective(x) - constant, rel=1e-10)


def test_half_of_twice_h_is_minimised():
    """qpsolvers takes z' P z / 2 + q' z, the paper has z' H z + q' z: P = H would halve z."""
    H, q = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([-4.0, -6.0])
    free = np.linalg.solve(2.0 * H, -q)
    z = solve(H, q, np.full(2, -10.0), np.full(2, 10.0), "piqp")
    np.testing.assert_allclose(z, free, atol=1e-9)
    mhe = bounded_window()
    H, q = assemble(mhe.window(0))
    wide = np.full(len(q), 1e3)
    z = solve(H, q, -wide, wide, "piqp")
    np.testing.assert_allclose(z, np.linalg.solve(2.0 * H, -q), atol=1e-8)


# The window ---------------------------------------------------------------------------------------


@both_backends
@both_linearisations
def test_a_window_grows_from_the_prior_and_then_moves_on(backend, linearisation):
    """Its arrival is the state that was predicted then from the filtered estimate."""
    episodes = simulate(n_steps=20)
    mhe = mhe_of(
        backend, episodes, horizon=6, linearisation=linearisation, arrival_noise=(0.1, 0.2)
    )
    scale = scale_of(episodes.model)
    predicted = [episodes.start[0] / scale]
    for k in range(20):
        mhe.predict(episodes.everyone, episodes.inputs[k])
        predicted.append(mhe.states[0] / scale)
        mhe.update(episodes.everyone, episodes.observed[k], episodes.values[k], SIGMA)
        window, oldest = mhe.window(0), max(0, k + 1 - 6)
        assert window.observed.shape == (min(k + 1, 6) + 1, 19)
        np.testing.assert_array_equal(window.observed[-1], episodes.observed[k, 0])
        np.testing.assert_allclose(window.arrival, predicted[oldest], rtol=1e-12)
        variance = (1e-3, 1e-3) if oldest == 0 else (0.1**2, 0.2**2)
        np.testing.assert_allclose(window.arrival_variance, np.tile(variance, 19))


def test_what_is_measured_later_changes_a_state_but_not_the_arrival():
    """A smoothed arrival would count the window's measurements twice."""
    episodes = simulate(n_steps=20)
    mhe = mhe_of("reference", episodes)
    run(mhe, episodes, range(20))
    oldest = mhe._windows[0].stages[0]
    assert np.abs(oldest.solution - oldest.predicted).max() > 1e-3
    np.testing.assert_array_equal(mhe.window(0).arrival, oldest.predicted)


@both_backends
def test_an_exact_measurement_is_weighed_as_a_very_good_one(backend):
    episodes = simulate(n_steps=20)
    mhe = mhe_of(backend, episodes)
    run(mhe, episodes, range(20), sigma=np.zeros(2))
    assert not np.any(mhe.diverged | mhe.fallback)
    seen = episodes.observed[19, 0]
    gap = mhe.estimate().density[0, seen] - np.maximum(episodes.values[19, 0, seen, 0], 0.0)
    assert np.abs(gap).max() < 2.0


@both_backends
def test_a_perfect_model_has_no_weight(backend):
    settings = EstimatorSettings(process_noise=(0.0, 0.01))
    with pytest.raises(ValueError, match=r"process_noise\[0\] must be a finite number > 0"):
        started("mhe", backend, simulate(n_steps=1), settings)


@pytest.mark.parametrize(
    ("backend", "bounds", "filling"),
    pairwise(["compiled", "reference"], ["cone", "box"], [0.0, 1.0], n=4),
)
def test_along_the_trajectory_poor_starts_are_solved_too(backend, bounds, filling):
    steps = 60 if backend == "compiled" else 14
    episodes = simulate(n_steps=steps, noise=10.0)
    density = np.full((1, 19), filling) * episodes.model.jam_density
    start = episodes.model.states(density, np.zeros((1, 19)))
    mhe = mhe_of(backend, episodes, start, bounds=bounds, linearisation="trajectory")

    def check(_):
        assert np.isfinite(mhe.states).all()
        assert not np.any(mhe.diverged | mhe.fallback)

    run(mhe, episodes, range(steps), watch=check)
