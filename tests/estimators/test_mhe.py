"""Both moving horizon estimators, and each against the other."""

from dataclasses import replace

import numpy as np
import pytest
import qpsolvers
from scipy.optimize import lsq_linear

from dptse_env.estimators import EstimatorSettings, HorizonSettings, make_estimator
from dptse_env.estimators import horizon as horizon_module
from dptse_env.estimators.compiled import mhe_kernels
from dptse_env.estimators.compiled.kernels import Filters
from dptse_env.estimators.compiled.mhe import CompiledMHE
from dptse_env.estimators.compiled.mhe_kernels import Horizons, update
from dptse_env.estimators.horizon import (
    assemble,
    natural_residual,
    normalised_bounds,
    solve,
)
from dptse_env.estimators.reference.mhe import ReferenceMHE
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY, RecordLibrary

from .episodes import FIXED_SENSORS, SIGMA, random_streams, simulate
from .test_ekf import BlockedCell, run

BACKENDS = {"compiled": CompiledMHE, "reference": ReferenceMHE}
both_backends = pytest.mark.parametrize("backend", ["compiled", "reference"])
both_bounds = pytest.mark.parametrize("bounds", ["cone", "box"])
both_linearisations = pytest.mark.parametrize("linearisation", ["paper", "trajectory"])


def started(backend, episodes, settings=None, **horizon):
    n = len(episodes.start)
    settings = replace(settings or EstimatorSettings(), mhe=HorizonSettings(**horizon))
    mhe = BACKENDS[backend](episodes.model, n, settings)
    mhe.reset(episodes.everyone, episodes.start, random_streams(n))
    return mhe


def poor_start(episodes, filling):
    """Prior states of an empty or a jammed road."""
    shape = (len(episodes.start), 19)
    density = np.full(shape, filling) * episodes.model.jam_density
    return episodes.model.states(density, np.zeros(shape))


# Against the oracles ------------------------------------------------------------------------------


def agree(episodes, steps, sigma=SIGMA, tolerance=1e-9, **horizon):
    """Run both backends, compare every step; returns bounds held and programs passed on."""
    compiled = started("compiled", episodes, **horizon)
    reference = started("reference", episodes, **horizon)
    scale = np.tile([400.0, 400.0 * 140.0], 19)
    held = []
    for k in steps:
        run(compiled, episodes, [k], sigma)
        run(reference, episodes, [k], sigma)
        gap = np.abs(compiled.states - reference.states) / scale
        assert gap.max() <= tolerance, (k, gap.max())
        np.testing.assert_allclose(
            compiled.covariances, reference.covariances, rtol=0, atol=tolerance
        )
        np.testing.assert_allclose(
            compiled.innovations, reference.innovations, rtol=0, atol=1e3 * tolerance
        )
        assert not np.any(compiled.fallback | reference.fallback)
        held.append(int((compiled._horizons.side != 0).sum()))
    a, b = compiled.estimate(), reference.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-5, atol=1e-5)
    return np.array(held), compiled.n_passed_on


@both_bounds
@both_linearisations
def test_backends_agree(bounds, linearisation):
    episodes = simulate(n_steps=80, noise=2.0)
    held, passed_on = agree(episodes, range(80), bounds=bounds, linearisation=linearisation)
    assert held.max() >= 3
    assert passed_on == 0


def sumo_episode(directory, seed=3):
    """Recorded traffic in the form of `simulate`, five roaming sensors."""
    record = RecordLibrary(directory).get(PAPER_HIGHWAY, seed)
    counts, sums = record.counts, record.speed_sums
    speed = np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0)
    density = counts / PAPER_HIGHWAY.segment_length
    episodes = simulate(n_steps=len(density) - 1)
    rng, inputs = np.random.default_rng(0), episodes.model.boundary_inputs
    for k in range(len(density) - 1):
        episodes.inputs[k] = inputs(density[k : k + 1, 19:], speed[k : k + 1, 19:])
        seen = np.nan_to_num(speed[k + 1, :19], nan=102.0)
        values = np.stack([density[k + 1, :19], seen], -1)
        episodes.values[k, 0] = values + SIGMA * rng.normal(size=values.shape)
        episodes.observed[k] = False
        episodes.observed[k, 0, [*((3 * np.arange(5) + k) % 15), *FIXED_SENSORS]] = True
    return episodes


@pytest.mark.slow
@both_linearisations
def test_backends_agree_over_a_recorded_episode(tmp_path, linearisation):
    episodes = sumo_episode(tmp_path)
    steps = range(len(episodes.inputs))
    held, _ = agree(episodes, steps, linearisation=linearisation)
    assert np.mean(held > 0) > 0.5


@both_backends
@both_linearisations
def test_equals_the_kalman_filter_while_its_window_reaches_the_prior(backend, linearisation):
    """All is linear in a nearly empty, blocked cell: full information ends at the filter's mean."""
    model = ARZModel(BlockedCell(), load_parameters("paper"))
    v_f, rho_m, tau = 102.0, 333.0, 60.0
    own = HorizonSettings(horizon=40, linearisation=linearisation)
    settings = EstimatorSettings(process_noise=(2e-5, 2e-5), initial_variance=1e-9, mhe=own)
    mhe = BACKENDS[backend](model, 1, settings)
    floor = 0.01 * rho_m
    f = np.array([[1.0, 0.0], [v_f / tau, 1.0 - 1.0 / tau]])
    q = np.diag([(2e-5 * rho_m) ** 2, (2e-5 * rho_m * v_f) ** 2])
    h = np.array([[1.0, 0.0], [0.0, 1.0 / floor]])
    offset, sigma = np.array([0.0, -v_f * 0.01**2]), np.array([0.4, 6.0])
    x, p = np.array([2.0, 200.0]), np.diag([1e-9 * rho_m**2, 1e-9 * (rho_m * v_f) ** 2])
    everyone, rng = np.arange(1), np.random.default_rng(0)
    mhe.reset(everyone, x[None], random_streams(1))
    unit = np.array([rho_m, rho_m * v_f])
    for _ in range(40):
        z = np.array([2.0, 2.0 * v_f / floor]) + offset + sigma * rng.normal(size=2)
        mhe.predict(everyone, np.array([[0.0, v_f, 1.2 * rho_m]]))
        mhe.update(everyone, np.ones((1, 1), bool), z[None, None], sigma)
        x, p = f @ x, f @ p @ f.T + q
        s = h @ p @ h.T + np.diag(sigma**2)
        residual = z - h @ x - offset
        np.testing.assert_allclose(mhe.innovations[0, 0], residual / np.sqrt(np.diag(s)), atol=1e-7)
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ residual, p - gain @ s @ gain.T
        np.testing.assert_allclose(mhe.states[0] / unit, x / unit, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(mhe.covariances[0] * np.outer(unit, unit), p, rtol=1e-6)
    before = mhe.states[0]
    mhe.predict(everyone, np.array([[0.0, v_f, 1.2 * rho_m]]))
    mhe.update(everyone, np.ones((1, 1), bool), z[None, None], sigma)  # the window moves on
    assert not np.array_equal(mhe.states[0], before)


def bounded_window(seed=0):
    """A window of which many bounds bind, and the estimator that has it."""
    episodes = simulate(n_steps=14, noise=10.0, seed=seed)
    mhe = started("compiled", episodes)
    mhe.reset(episodes.everyone, poor_start(episodes, 0.0), random_streams(1))
    run(mhe, episodes, range(11))
    return mhe


def test_the_minimum_is_another_solvers():
    mhe = bounded_window()
    H, q = assemble(mhe.window(0))
    lower, upper = (np.tile(b, 11) for b in normalised_bounds(mhe.model, "box"))
    z = mhe._horizons.solution[0, :, :38].ravel()
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
        total = np.sum(((x[0] - window.arrival) / np.tile(window.arrival_variance, 19) ** 0.5) ** 2)
        for i, one in enumerate(x):
            speed = np.sum(window.rows[i] * one.reshape(-1, 2), axis=1)
            gap = window.targets[i] - np.stack([one[::2], speed], axis=1)
            total += np.sum((gap**2 / window.noise[i])[window.observed[i]])
        for A, c, one, after in zip(window.transitions, window.offsets, x, x[1:], strict=False):
            gap = after - A @ one - c
            total += np.sum(gap**2 / np.tile(window.process_variance, 19))
        return total

    constant = objective(np.zeros((11, 38)))
    for _ in range(3):
        x = rng.normal(size=(11, 38))
        z = x.ravel()
        assert z @ H @ z + q @ z == pytest.approx(objective(x) - constant, rel=1e-10)


# Solvers that fail --------------------------------------------------------------------------------


def lying(problem, **_):
    """A solver that calls a feasible point an optimum."""
    return qpsolvers.Solution(problem, x=0.5 * problem.ub, found=True)


def silent(problem, **_):
    return qpsolvers.Solution(problem, x=None, found=False)


def missing(problem, **_):
    raise qpsolvers.SolverNotFound("no such solver")


@both_backends
@pytest.mark.parametrize("solver", [silent, missing])
def test_what_is_not_solved_leaves_the_prediction_and_a_flag(backend, solver, monkeypatch):
    episodes = simulate(n_steps=10)
    mhe = started(backend, episodes)
    run(mhe, episodes, range(8))
    monkeypatch.setattr(qpsolvers, "solve_problem", solver)
    monkeypatch.setattr(mhe_kernels, "update", unsolved)
    mhe.predict(episodes.everyone, episodes.inputs[8])
    predicted = mhe.states
    mhe.update(episodes.everyone, episodes.observed[8], episodes.values[8], SIGMA)
    assert mhe.fallback.tolist() == [True]
    assert mhe.diverged.tolist() == [False]
    np.testing.assert_array_equal(mhe.states, predicted)
    monkeypatch.undo()
    run(mhe, episodes, [9])
    assert mhe.fallback.tolist() == [False]


def unsolved(road, filters, horizons, *given):
    """The update's kernel with its solution taken away."""
    mine = Horizons(*horizons)
    kept = [(array, array.copy()) for array in (Filters(*filters).means, mine.solution, mine.side)]
    update(road, filters, horizons, *given)
    for array, before in kept:
        array[:] = before
    mine.unsolved[:] = True


def test_what_the_active_set_leaves_goes_to_the_other_solver(monkeypatch):
    episodes = simulate(n_steps=12, noise=3.0)
    alone, helped = started("compiled", episodes), started("compiled", episodes)
    run(alone, episodes, range(12))
    run(helped, episodes, range(11))
    monkeypatch.setattr(mhe_kernels, "update", unsolved)
    run(helped, episodes, [11])
    assert helped.n_passed_on == 1
    assert not helped.fallback.any()
    np.testing.assert_allclose(helped.states, alone.states, rtol=1e-9, atol=1e-6)
    np.testing.assert_array_equal(helped._horizons.side, alone._horizons.side)


def test_a_false_optimum_is_noticed(monkeypatch):
    """The residual decides: without the polish it is refused, with it at most a place to start."""
    mhe = bounded_window()
    H, q = assemble(mhe.window(0))
    lower, upper = (np.tile(b, 11) for b in normalised_bounds(mhe.model, "box"))
    assert solve(H, q, lower, upper, "piqp") is not None
    monkeypatch.setattr(qpsolvers, "solve_problem", lying)
    z = solve(H, q, lower, upper, "piqp")
    assert z is None or natural_residual(H, q, lower, upper, z) < 1e-8
    monkeypatch.setattr(horizon_module, "POLISHES", 0)
    assert solve(H, q, lower, upper, "piqp") is None


def test_the_residual_tells_an_optimum_from_a_corner():
    H, q = np.diag([1.0, 2.0]), np.array([-4.0, 4.0])
    lower, upper = np.zeros(2), np.ones(2)
    assert natural_residual(H, q, lower, upper, np.array([1.0, 0.0])) == 0.0
    assert natural_residual(H, q, lower, upper, np.array([0.0, 0.0])) == 1.0
    assert np.isnan(natural_residual(H, q, lower, upper, np.array([np.nan, 0.0])))


# Soundness ----------------------------------------------------------------------------------------


@both_bounds
@both_linearisations
@pytest.mark.parametrize("filling", [0.0, 1.0], ids=["empty", "jam"])
@both_backends
def test_adversarial_starts_and_noise_stay_finite_and_within_bounds(
    backend, linearisation, bounds, filling
):
    steps = 300 if backend == "compiled" else 20
    episodes = simulate(n=2, n_steps=steps, noise=10.0)
    model = episodes.model
    mhe = started(backend, episodes, bounds=bounds, linearisation=linearisation)
    mhe.reset(episodes.everyone, poor_start(episodes, filling), random_streams(2))

    def check(_):
        states, estimate = mhe.states, mhe.estimate()
        np.testing.assert_allclose(model.project(states, bounds), states, rtol=1e-12)
        for field in ("density", "speed", "density_std", "speed_std"):
            assert np.isfinite(getattr(estimate, field)).all()
        assert np.isfinite(mhe.innovations).all()
        assert not np.any(mhe.diverged | mhe.fallback)

    run(mhe, episodes, range(steps), watch=check)


def test_covariance_stays_symmetric_and_definite():
    episodes = simulate(n_steps=700)
    mhe = started("compiled", episodes)

    def check(_):
        covariances = mhe.covariances
        np.testing.assert_array_equal(covariances, covariances.swapaxes(1, 2))
        assert np.linalg.eigvalsh(covariances).min() > 0.0

    run(mhe, episodes, range(700), watch=check)


@both_backends
@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_divergence_is_flagged_and_ends_at_the_prior(backend, poison):
    episodes = simulate(n=3, n_steps=15)
    mhe, healthy = started(backend, episodes), started(backend, episodes)
    run(mhe, episodes, range(10))
    run(healthy, episodes, range(10))
    poisoned = episodes.values[10].copy()
    poisoned[1, 14, 0] = poison
    for one, values in ((mhe, poisoned), (healthy, episodes.values[10])):
        one.predict(episodes.everyone, episodes.inputs[10])
        one.update(episodes.everyone, episodes.observed[10], values, SIGMA)
    assert mhe.diverged.tolist() == [False, True, False]
    np.testing.assert_allclose(mhe.states[1], episodes.start[1], rtol=1e-12)
    np.testing.assert_array_equal(mhe.covariances[1], 1e-3 * np.eye(38))
    np.testing.assert_array_equal(mhe.innovations[1], 0.0)
    np.testing.assert_array_equal(mhe.states[[0, 2]], healthy.states[[0, 2]])
    run(mhe, episodes, range(11, 15))
    assert not mhe.diverged.any()
    assert np.isfinite(mhe.states).all()


@both_backends
def test_non_finite_inputs_diverge_instead_of_crashing(backend):
    episodes = simulate(n_steps=2)
    mhe = started(backend, episodes)
    mhe.predict(episodes.everyone, np.full((1, 9), np.nan))
    mhe.update(episodes.everyone, episodes.observed[0], episodes.values[0], SIGMA)
    assert mhe.diverged.tolist() == [True]
    assert np.isfinite(mhe.states).all()


@both_backends
def test_an_empty_set_of_measurements_leaves_the_prediction(backend):
    episodes = simulate(n_steps=25)
    mhe = started(backend, episodes)
    run(mhe, episodes, range(20))
    nothing, unread = np.zeros((1, 19), bool), np.full((1, 19, 2), np.nan)
    for k in range(20, 24):
        spread = mhe.estimate().density_std
        mhe.predict(episodes.everyone, episodes.inputs[k])
        states = mhe.states
        mhe.update(episodes.everyone, nothing, unread, SIGMA)
        np.testing.assert_array_equal(mhe.states, states)
        np.testing.assert_array_equal(mhe.innovations, 0.0)
        assert mhe.estimate().density_std.mean() > spread.mean()
    assert not mhe.diverged.any()
    run(mhe, episodes, [24])
    assert not np.array_equal(mhe.states, states)


@both_backends
def test_worthless_measurements_leave_the_model_alone(backend):
    """Along the trajectory the linearised window retraces the model's own path."""
    episodes = simulate(n_steps=40)
    mhe = started(backend, episodes, linearisation="trajectory", bounds="cone")
    alone = make_estimator("open_loop", backend, episodes.model, 1)
    alone.reset(episodes.everyone, episodes.start, random_streams(1))
    for filters in (mhe, alone):
        run(filters, episodes, range(40), sigma=np.array([1e12, 1e12]))
    np.testing.assert_allclose(mhe.states, alone.states, rtol=1e-8)


@both_backends
def test_an_exact_measurement_is_weighed_as_a_very_good_one(backend):
    episodes = simulate(n_steps=20)
    mhe = started(backend, episodes)
    run(mhe, episodes, range(20), sigma=np.zeros(2))
    assert not np.any(mhe.diverged | mhe.fallback)
    seen = episodes.observed[19, 0]
    gap = mhe.estimate().density[0, seen] - np.maximum(episodes.values[19, 0, seen, 0], 0.0)
    assert np.abs(gap).max() < 2.0


# Batches ------------------------------------------------------------------------------------------


@both_backends
def test_a_batch_equals_a_loop_to_the_bit(backend):
    steps = 60 if backend == "compiled" else 15
    episodes = simulate(n=3, n_steps=steps, noise=2.0)
    batch = started(backend, episodes)
    run(batch, episodes, range(steps))
    for i in range(3):
        one = BACKENDS[backend](episodes.model, 1, EstimatorSettings())
        alone, row = np.arange(1), slice(i, i + 1)
        one.reset(alone, episodes.start[row], random_streams(1))
        for k in range(steps):
            one.predict(alone, episodes.inputs[k, row])
            one.update(alone, episodes.observed[k, row], episodes.values[k, row], SIGMA)
        np.testing.assert_array_equal(one.states[0], batch.states[i])
        np.testing.assert_array_equal(one.covariances[0], batch.covariances[i])
        np.testing.assert_array_equal(one.innovations[0], batch.innovations[i])


@both_backends
def test_only_the_episodes_named_are_touched(backend):
    episodes = simulate(n=4, n_steps=16)
    mhe, other = started(backend, episodes), started(backend, episodes)
    run(mhe, episodes, range(12))
    run(other, episodes, range(12))
    some = np.array([3, 1])
    mhe.predict(some, episodes.inputs[12, some])
    mhe.update(some, episodes.observed[12, some], episodes.values[12, some], SIGMA)
    mhe.reset(np.array([1]), episodes.start[[1]], random_streams(1))
    for state in ("states", "covariances", "innovations"):
        now, before = getattr(mhe, state), getattr(other, state)
        np.testing.assert_array_equal(now[[0, 2]], before[[0, 2]])
        assert not np.array_equal(now[3], before[3])
    np.testing.assert_allclose(mhe.states[1], episodes.start[1], rtol=1e-12)
    # What is hidden of the others goes on as if nothing had happened, too.
    rest = np.array([0, 2])
    for one in (mhe, other):
        one.predict(rest, episodes.inputs[13, rest])
        one.update(rest, episodes.observed[13, rest], episodes.values[13, rest], SIGMA)
    np.testing.assert_array_equal(mhe.states[rest], other.states[rest])


@both_backends
def test_a_reset_forgets(backend):
    episodes = simulate(n_steps=15)
    first, second = started(backend, episodes), started(backend, episodes)
    run(first, episodes, range(15))
    run(second, episodes, range(9))
    second.reset(episodes.everyone, episodes.start, random_streams(1))
    run(second, episodes, range(15))
    np.testing.assert_array_equal(first.states, second.states)


# Settings -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 0}, r"estimator.mhe.horizon must be an integer >= 1, got 0"),
        ({"horizon": 2.5}, r"estimator.mhe.horizon must be an integer >= 1, got 2\.5"),
        ({"arrival_noise": (0.1, 0.0)}, r"estimator.mhe.arrival_noise\[1\] must be > 0"),
        ({"linearisation": "none"}, r"must be 'paper' or 'trajectory', got 'none'"),
        ({"bounds": "ball"}, r"estimator.mhe.bounds must be 'cone' or 'box', got 'ball'"),
        ({"solver": "highs"}, r"estimator.mhe.solver must not be 'highs'"),
    ],
)
def test_bad_settings_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        HorizonSettings(**changes)


@both_backends
def test_a_perfect_model_has_no_weight(backend):
    with pytest.raises(ValueError, match=r"estimator.process_noise\[0\] must be > 0"):
        started(backend, simulate(n_steps=1), EstimatorSettings(process_noise=(0.0, 0.01)))
