"""Solvers that fail, to stand in for `qpsolvers.solve_problem` and for the compiled ones."""

import numpy as np
import qpsolvers

from dptse_env.estimators.compiled import mhe_kernels, road_kernels
from dptse_env.estimators.compiled.ekf_kernels import Filters
from dptse_env.estimators.compiled.mhe_kernels import update
from dptse_env.estimators.compiled.stages import UNSOLVED, Windows


def lying(problem, **_):
    """A solver that calls a feasible point an optimum."""
    return qpsolvers.Solution(problem, x=0.5 * problem.ub, found=True)


def mad(problem, **_):
    return qpsolvers.Solution(problem, x=np.full_like(problem.ub, np.nan), found=True)


def silent(problem, **_):
    return qpsolvers.Solution(problem, x=None, found=False)


def missing(problem, **_):
    raise qpsolvers.SolverNotFound("no such solver")


def unsolved(road, filters, windows, *given):
    """The update's kernel with its solution taken away."""
    mine = Windows(*windows)
    kept = [(array, array.copy()) for array in (Filters(*filters).means, mine.solution, mine.side)]
    update(road, filters, windows, *given)
    for array, before in kept:
        array[:] = before
    mine.rounds[:] = UNSOLVED


def stop_compiled_solvers(monkeypatch):
    """Let neither compiled method solve a program of a short road."""
    monkeypatch.setattr(mhe_kernels, "update", unsolved)
    monkeypatch.setattr(road_kernels, "solve", lambda *_: None)
