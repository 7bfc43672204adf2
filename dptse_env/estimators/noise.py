"""Variances of a filter's noise and prior, normalised: rho by rho_m, psi by rho_m v_f, w by v_f."""

import numpy as np

from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.parameters import LEAST_DENSITY
from dptse_env.utils.arrays import FloatArray


def process_variance(model: ARZModel, settings: EstimatorSettings) -> FloatArray:
    """Return the variances, shape (n_x,), of a step's process noise at a density of zero.

    They are of rho and psi, or of rho and w, by ``settings.process_noise_in``.
    """
    traffic = np.tile(settings.process_noise, model.n_segments)
    walk = 0.0 if settings.demand is None else settings.demand.walk
    return np.concatenate([traffic, np.full(model.n_demand_states, walk)]) ** 2


def initial_variance(model: ARZModel, settings: EstimatorSettings) -> FloatArray:
    """Return the variances, shape (n_x,), of the prior."""
    traffic = np.full(2 * model.n_segments, settings.initial_variance)
    deviation = 0.0 if settings.demand is None else settings.demand.deviation
    return np.concatenate([traffic, np.full(model.n_demand_states, deviation**2)])


def count_variance(model: ARZModel, settings: EstimatorSettings) -> FloatArray:
    """Return the variances of measured densities beside the noise, over rho [km/veh], shape (M,).

    They are those of a row's first segment; a row of several segments has so many times less.
    """
    lengths = model.layout.lengths[model.rows.first]
    variance: FloatArray = settings.count_noise / lengths / model.density_scale**2
    return variance


def density_growth(model: ARZModel, settings: EstimatorSettings, density: FloatArray) -> FloatArray:
    """Return the variances, shape (..., n_x), that densities (..., S) [veh/km] add to a step's."""
    growth = np.zeros((*density.shape[:-1], model.n_states))
    grown = settings.density_growth**2 * density / model.density_scale
    growth[..., 0 : 2 * model.n_segments : 2] = grown
    return growth


def drivers(model: ARZModel, states: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the densities and the w, shape (..., S), that noise in (rho, w) acts at, normalised.

    The density is at least 1 veh/km, so that psi keeps a variance in an empty segment, where w is
    v_f; elsewhere w is held to [0, 1.1 v_f].
    """
    rho, _ = model.components(states)
    w = np.clip(model.w(states), 0.0, model.largest_speed)
    return np.maximum(rho, LEAST_DENSITY) / model.density_scale, w / model.speed_scale


def coupled_covariance(model: ARZModel, variance: FloatArray, state: FloatArray) -> FloatArray:
    """Return Q, shape (n_x, n_x), of a noise in (rho, w), normalised.

    Since psi = rho w, a segment's block is [[a, w a], [w a, w^2 a + rho^2 b]].

    Args:
        model: The model.
        variance: Shape (n_x,); a and b of each segment, then those of demand factors.
        state: The mean that the step leads to, shape (n_x,) [veh/km, veh/h].
    """
    end = 2 * model.n_segments
    (rho, w), a, b = drivers(model, state[None]), variance[0:end:2], variance[1:end:2]
    Q, first = np.diag(variance), np.arange(0, end, 2)
    Q[first, first + 1] = Q[first + 1, first] = w[0] * a
    Q[first + 1, first + 1] = w[0] ** 2 * a + rho[0] ** 2 * b
    return Q
