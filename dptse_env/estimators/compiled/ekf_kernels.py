"""Compiled kernels of the extended Kalman filter, episode by episode.

Means are in physical units, as the model takes them; covariances are normalised, rho by rho_m and
psi by rho_m v_f, so that variances of all components are of one order.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from dptse_env.estimators.compiled.algebra import (
    is_covariance,
    mirror,
    propagate,
    scratch_vectors,
    segment_update,
)
from dptse_env.model.arz import LEAST_DENSITY, LEAST_W, MEASUREMENT_FLOOR
from dptse_env.model.kernels import advance, make_scratch, pressure
from dptse_env.model.parameters import LARGEST_W
from dptse_env.model.relations import VACUUM
from dptse_env.model.road_arrays import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

# A `RoadArrays` or `Filters` as a plain tuple: calling compiled code from Python with a named tuple
# costs 2 us more, a tenth of a step. Functions that Python calls take these.
Packed = tuple[Any, ...]


class Filters(NamedTuple):
    """State of the filters of n episodes."""

    means: FloatArray  # (n, 2 S) [veh/km, veh/h]
    covariances: FloatArray  # (n, 2 S, padded) normalised, the padding zero
    priors: FloatArray  # (n, 2 S) prior means
    innovations: FloatArray  # (n, S, 2)
    diverged: BoolArray  # (n,)
    process_variance: FloatArray  # (2,) normalised
    initial_variance: float  # normalised
    density_scale: float  # rho_m [veh/km]
    is_box: bool  # whether means are projected into the paper's box, not the cone


@njit(cache=True, error_model="numpy", nogil=True)
def predict(road_: Packed, filters_: Packed, episodes: IntArray, inputs: FloatArray) -> None:
    """Predict one step ahead under inputs `(k, n_u)`: x = f(x, u), P = F P F' + Q."""
    road, filters = RoadArrays(*road_), Filters(*filters_)
    scratch = make_scratch(road)
    blocks = np.empty((*road.neighbours.shape, 4))
    product, transposed = np.empty((2, *filters.covariances.shape[1:]))
    v_f = road.free_flow_speed
    for k in range(episodes.size):
        mean = filters.means[episodes[k]]
        advance(road, mean, inputs[k], mean, blocks, scratch)
        project(road, mean, filters.is_box)
        blocks[:, :, 1] *= v_f
        blocks[:, :, 2] /= v_f
        covariance = filters.covariances[episodes[k]]
        propagate(road, blocks, filters.process_variance, covariance, product, transposed)


@njit(cache=True, error_model="numpy", nogil=True)
def update(
    road_: Packed,
    filters_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
) -> None:
    """Update by measurements; see `Estimator.update`."""
    road, filters = RoadArrays(*road_), Filters(*filters_)
    shift = np.empty(filters.covariances.shape[2])
    work = scratch_vectors(shift.size)
    rows = np.empty((road.jam.size, 4))
    noise = np.array([(sigma[0] / filters.density_scale) ** 2, (sigma[1] / road.second_scale) ** 2])
    for k in range(episodes.size):
        e = episodes[k]
        mean, covariance = filters.means[e], filters.covariances[e]
        innovations = filters.innovations[e]
        _linearise(road, filters, mean, observed[k], values[k], rows)
        _innovate(covariance, observed[k], rows, noise, innovations)
        shift[:] = 0.0
        sound = True
        for s in range(road.jam.size):
            if not (observed[k, s] and sound):
                continue
            # All rows are linearised at the prediction, so their order is irrelevant.
            sound = segment_update(covariance, s, rows[s], noise, shift, work)
        if observed[k].any():
            mirror(covariance)
            for s in range(road.jam.size):
                mean[2 * s] += shift[2 * s] * filters.density_scale
                mean[2 * s + 1] += shift[2 * s + 1] * filters.density_scale * road.free_flow_speed
            project(road, mean, filters.is_box)
        filters.diverged[e] = not (
            sound and np.isfinite(mean).all() and is_covariance(covariance, shift)
        )
        if filters.diverged[e]:
            restart(filters, e)


@njit(cache=True, error_model="numpy")
def restart(filters: Filters, episode: int) -> None:
    """Reset an episode's filter to its prior."""
    filters.means[episode] = filters.priors[episode]
    filters.innovations[episode] = 0.0
    covariance = filters.covariances[episode]
    covariance[:] = 0.0
    for i in range(covariance.shape[0]):
        covariance[i, i] = filters.initial_variance


@njit(cache=True, error_model="numpy")
def project(road: RoadArrays, mean: FloatArray, is_box: bool) -> None:
    """Project a mean into its bounds, as `ARZModel.project`; a NaN stays NaN."""
    v_f = road.free_flow_speed
    for c in range(road.jam.size):
        rho, psi, jam = mean[2 * c], mean[2 * c + 1], road.jam[c]
        if is_box:
            rho = _clip(rho, 0.0, jam)
            low, high = 0.0, jam * v_f
        else:
            rho = _clip(rho, LEAST_DENSITY, jam)
            least_w = max(pressure(rho, jam, v_f, road.gamma), LEAST_W * v_f)
            low, high = least_w * rho, LARGEST_W * v_f * rho
        mean[2 * c], mean[2 * c + 1] = rho, _clip(psi, low, high)


@njit(cache=True, error_model="numpy")
def measured(
    rho: float, psi: float, jam: float, v_f: float, gamma: float
) -> tuple[float, float, float]:
    """Return the measured speed [km/h], density floored, and its derivatives by rho and psi."""
    floor = MEASUREMENT_FLOOR * jam
    floored = max(rho, floor)
    p = pressure(floored, jam, v_f, gamma)
    slope = -(psi / floored + gamma * p) / floored if rho > floor else 0.0
    return psi / floored - p, slope, 1.0 / floored


@njit(cache=True, error_model="numpy")
def released(road: RoadArrays, s: int, rho: float, psi: float) -> tuple[float, float, float]:
    """Return a segment's released speed or centred flow, and its derivatives by rho and psi."""
    jam, v_f, gamma = road.jam[s], road.free_flow_speed, road.gamma
    if np.isnan(road.reference_speed):
        return measured(rho, psi, jam, v_f, gamma)
    p = pressure(rho, jam, v_f, gamma)
    flow = psi - rho * (p + road.reference_speed)
    return flow, -(1.0 + gamma) * p - road.reference_speed, 1.0


@njit(cache=True, error_model="numpy")
def _linearise(
    road: RoadArrays,
    filters: Filters,
    mean: FloatArray,
    observed: BoolArray,
    values: FloatArray,
    rows: FloatArray,
) -> None:
    """Write the residuals of both releases and the second row of H, all normalised."""
    scale, unit = filters.density_scale, road.second_scale
    for s in range(road.jam.size):
        if observed[s]:
            rho, psi = mean[2 * s], mean[2 * s + 1]
            second, by_rho, by_psi = released(road, s, rho, psi)
            rows[s, 0] = (values[s, 0] - rho) / scale
            rows[s, 1] = (values[s, 1] - second) / unit
            rows[s, 2] = by_rho * scale / unit
            rows[s, 3] = by_psi * scale * road.free_flow_speed / unit


@njit(cache=True, error_model="numpy")
def _innovate(
    covariance: FloatArray,
    observed: BoolArray,
    rows: FloatArray,
    noise: FloatArray,
    innovations: FloatArray,
) -> None:
    """Write residuals over their predicted deviations, before the update."""
    innovations[:] = 0.0
    for s in range(observed.size):
        if observed[s]:
            variance = variance_along(covariance, s, rows[s, 2], rows[s, 3])
            innovations[s, 0] = rows[s, 0] / np.sqrt(covariance[2 * s, 2 * s] + noise[0])
            innovations[s, 1] = rows[s, 1] / np.sqrt(variance + noise[1])


@njit(cache=True, error_model="numpy")
def variance_along(covariance: FloatArray, s: int, by_rho: float, by_psi: float) -> float:
    """Return the variance of a quantity with these derivatives by a segment's rho and psi."""
    a, b = covariance[2 * s, 2 * s], covariance[2 * s, 2 * s + 1]
    c = covariance[2 * s + 1, 2 * s + 1]
    return float(by_rho * by_rho * a + 2.0 * by_rho * by_psi * b + by_psi * by_psi * c)


@njit(cache=True, error_model="numpy", nogil=True)
def summarise(road_: Packed, filters_: Packed, out: FloatArray) -> None:
    """Write density, speed and their standard deviations to `out` `(4, n, S)`, physical units."""
    road, filters = RoadArrays(*road_), Filters(*filters_)
    v_f, scale = road.free_flow_speed, filters.density_scale
    largest = LARGEST_W * v_f
    for e in range(filters.means.shape[0]):
        mean, covariance = filters.means[e], filters.covariances[e]
        for s in range(road.jam.size):
            rho, psi, jam = mean[2 * s], mean[2 * s + 1], road.jam[s]
            p = pressure(rho, jam, v_f, road.gamma)
            w = psi / rho if rho > VACUUM * jam else v_f
            _, by_rho, by_psi = measured(rho, psi, jam, v_f, road.gamma)
            variance = variance_along(covariance, s, by_rho * scale, by_psi * scale * v_f)
            out[0, e, s] = rho
            out[1, e, s] = _clip(w - p, 0.0, largest)
            out[2, e, s] = scale * np.sqrt(max(covariance[2 * s, 2 * s], 0.0))
            out[3, e, s] = np.sqrt(max(variance, 0.0))


@njit(cache=True, error_model="numpy")
def _clip(value: float, low: float, high: float) -> float:
    if value < low:
        return low
    if value > high:
        return high
    return value
