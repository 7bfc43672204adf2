"""Settings and quadratic program of the window, shared by both moving horizon estimators.

All quantities here are normalised, rho by rho_m, psi and flows by rho_m v_f and speeds by v_f; a
demand factor is a number without a unit. A window holds L = T + 1 stages; z stacks their states.
The program is the paper's, eq. 17: `minimise z' H z + q' z with lower <= z <= upper`.
"""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from dptse_env.estimators.noise import initial_variance
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel, Bounds
from dptse_env.model.parameters import (
    LARGEST_FACTOR,
    LARGEST_W,
    LEAST_DENSITY,
    LEAST_FACTOR,
    LEAST_W,
)
from dptse_env.utils.arrays import FloatArray

# Largest natural residual of an optimum, in normalised states.
RESIDUAL = 1e-8
# Components so near to a bound are set to it: a speed is a quotient of numbers that may vanish.
AT_BOUND = 1e-13
# Solutions with a larger residual are not inaccurate optima, but wrong. The largest one of piqp is
# 4e-5, and 2e-2 where measurements are treated as exact.
ROUGH = 0.05
# Number of polishing steps; a second step mostly corrects what the first one missed.
POLISHES = 10
# Least deviation of a measurement, normalised: an exact one would have an infinite weight.
LEAST_DEVIATION = 1e-3


def moving_variance(model: ARZModel, settings: EstimatorSettings) -> FloatArray:
    """Return the arrival variances `(n_x,)` of a window that moves.

    They are those of `arrival_noise`, and for demand factors those of the prior: a window of the
    default length says less about a factor than its random walk takes away, and an arrival that is
    too sure of itself keeps a wrong factor for many windows.
    """
    variance = initial_variance(model, settings)
    n = 2 * model.n_segments
    variance[:n] = np.tile(np.square(settings.mhe.arrival_noise), model.n_segments)
    return variance


def settings_of_mhe(settings: EstimatorSettings) -> EstimatorSettings:
    """Return the settings with the bounds of the MHE, which differ from those of other estimators.

    Warns:
        RuntimeWarning: The solver is not installed; steps that need it keep the prediction.
    """
    import qpsolvers  # noqa: PLC0415

    solver, installed = settings.mhe.solver, qpsolvers.available_solvers
    if solver not in installed:
        warnings.warn(
            f"estimator_settings.mhe.solver {solver!r} is not installed: steps that need it keep "
            f"the prediction and set info['fallback']; installed: {', '.join(installed)}",
            RuntimeWarning,
            stacklevel=2,
        )
    return replace(settings, bounds=settings.mhe.bounds)


def normalised_bounds(model: ARZModel, bounds: Bounds) -> tuple[FloatArray, FloatArray]:
    """Return the least and the largest normalised state `(n_x,)` of the program."""
    share = model.jam_density / model.density_scale
    lower, upper = np.zeros(2 * model.n_segments), np.repeat(share, 2)
    if bounds == "cone":
        lower = np.tile([1.0, LEAST_W], model.n_segments) * LEAST_DENSITY / model.density_scale
        upper[1::2] *= LARGEST_W
    factors = np.ones(model.n_demand_states)
    return (
        np.concatenate([lower, LEAST_FACTOR * factors]),
        np.concatenate([upper, LARGEST_FACTOR * factors]),
    )


def natural_residual(
    H: FloatArray, q: FloatArray, lower: FloatArray, upper: FloatArray, z: FloatArray
) -> float:
    """Largest |z - clip(z - g / diag(2 H), lower, upper)|, g = 2 H z + q; 0 at the optimum only.

    The gradient is scaled by the diagonal, so that the residual is in units of z for any weights.
    It is NaN where z is.
    """
    step = (2.0 * H @ z + q) / (2.0 * np.diag(H))
    return float(np.max(np.abs(z - np.clip(z - step, lower, upper))))


def solve(
    H: FloatArray, q: FloatArray, lower: FloatArray, upper: FloatArray, solver: str
) -> FloatArray | None:
    """Minimise z' H z + q' z within bounds by qpsolvers; None where it finds no optimum.

    An interior point method stops short of the bounds, so its solution is polished several times:
    components that are nearly at a bound and pressed against it are set to it, and the others are
    solved for. The best solution is returned. The `natural_residual`, not the solver's status,
    decides whether a solution is worth polishing and whether the result is an optimum.
    """
    # Imported here, since the compiled estimator rarely needs it.
    import qpsolvers  # noqa: PLC0415

    P = sp.csc_matrix(2.0 * H)  # qpsolvers minimises z' P z / 2 + q' z
    problem = qpsolvers.Problem(P, q, lb=lower, ub=upper)
    options: dict[str, Any] = {"eps_abs": 1e-9, "eps_rel": 1e-9} if solver == "piqp" else {}
    try:
        z = qpsolvers.solve_problem(problem, solver=solver, **options).x
    except (qpsolvers.SolverNotFound, qpsolvers.SolverError):
        return None
    if z is None:
        return None
    best = z = np.clip(z, lower, upper)
    if not natural_residual(H, q, lower, upper, z) <= ROUGH:  # a NaN is no optimum either
        return None
    for _ in range(POLISHES):
        try:
            z = _polish(P, q, lower, upper, z)
        except RuntimeError:  # splu: the matrix is singular
            break
        pair = best, np.clip(z, lower, upper)
        best = min(pair, key=lambda z: natural_residual(H, q, lower, upper, z))
    best = np.where(best < lower + AT_BOUND, lower, np.where(best > upper - AT_BOUND, upper, best))
    return best if natural_residual(H, q, lower, upper, best) <= RESIDUAL else None


def _polish(
    P: sp.csc_matrix, q: FloatArray, lower: FloatArray, upper: FloatArray, z: FloatArray
) -> FloatArray:
    """Set variables that are pressed against a bound to it, and solve for the others."""
    step = (P @ z + q) / P.diagonal()
    at_lower, at_upper = z - lower <= step, upper - z <= -step
    free = ~(at_lower | at_upper)
    exact: FloatArray = np.where(at_lower, lower, np.where(at_upper, upper, 0.0))
    factors = splu(P[free][:, free].tocsc())
    for _ in range(2):  # the second pass corrects rounding errors
        exact[free] += factors.solve(-(q + P @ exact)[free])
    return exact
