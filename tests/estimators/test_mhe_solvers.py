"""Moving horizon estimators with solvers that fail, return false optima or are missing."""

import numpy as np
import pytest
import qpsolvers

from dptse_env.estimators import EstimatorSettings, HorizonSettings
from dptse_env.estimators import horizon as horizon_module
from dptse_env.estimators.compiled import mhe_kernels
from dptse_env.estimators.horizon import natural_residual, solve
from tests.cases import pairwise

from .episodes import SIGMA, run, simulate, started
from .solvers import lying, mad, missing, silent, stop_compiled_solvers, unsolved

both_backends = pytest.mark.parametrize("backend", ["compiled", "reference"])


@pytest.mark.parametrize(
    ("backend", "solver"), pairwise(["compiled", "reference"], [lying, mad, silent, missing])
)
def test_what_is_not_solved_leaves_the_prediction_and_a_flag(backend, solver, monkeypatch):
    episodes = simulate(n_steps=10)
    mhe = started("mhe", backend, episodes)
    run(mhe, episodes, range(8))
    assert not mhe.fallback.any()
    monkeypatch.setattr(qpsolvers, "solve_problem", solver)
    stop_compiled_solvers(monkeypatch)
    mhe.predict(episodes.everyone, episodes.inputs[8])
    predicted = mhe.states
    mhe.update(episodes.everyone, episodes.observed[8], episodes.values[8], SIGMA)
    assert mhe.fallback.tolist() == [True]
    assert mhe.diverged.tolist() == [False]
    np.testing.assert_array_equal(mhe.states, predicted)
    monkeypatch.undo()
    run(mhe, episodes, [9])
    assert mhe.fallback.tolist() == [False]


@both_backends
def test_a_reset_takes_the_flag_away(backend, monkeypatch):
    episodes = simulate(n=2, n_steps=1)
    mhe = started("mhe", backend, episodes)
    monkeypatch.setattr(qpsolvers, "solve_problem", silent)
    stop_compiled_solvers(monkeypatch)
    run(mhe, episodes, [0])
    assert mhe.fallback.tolist() == [True, True]
    mhe.reset(np.array([1]), episodes.start[[1]], [np.random.default_rng(0)])
    assert mhe.fallback.tolist() == [True, False]


@both_backends
def test_a_solver_that_is_not_installed_is_named_when_the_estimator_is_made(backend):
    settings = EstimatorSettings(mhe=HorizonSettings(solver="gurobi"))
    episodes = simulate(n_steps=12)
    with pytest.warns(
        RuntimeWarning, match=r"mhe\.solver 'gurobi' is not installed: .*piqp"
    ) as seen:
        mhe = started("mhe", backend, episodes, settings)
    assert len(seen) == 1
    run(mhe, episodes, range(12))  # any further warning would be an error
    assert mhe.fallback.any() == (backend == "reference")


@pytest.mark.parametrize("helper", ["projected Newton", "library"])
def test_what_one_solver_leaves_goes_to_the_next(helper, monkeypatch):
    episodes = simulate(n_steps=12, noise=3.0)
    alone, helped = started("mhe", "compiled", episodes), started("mhe", "compiled", episodes)
    run(alone, episodes, range(12))
    run(helped, episodes, range(11))
    if helper == "library":
        stop_compiled_solvers(monkeypatch)
    else:
        monkeypatch.setattr(mhe_kernels, "update", unsolved)
    predicted = helped.states.copy()
    run(helped, episodes, [11])
    assert helped.n_passed_on == (helper == "library")
    assert not helped.fallback.any()
    assert np.abs(helped.states - predicted).max() > 1e-3
    np.testing.assert_allclose(helped.states, alone.states, rtol=1e-9, atol=1e-6)
    np.testing.assert_array_equal(helped._windows.side, alone._windows.side)
    assert (alone._windows.side != 0).any()


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
            monkeypatch.setattr(horizon_module, "POLISHES", 0)
            assert solve(H, q, lower, upper, "piqp") is None
            monkeypatch.setattr(horizon_module, "POLISHES", 10)
        else:
            assert z is None


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
