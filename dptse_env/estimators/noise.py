"""Variances of a filter's noise and prior, normalised: rho by rho_m, psi by rho_m v_f."""

import numpy as np

from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray


def process_variance(model: ARZModel, settings: EstimatorSettings) -> FloatArray:
    """Return the variances, shape (n_x,), of a step's process noise at a density of zero."""
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
