"""Compiled kernels of the extended Kalman filter whose covariances reach a band along the road.

As `dptse_env.estimators.compiled.ekf_kernels`, with another form of covariances (`band`): time and
memory grow with the length of the road times the band. Rows are taken in one by one, their density
first. `Filters` have covariances `(n, n_x, H + 1)`.
"""

import numpy as np

from dptse_env.estimators.compiled.band import Band
from dptse_env.estimators.compiled.band_algebra import make_tables, propagate
from dptse_env.estimators.compiled.band_updates import (
    Update,
    begin,
    finish,
    is_covariance,
    scalar_update,
    variance_of,
)
from dptse_env.estimators.compiled.driver_noise import couple
from dptse_env.estimators.compiled.ekf_kernels import (
    Filters,
    Packed,
    normalise,
    process_noise,
    project,
    summarise_segment,
)
from dptse_env.estimators.compiled.ekf_rows import Rows, linearise, make_rows
from dptse_env.model.network import RoadArrays
from dptse_env.model.step import advance, make_scratch
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernel_loops import all_finite, any_of
from dptse_env.utils.kernels import kernel, kernel_part


@kernel
def predict(
    road_: Packed, filters_: Packed, band_: Packed, episodes: IntArray, inputs: FloatArray
) -> None:
    """Predict one step ahead under inputs `(k, n_u)`: x = f(x, u), P = F P F' + Q."""
    road, filters, band = RoadArrays(*road_), Filters(*filters_), Band(*band_)
    scratch, tables = make_scratch(road), make_tables(band)
    blocks, by_factor = np.empty((*road.neighbours.shape, 4)), scratch.by_factor
    noise, coupling = np.empty(filters.process_variance.size), np.zeros(road.jam.size)
    for k in range(episodes.size):
        mean, covariance = filters.means[episodes[k]], filters.covariances[episodes[k]]
        process_noise(road, filters, mean, noise)
        advance(road, mean, inputs[k], mean, blocks, scratch)
        project(road, mean, filters.is_box)
        normalise(road, filters.density_scale, blocks, by_factor)
        if filters.noise_in_w:
            couple(road, filters.density_scale, mean, noise, coupling)
        propagate(road, band, blocks, by_factor, covariance, tables)
        add_noise(band, noise, coupling, covariance)


@kernel_part
def add_noise(band: Band, noise: FloatArray, coupling: FloatArray, covariance: FloatArray) -> None:
    """Add process noise: variances `(n_x,)` of the state, `(S,)` covariances of rho and psi."""
    for p in range(band.order.size):
        covariance[p, band.reach] += noise[band.order[p]]
    for s in range(coupling.size):
        covariance[band.segment[s] + 1, band.reach - 1] += coupling[s]


@kernel
def update(
    road_: Packed,
    filters_: Packed,
    band_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
) -> None:
    """Update by measurements; see `Estimator.update`."""
    road, filters, band = RoadArrays(*road_), Filters(*filters_), Band(*band_)
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
        filters.innovations[e] = 0.0
        sound = True
        if any_of(observed[k]):
            work = begin(band.order.size, band.start.size - 1)
            innovations = filters.innovations[e]
            sound = _take_in(road, band, covariance, observed[k], rows, innovations, work)
            finish(covariance, band.group, work)
            for p in range(band.order.size):
                mean[band.order[p]] += work.shift[p] * band.scale[p]
            project(road, mean, filters.is_box)
        filters.diverged[e] = not (sound and all_finite(mean) and is_covariance(covariance))
        if filters.diverged[e]:
            restart(filters, band, e)


@kernel_part
def _take_in(
    road: RoadArrays,
    band: Band,
    covariance: FloatArray,
    observed: BoolArray,
    rows: Rows,
    innovations: FloatArray,
    work: Update,
) -> bool:
    """Update by the observed rows; return whether their predicted variances are sound."""
    longest = 2 * road.row_span.max()
    places, slopes = np.empty(longest, dtype=np.int64), np.empty(longest)
    for kind in range(2):
        for m in range(observed.size):
            if observed[m]:
                n = _row(road, band, rows, m, kind, places, slopes)
                variance = variance_of(covariance, band.first, places[:n], slopes[:n])
                variance += rows.noise[m, kind]
                innovations[m, kind] = rows.single[m, kind] / np.sqrt(variance)
    for m in range(observed.size):
        for kind in range(2):
            if not observed[m]:
                continue
            n = _row(road, band, rows, m, kind, places, slopes)
            if not scalar_update(
                covariance, band.first, band.last, band.group, band.start, places[:n], slopes[:n],
                rows.single[m, kind], rows.noise[m, kind], work,
            ):  # fmt: skip
                return False
    return True


@kernel_part
def _row(
    road: RoadArrays,
    band: Band,
    rows: Rows,
    m: int,
    kind: int,
    places: IntArray,
    slopes: FloatArray,
) -> int:
    """Write the places and the derivatives of a row's density or second number; return how many."""
    n, part = 0, 1.0 / road.row_span[m]
    for s in range(road.row_first[m], road.row_first[m] + road.row_span[m]):
        place = band.segment[s]
        if kind == 0:
            places[n], slopes[n] = place, part
            n += 1
        else:
            places[n], slopes[n] = place, part * rows.slopes[s, 0]
            places[n + 1], slopes[n + 1] = place + 1, part * rows.slopes[s, 1]
            n += 2
    return n


@kernel
def restart(filters: Filters, band: Band, episode: int) -> None:
    """Reset an episode's filter to its prior."""
    filters.means[episode] = filters.priors[episode]
    filters.innovations[episode] = 0.0
    covariance = filters.covariances[episode]
    covariance[:] = 0.0
    for p in range(band.order.size):
        covariance[p, band.reach] = filters.initial_variance[band.order[p]]


@kernel
def summarise(road_: Packed, filters_: Packed, band_: Packed, out: FloatArray) -> None:
    """Write density, speed and their standard deviations to `out` `(4, n, S)`, physical units."""
    road, filters, band = RoadArrays(*road_), Filters(*filters_), Band(*band_)
    block, reach = np.empty((2, 2)), band.reach
    for e in range(filters.means.shape[0]):
        covariance = filters.covariances[e]
        for s in range(road.jam.size):
            p = band.segment[s]
            block[0, 0], block[1, 1] = covariance[p, reach], covariance[p + 1, reach]
            block[0, 1] = block[1, 0] = covariance[p + 1, reach - 1]
            summarise_segment(road, filters, e, s, block, 0, out)
