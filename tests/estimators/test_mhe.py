"""The moving horizon estimator beside the reference, and what it leaves to other solvers."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import qpsolvers

from dptse_env.estimators import (
    BACKENDS,
    DemandSettings,
    EstimatorSettings,
    HorizonSettings,
    make_estimator,
)
from dptse_env.estimators import mhe as mhe_module
from dptse_env.estimators.mhe import (
    GENERAL_SOLVER,
    natural_residual,
    normalised_bounds,
    solve,
)
from dptse_env.estimators.mhe import update as solve_and_update
from dptse_env.estimators.window import ACTIVE_SET, NEWTON, UNSOLVED
from dptse_env.model import ARZModel, load_parameters
from tests.helpers import UNEVEN, fast_and_slow, pairwise

from .episodes import RELEASES, SIGMA, SIGMAS, random_streams, run, simulate, started, tell
from .rows import PLAIN, RICH, averaged, update

both_backends = pytest.mark.parametrize("backend", BACKENDS)


def mhe_of(backend, episodes, start=None, settings=PLAIN, **own):
    return started("mhe", backend, episodes, replace(settings, mhe=HorizonSettings(**own)), start)


def minimum(mhe, episode=0):
    """The last state of a program's minimum by the general solver."""
    H, q = mhe.program(episode)
    n = mhe.model.n_states
    bounds = (np.tile(b, len(q) // n) for b in normalised_bounds(mhe.model, mhe.settings.bounds))
    return solve(H, q, *bounds, "piqp")[-n:]


def assert_minimal(mhe, tolerance=1e-9):
    """Every episode's estimate ends its program's minimum, brought into the cone where it is so."""
    solved = mhe.solved
    assert np.isin(solved, (ACTIVE_SET, NEWTON)).all(), solved
    assert not np.any(mhe.diverged | mhe.fallback)
    for e, state in enumerate(mhe.states):
        end = mhe.model.project(
            (minimum(mhe, e) * mhe.model.state_scale)[None], mhe.settings.bounds
        )
        assert np.abs((end[0] - state) / mhe.model.state_scale).max() <= tolerance


# Beside the reference -----------------------------------------------------------------------------


def agree(compiled, reference, tolerance):
    """Compare programs, states, covariances, innovations and flags of both after a step."""
    for ours, theirs in zip(compiled.program(0), reference.program(0), strict=True):
        np.testing.assert_allclose(
            ours, theirs, rtol=0, atol=1e3 * tolerance * np.abs(theirs).max()
        )
    gap = np.abs(compiled.states - reference.states) / compiled.model.state_scale
    assert gap.max() <= tolerance
    np.testing.assert_allclose(compiled.covariances, reference.covariances, rtol=0, atol=tolerance)
    close = {"rtol": 0, "atol": 1e3 * tolerance}
    np.testing.assert_allclose(compiled.innovations, reference.innovations, **close)
    for mhe in (compiled, reference):
        assert not np.any(mhe.fallback | mhe.diverged)
    assert compiled.solved[0] in (ACTIVE_SET, NEWTON)


@pytest.mark.parametrize(
    ("bounds", "linearisation", "release", "horizon"),
    pairwise(["cone", "box"], ["paper", "trajectory"], RELEASES, [1, 5], n=4),
)
def test_backends_agree(bounds, linearisation, release, horizon):
    """Over the growth of the window, and while it moves on; rounding feeds back by trajectories."""
    episodes = simulate(n_steps=horizon + 8, noise=2.0, release=release)
    own = {"bounds": bounds, "linearisation": linearisation, "horizon": horizon}
    compiled, reference = (mhe_of(backend, episodes, **own) for backend in BACKENDS)
    for k in range(len(episodes.inputs)):
        run(compiled, episodes, [k])
        run(reference, episodes, [k])
        agree(compiled, reference, 1e-9 if linearisation == "paper" else 1e-8)
    a, b = compiled.estimate(), reference.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("release", "linearisation", "tolerance"),
    [("speed", "paper", 1e-9), ("speed", "trajectory", 1e-8), ("flow", "paper", 1e-9)],
)
def test_backends_agree_over_a_recorded_episode(release, linearisation, tolerance, recordings):
    """Rounding is all: H has a condition of 1e7, and along the trajectory it feeds back."""
    episodes = recordings[release]
    compiled, reference = (mhe_of(b, episodes, linearisation=linearisation) for b in BACKENDS)
    for k in range(len(episodes.inputs)):
        run(compiled, episodes, [k])
        run(reference, episodes, [k])
        agree(compiled, reference, tolerance)


@pytest.mark.parametrize(
    ("settings", "linearisation", "bounds"),
    pairwise([PLAIN, RICH], ["paper", "trajectory"], ["box", "cone"], n=4),
)
def test_backends_agree_on_rows_that_overlap(settings, linearisation, bounds):
    """Rows of one to three segments, with centres of their own; the rich ones with demand."""
    episodes = averaged(10)
    own = {"bounds": bounds, "linearisation": linearisation, "horizon": 4}
    compiled, reference = (mhe_of(b, episodes, settings=settings, **own) for b in BACKENDS)
    for k in range(10):
        for mhe in (compiled, reference):
            mhe.predict(episodes.everyone, episodes.inputs[k])
            update(mhe, episodes, k)
        agree(compiled, reference, 1e-7)


def test_a_road_of_segments_of_many_kinds_is_estimated_alike():
    """Lengths, lanes and limits vary, ramps have several segments; predictions come in pairs."""
    model, one = ARZModel(UNEVEN, load_parameters("w99-3lane")), np.array([0])
    rng, s, v_f = np.random.default_rng(0), model.n_segments, model.speed_scale
    start = model.states(0.2 * model.jam_density[None], np.full((1, s), 0.5 * v_f))
    settings = EstimatorSettings(mhe=HorizonSettings(horizon=4))
    both = [make_estimator("mhe", backend, model, 1, settings) for backend in BACKENDS]
    boundary = np.full((1, model.n_boundaries), 10.0)
    inputs = model.boundary_inputs(boundary, np.full_like(boundary, 0.6 * v_f))
    for mhe in both:
        mhe.reset(one, start, random_streams(1))
    truth = model.measure(start)
    for k in range(10):
        observed, noise = rng.random((1, s)) < 0.4, rng.normal(size=(1, s, 2))
        values = truth + 3.0 * SIGMAS["speed"] * noise
        for mhe in both:
            for _ in range(1 + k % 2):
                mhe.predict(one, inputs)
            tell(mhe, one, observed, values, SIGMAS["speed"])
        agree(*both, 1e-8)


# Alone --------------------------------------------------------------------------------------------


POOR = [
    ("trajectory", "box", 1.0, "speed", 20),  # gradients are sums of large numbers that cancel
    ("trajectory", "cone", 0.0, "flow", 5),
    ("paper", "box", 0.0, "speed", 1),
    ("paper", "cone", 1.0, "flow", 5),
]


@pytest.mark.parametrize(
    ("linearisation", "bounds", "filling", "release", "horizon"),
    fast_and_slow(
        product(["paper", "trajectory"], ["box", "cone"], [0.0, 1.0], RELEASES, [1, 5, 20]), POOR
    ),
)
def test_poor_starts_under_ten_times_the_noise_are_solved(
    linearisation, bounds, filling, release, horizon
):
    """A batch in states of its own, with demand states."""
    episodes = simulate(n=3, n_steps=40, noise=10.0, release=release)
    density = np.full((3, 19), filling) * episodes.model.jam_density
    density[2] = 0.5 * episodes.model.jam_density
    start = episodes.model.states(density, np.zeros((3, 19)))
    settings = EstimatorSettings(demand=DemandSettings())
    own = {"bounds": bounds, "linearisation": linearisation, "horizon": horizon}
    mhe = mhe_of("compiled", episodes, start, settings, **own)

    def check(k):
        if k in (2, 9, 20, 39):
            assert_minimal(mhe)

    run(mhe, episodes, range(40), watch=check)


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


# Solvers that fail --------------------------------------------------------------------------------


def lying(problem, **_):
    """A solver that calls a feasible point an optimum."""
    return qpsolvers.Solution(problem, x=0.5 * problem.ub, found=True)


def mad(problem, **_):
    return qpsolvers.Solution(problem, x=np.full_like(problem.ub, np.nan), found=True)


def silent(problem, **_):
    return qpsolvers.Solution(problem, x=None, found=False)


def missing(problem, **_):
    raise qpsolvers.SolverNotFound("no such solver")


def unsolved(bundle, *given):
    """The update's kernel with its solution taken away."""
    _, filters, mine = bundle.parts
    kept = [(array, array.copy()) for array in (filters.means, mine.solution, mine.side)]
    solve_and_update(bundle, *given)
    for array, before in kept:
        array[:] = before
    mine.solved[:] = UNSOLVED


@pytest.mark.parametrize(("backend", "solver"), pairwise(BACKENDS, [lying, mad, silent, missing]))
def test_what_is_not_solved_leaves_the_prediction_and_a_flag(backend, solver, monkeypatch):
    episodes = simulate(n=2, n_steps=10)
    mhe = mhe_of(backend, episodes)
    run(mhe, episodes, range(8))
    assert not mhe.fallback.any()
    monkeypatch.setattr(qpsolvers, "solve_problem", solver)
    monkeypatch.setattr(mhe_module, "update", unsolved)
    mhe.predict(episodes.everyone, episodes.inputs[8])
    predicted = mhe.states
    tell(mhe, episodes.everyone, episodes.observed[8], episodes.values[8], SIGMA)
    assert mhe.fallback.tolist() == [True, True]
    assert mhe.diverged.tolist() == [False, False]
    np.testing.assert_array_equal(mhe.states, predicted)
    mhe.reset(np.array([1]), episodes.start[[1]], random_streams(1))
    assert mhe.fallback.tolist() == [True, False]
    monkeypatch.undo()
    run(mhe, episodes, [9])
    assert not mhe.fallback.any()


def test_what_is_not_solved_goes_to_the_general_solver(monkeypatch):
    episodes = simulate(n_steps=12, noise=3.0)
    alone, helped = mhe_of("compiled", episodes), mhe_of("compiled", episodes)
    run(alone, episodes, range(12))
    run(helped, episodes, range(10))
    monkeypatch.setattr(mhe_module, "update", unsolved)
    run(helped, episodes, [10])
    assert helped.solved.tolist() == [GENERAL_SOLVER]
    monkeypatch.undo()
    run(helped, episodes, [11])
    np.testing.assert_allclose(helped.states, alone.states, rtol=1e-9, atol=1e-6)


@both_backends
def test_a_solver_that_is_not_installed_is_named_when_the_estimator_is_made(backend):
    episodes = simulate(n_steps=12)
    message = r"mhe\.solver 'gurobi' is not installed: .*piqp"
    with pytest.warns(RuntimeWarning, match=message) as seen:
        mhe = mhe_of(backend, episodes, solver="gurobi")
    assert len(seen) == 1
    run(mhe, episodes, range(12))  # any further warning would be an error
    assert mhe.fallback.any() == (backend == "reference")


# The general solver -------------------------------------------------------------------------------


def random_program(n=30):
    """H, q and bounds of which many bind."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(n, n))
    return root @ root.T + np.eye(n), 10.0 * rng.normal(size=n), np.zeros(n), np.full(n, 0.3)


def test_what_lacks_digits_is_polished_and_what_is_false_is_refused(monkeypatch):
    H, q, lower, upper = random_program()
    right = solve(H, q, lower, upper, "piqp")
    assert natural_residual(H, q, lower, upper, right) < 1e-12
    assert ((right == lower) | (right == upper)).sum() >= 5
    answers = {"rough": right + 1e-4, "false": 0.5 * upper, "corner": upper}
    for name, answer in answers.items():
        solution = qpsolvers.Solution(None, x=answer, found=True)
        monkeypatch.setattr(qpsolvers, "solve_problem", lambda *_, s=solution, **__: s)
        z = solve(H, q, lower, upper, "piqp")
        if name == "rough":
            np.testing.assert_allclose(z, right, atol=1e-12)
            monkeypatch.setattr(mhe_module, "POLISHES", 0)
            assert solve(H, q, lower, upper, "piqp") is None
            monkeypatch.setattr(mhe_module, "POLISHES", 10)
        else:
            assert z is None


def test_half_of_twice_h_is_minimised():
    """qpsolvers takes z' P z / 2 + q' z, the paper has z' H z + q' z: P = H would halve z."""
    H, q = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([-4.0, -6.0])
    z = solve(H, q, np.full(2, -10.0), np.full(2, 10.0), "piqp")
    np.testing.assert_allclose(z, np.linalg.solve(2.0 * H, -q), atol=1e-9)


def test_the_residual_tells_an_optimum_from_a_corner():
    H, q = np.diag([1.0, 2.0]), np.array([-4.0, 4.0])
    lower, upper = np.zeros(2), np.ones(2)
    assert natural_residual(H, q, lower, upper, np.array([1.0, 0.0])) == 0.0
    assert natural_residual(H, q, lower, upper, np.array([0.0, 0.0])) == 1.0
    assert np.isnan(natural_residual(H, q, lower, upper, np.array([np.nan, 0.0])))


def test_a_program_without_a_single_optimum_is_solved_or_refused_and_never_raises():
    H, q = np.ones((2, 2)), np.array([-2.0, -2.0])  # z_0 + z_1 = 1 is optimal everywhere
    lower, upper = np.full(2, -10.0), np.full(2, 10.0)
    z = solve(H, q, lower, upper, "piqp")
    assert z is None or natural_residual(H, q, lower, upper, z) < 1e-8
