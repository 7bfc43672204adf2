"""Compiled kernels of the extended Kalman filter, episode by episode.

Means are in physical units, as the model takes them; covariances are normalised, rho by rho_m and
psi by rho_m v_f, so that variances of all components are of one order.
"""

from typing import Any, NamedTuple

import numpy as np

from dptse_env.estimators.compiled.algebra import (
    is_covariance,
    mirror,
    propagate,
    scratch_vectors,
    segment_update,
)
from dptse_env.estimators.compiled.ekf_rows import (
    innovate,
    linearise,
    make_rows,
    update_wide,
    variance_along,
)
from dptse_env.model.network import RoadArrays
from dptse_env.model.parameters import LARGEST_W, VACUUM
from dptse_env.model.step import advance, clip, make_scratch, measured, normalise, pressure, project
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernel_loops import all_finite, any_of, copy_vector
from dptse_env.utils.kernels import kernel, kernel_part

# A `RoadArrays` or `Filters` as a plain tuple: calling compiled code from Python with a named tuple
# costs 2 us more, a tenth of a step. Functions that Python calls take these.
Packed = tuple[Any, ...]


class Filters(NamedTuple):
    """State of the filters of n episodes."""

    means: FloatArray  # (n, n_x) [veh/km, veh/h], then demand factors if there are any
    covariances: FloatArray  # (n, n_x, padded) normalised, the padding zero
    priors: FloatArray  # (n, n_x) prior means
    innovations: FloatArray  # (n, M, 2)
    diverged: BoolArray  # (n,)
    process_variance: FloatArray  # (n_x,) normalised
    growth_variance: float  # variance that rho / rho_m = 1 adds to the process noise of rho
    count_variance: FloatArray  # (M,) variance of densities beside the noise, over rho, normalised
    initial_variance: FloatArray  # (n_x,) normalised
    density_scale: float  # rho_m [veh/km]
    is_box: bool  # whether means are projected into the paper's box, not the cone


@kernel
def predict(road_: Packed, filters_: Packed, episodes: IntArray, inputs: FloatArray) -> None:
    """Predict one step ahead under inputs `(k, n_u)`: x = f(x, u), P = F P F' + Q."""
    road, filters = RoadArrays(*road_), Filters(*filters_)
    scratch = make_scratch(road)
    blocks, by_factor = np.empty((*road.neighbours.shape, 4)), scratch.by_factor
    size = filters.covariances.shape[1:]
    product, transposed = np.empty(size), np.empty(size)  # not one array: layouts stay known
    noise = np.empty(filters.process_variance.size)
    for k in range(episodes.size):
        mean = filters.means[episodes[k]]
        process_noise(road, filters, mean, noise)
        advance(road, mean, inputs[k], mean, blocks, scratch)
        project(road, mean, filters.is_box)
        normalise(road, filters.density_scale, blocks, by_factor)
        covariance = filters.covariances[episodes[k]]
        propagate(road, blocks, by_factor, noise, covariance, product, transposed)


@kernel_part
def process_noise(
    road: RoadArrays, filters: Filters, mean: FloatArray, variance: FloatArray
) -> None:
    """Write the variances of the process noise of a step that leaves a mean `(n_x,)`."""
    copy_vector(filters.process_variance, variance)
    if filters.growth_variance == 0.0:
        return
    for s in range(road.jam.size):
        variance[2 * s] += filters.growth_variance * mean[2 * s] / filters.density_scale


@kernel
def update(
    road_: Packed,
    filters_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
) -> None:
    """Update by measurements; see `Estimator.update`."""
    road, filters = RoadArrays(*road_), Filters(*filters_)
    shift = np.empty(filters.covariances.shape[2])
    work = scratch_vectors(shift.size)
    rows = make_rows(road)
    for k in range(episodes.size):
        e = episodes[k]
        mean, covariance = filters.means[e], filters.covariances[e]
        linearise(
            road,
            filters.density_scale,
            filters.count_variance,
            mean,
            observed[k],
            values[k],
            sigma[k],
            centre[k],
            rows,
        )
        innovate(road, covariance, observed[k], rows, filters.innovations[e])
        shift[:] = 0.0
        sound, n_wide = True, 0
        for m in range(road.row_first.size):
            if not (observed[k, m] and sound):
                continue
            if road.row_span[m] > 1:
                n_wide += 1
                continue
            # All rows are linearised at the prediction, so their order is irrelevant.
            sound = segment_update(
                covariance, road.row_first[m], rows.single[m], rows.noise[m], shift, work
            )
        if n_wide > 0 and sound:
            sound = update_wide(road, covariance, observed[k], rows, shift, work)
        if any_of(observed[k]):
            mirror(covariance)
            for s in range(road.jam.size):
                mean[2 * s] += shift[2 * s] * filters.density_scale
                mean[2 * s + 1] += shift[2 * s + 1] * filters.density_scale * road.free_flow_speed
            for i in range(2 * road.jam.size, mean.size):
                mean[i] += shift[i]
            project(road, mean, filters.is_box)
        filters.diverged[e] = not (sound and all_finite(mean) and is_covariance(covariance, shift))
        if filters.diverged[e]:
            restart(filters, e)


@kernel
def restart(filters: Filters, episode: int) -> None:
    """Reset an episode's filter to its prior."""
    copy_vector(filters.priors[episode], filters.means[episode])
    filters.innovations[episode] = 0.0
    covariance = filters.covariances[episode]
    covariance[:] = 0.0
    for i in range(covariance.shape[0]):
        covariance[i, i] = filters.initial_variance[i]


@kernel
def summarise(road_: Packed, filters_: Packed, out: FloatArray) -> None:
    """Write density, speed and their standard deviations to `out` `(4, n, S)`, physical units."""
    road, filters = RoadArrays(*road_), Filters(*filters_)
    for e in range(filters.means.shape[0]):
        for s in range(road.jam.size):
            summarise_segment(road, filters, e, s, filters.covariances[e], s, out)


@kernel_part
def summarise_segment(
    road: RoadArrays,
    filters: Filters,
    e: int,
    s: int,
    covariance: FloatArray,
    at: int,
    out: FloatArray,
) -> None:
    """Write what `summarise` does of a segment, whose covariance is block `at` of a matrix."""
    v_f, scale = road.free_flow_speed, filters.density_scale
    rho, psi, jam = filters.means[e, 2 * s], filters.means[e, 2 * s + 1], road.jam[s]
    p = pressure(rho, jam, v_f, road.gamma)
    w = psi / rho if rho > VACUUM * jam else v_f
    _, by_rho, by_psi = measured(rho, psi, jam, v_f, road.gamma)
    variance = variance_along(covariance, at, by_rho * scale, by_psi * scale * v_f)
    out[0, e, s] = rho
    out[1, e, s] = clip(w - p, 0.0, LARGEST_W * v_f)
    out[2, e, s] = scale * np.sqrt(max(covariance[2 * at, 2 * at], 0.0))
    out[3, e, s] = np.sqrt(max(variance, 0.0))
