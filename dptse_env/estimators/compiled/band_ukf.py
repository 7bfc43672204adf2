"""Compiled kernels of the unscented Kalman filter whose covariances reach a band along the road.

As `dptse_env.estimators.compiled.ukf_kernels`, with other forms of covariances (`band`) and points
(`band_points`): time and memory grow with the length of the road times the square of the band.
Measured numbers are taken in one by one, a row's density first; without a band this is the same
update. `Filters` have covariances `(n, n_x, H + 1)`, and `Points` fewer columns.
"""

import numpy as np

from dptse_env.estimators.compiled.band import Band
from dptse_env.estimators.compiled.band_ekf import add_noise, restart
from dptse_env.estimators.compiled.band_outputs import Joint, gather, join
from dptse_env.estimators.compiled.band_points import draw, factorise
from dptse_env.estimators.compiled.band_updates import (
    Update,
    begin,
    finish,
    is_covariance,
    scalar_update,
    variance_of,
)
from dptse_env.estimators.compiled.driver_noise import couple
from dptse_env.estimators.compiled.ekf_kernels import Filters, Packed, process_noise, project
from dptse_env.estimators.compiled.sigma_points import Points
from dptse_env.estimators.compiled.ukf_outputs import row_noise
from dptse_env.model.columns import (
    advance_states,
    make_batch_scratch,
    project_states,
)
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernel_loops import all_finite, copy_matrix, copy_vector
from dptse_env.utils.kernels import kernel, kernel_part


@kernel
def predict(
    road_: Packed,
    filters_: Packed,
    band_: Packed,
    points_: Packed,
    episodes: IntArray,
    inputs: FloatArray,
) -> None:
    """Predict one step ahead by points, which are made, predicted and projected."""
    road, filters, band = RoadArrays(*road_), Filters(*filters_), Band(*band_)
    points = Points(*points_)
    scratch = make_batch_scratch(road, points.states.shape[2])
    root = np.empty(filters.covariances.shape[1:])
    nothing, unread = np.zeros(road.row_first.size, dtype=np.bool_), np.empty(0)
    for k in range(episodes.size):
        e = episodes[k]
        mean, covariance, states = filters.means[e], filters.covariances[e], points.states[e]
        if not factorise(band, covariance, root):
            mean[:] = np.nan  # detected by the update, which resets the filter
        process_noise(road, filters, mean, points.noise[e])
        draw(points, band, e, mean, root)
        advance_states(road, states, inputs[k], scratch)
        project_states(road, states, filters.is_box)
        joint = join(road, band, nothing)
        gather(road, points, band, e, unread, joint)
        copy_matrix(joint.covariance, covariance)
        copy_vector(points.centres[e], mean)
        project(road, mean, filters.is_box)
        if filters.noise_in_w:
            couple(road, filters.density_scale, mean, points.noise[e], points.coupling[e])
        add_noise(band, points.noise[e], points.coupling[e], covariance)
        points.moved[e] = True


@kernel
def update(
    road_: Packed,
    filters_: Packed,
    band_: Packed,
    points_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
) -> None:
    """Update by measurements; see `Estimator.update`."""
    road, filters, band = RoadArrays(*road_), Filters(*filters_), Band(*band_)
    points = Points(*points_)
    noise = np.empty((road.row_first.size, 2))
    for k in range(episodes.size):
        e = episodes[k]
        filters.innovations[e] = 0.0
        rows, sound = np.flatnonzero(observed[k]), True
        if rows.size > 0:
            row_noise(road, filters, e, rows, sigma[k], noise)
            if not points.moved[e]:
                sound = _stay(road, filters, points, band, e)
            if sound:
                joint = join(road, band, observed[k])
                gather(road, points, band, e, centre[k], joint)
                sound = _take_in(road, filters, points, band, e, rows, values[k], noise, joint)
            points.moved[e] = False
        finite = all_finite(filters.means[e])
        filters.diverged[e] = not (sound and finite and is_covariance(filters.covariances[e]))
        if filters.diverged[e]:
            restart(filters, band, e)
            points.moved[e] = False


@kernel_part
def _stay(road: RoadArrays, filters: Filters, points: Points, band: Band, e: int) -> bool:
    """Make points without a prediction, after another update in the same step."""
    root = np.empty(filters.covariances.shape[1:])
    if not factorise(band, filters.covariances[e], root):
        return False
    draw(points, band, e, filters.means[e], root)
    project_states(road, points.states[e], filters.is_box)
    points.noise[e], points.coupling[e] = 0.0, 0.0
    return True


@kernel_part
def _take_in(
    road: RoadArrays,
    filters: Filters,
    points: Points,
    band: Band,
    e: int,
    rows: IntArray,
    values: FloatArray,
    noise: FloatArray,
    joint: Joint,
) -> bool:
    """Update by the measured rows; return whether their predicted variances are sound."""
    work, longest = begin(joint.base.size, joint.start.size - 1), road.row_span.max()
    numbers, slopes = np.empty(longest, dtype=np.int64), np.empty(longest)
    residuals = np.empty((rows.size, 2))
    for i in range(rows.size):
        for kind in range(2):
            residuals[i, kind] = _row(
                road, band, points.centres[e], joint, rows[i], values, kind, numbers, slopes
            )
            n = road.row_span[rows[i]]
            variance = variance_of(joint.covariance, joint.first, numbers[:n], slopes[:n])
            deviation = np.sqrt(variance + noise[i, kind])
            filters.innovations[e, rows[i], kind] = residuals[i, kind] / deviation
    for i in range(rows.size):
        for kind in range(2):
            _row(road, band, points.centres[e], joint, rows[i], values, kind, numbers, slopes)
            n = road.row_span[rows[i]]
            if not scalar_update(
                joint.covariance, joint.first, joint.last, joint.group, joint.start,
                numbers[:n], slopes[:n], residuals[i, kind], noise[i, kind], work,
            ):  # fmt: skip
                return False
    finish(joint.covariance, joint.group, work)
    _take_out(filters, points, band, e, joint, work)
    project(road, filters.means[e], filters.is_box)
    return True


@kernel_part
def _row(
    road: RoadArrays,
    band: Band,
    means: FloatArray,
    joint: Joint,
    m: int,
    values: FloatArray,
    kind: int,
    numbers: IntArray,
    slopes: FloatArray,
) -> float:
    """Write the numbers that a row's density or second number averages; return its residual."""
    first, span, total = road.row_first[m], road.row_span[m], 0.0
    slopes[:span] = 1.0 / span
    for i in range(span):
        s = first + i
        if kind == 0:
            numbers[i] = joint.state[band.segment[s]]
            total += means[2 * s]
        else:
            numbers[i] = joint.output[s]
            total += joint.centre[s]
    unit = band.scale[band.segment[first]] if kind == 0 else road.second_scale
    return float((values[m, kind] - total / span) / unit)


@kernel_part
def _take_out(
    filters: Filters, points: Points, band: Band, e: int, joint: Joint, work: Update
) -> None:
    """Write the state's mean and covariance, with the step's process noise."""
    covariance, reach = filters.covariances[e], joint.covariance.shape[1] - 1
    for p in range(band.order.size):
        k, component = joint.state[p], band.order[p]
        shift = work.shift[k] * band.scale[p]
        filters.means[e, component] = points.centres[e, component] + shift
        for other in range(band.first[p], p + 1):
            column = joint.state[other] - k + reach
            covariance[p, other - p + band.reach] = joint.covariance[k, column]
    add_noise(band, points.noise[e], points.coupling[e], covariance)
