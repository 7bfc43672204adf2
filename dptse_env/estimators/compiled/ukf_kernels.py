"""Compiled kernels of the unscented Kalman filter, episode by episode.

The points of a step include the process noise of earlier steps only: Q is added to P after their
prediction, and the next points are made from that. On a linear system this is the Kalman filter of
x' = F (x + w), with noise before the motion. Adding the derivative's `H Q H'` to the covariance of
measurements would place it after the motion; on recorded traffic that filter is no better, and much
worse at small alpha.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from dptse_env.estimators.compiled.algebra import is_covariance, mirror
from dptse_env.estimators.compiled.dense import eliminate, products
from dptse_env.estimators.compiled.ekf_kernels import Filters, Packed, project, restart
from dptse_env.estimators.compiled.sigma_points import Points, distances_from_first, draw, gather
from dptse_env.estimators.compiled.state_batch import (
    advance_states,
    make_batch_scratch,
    project_states,
    released_by_states,
)
from dptse_env.model.road_arrays import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


@njit(cache=True, error_model="numpy", nogil=True)
def predict(
    road_: Packed, filters_: Packed, points_: Packed, episodes: IntArray, inputs: FloatArray
) -> None:
    """Predict one step ahead by points, which are made, predicted and projected."""
    road, filters, points = RoadArrays(*road_), Filters(*filters_), Points(*points_)
    n, width = points.states.shape[1:]
    scratch, distances = make_batch_scratch(road, width), np.empty((n, width))
    root, shift = np.empty(filters.covariances.shape[1:]), np.empty(n)
    scale = np.array([filters.density_scale, filters.density_scale * road.free_flow_speed])
    for k in range(episodes.size):
        e = episodes[k]
        mean, covariance, states = filters.means[e], filters.covariances[e], points.states[e]
        root[:] = covariance
        if not eliminate(root, n, filters.covariances.shape[2]):
            mean[:] = np.nan  # detected by the update, which resets the filter
        draw(mean, root, points.spread, scale, states)
        advance_states(road, states, inputs[k], scratch)
        project_states(road, states, filters.is_box)
        gather(points, e, scale, distances, shift, covariance)
        for i in range(n):
            covariance[i, i] += filters.process_variance[i % 2]
        mean[:] = points.centres[e]
        project(road, mean, filters.is_box)
        points.moved[e] = True


class Outputs(NamedTuple):
    """Scratch space of `update`, for m measured numbers, densities first."""

    distances: FloatArray  # (2 S, width) of the points, normalised
    outputs: FloatArray  # (S, width) distances of the speeds, or flows, measured
    shift: FloatArray  # (2 S,) weighted sums of distances
    output_shift: FloatArray  # (S,) weighted sums of outputs
    cross: FloatArray  # (2 S, padded) covariance of outputs (rows) with states, then scratch
    # (2 S, columns) rows of outputs: S, then their covariance with states, then the residual
    # in the last column
    joint: FloatArray


@njit(cache=True, error_model="numpy", nogil=True)
def update(
    road_: Packed,
    filters_: Packed,
    points_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
) -> None:
    """Update by measurements; see `Estimator.update`."""
    road, filters, points = RoadArrays(*road_), Filters(*filters_), Points(*points_)
    n, width = points.states.shape[1:]
    padded = filters.covariances.shape[2]
    segments, n_seen = np.empty(road.jam.size, dtype=np.int64), 0
    work = Outputs(
        np.empty((n, width)), np.empty((n // 2, width)), np.empty(n), np.empty(n // 2),
        np.zeros((n, padded)), np.zeros((n, 2 * padded + 8)),
    )  # fmt: skip
    scale = np.array([filters.density_scale, filters.density_scale * road.free_flow_speed])
    noise = np.array([(sigma[0] / filters.density_scale) ** 2, (sigma[1] / road.second_scale) ** 2])
    variances = np.empty(padded)
    for k in range(episodes.size):
        e = episodes[k]
        n_seen = 0
        for s in range(road.jam.size):
            if observed[k, s]:
                segments[n_seen] = s
                n_seen += 1
        filters.innovations[e] = 0.0
        sound = True
        if n_seen > 0:
            if not points.moved[e]:
                sound = _stay(road, filters, points, e, scale, work)
            sound = sound and _update_episode(
                road, filters, points, e, segments[:n_seen], values[k], noise, scale, work
            )
            points.moved[e] = False
        mean, covariance = filters.means[e], filters.covariances[e]
        filters.diverged[e] = not (
            sound and np.isfinite(mean).all() and is_covariance(covariance, variances)
        )
        if filters.diverged[e]:
            restart(filters, e)
            points.moved[e] = False


@njit(cache=True, error_model="numpy")
def _stay(
    road: RoadArrays, filters: Filters, points: Points, e: int, scale: FloatArray, work: Outputs
) -> bool:
    """Make points without a prediction, after another update in the same step."""
    n = filters.means.shape[1]
    covariance, root = filters.covariances[e], work.cross
    root[:] = covariance
    if not eliminate(root, n, filters.covariances.shape[2]):
        return False
    draw(filters.means[e], root, points.spread, scale, points.states[e])
    project_states(road, points.states[e], filters.is_box)
    gather(points, e, scale, work.distances, work.shift, covariance)
    return True


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _update_episode(
    road: RoadArrays,
    filters: Filters,
    points: Points,
    e: int,
    segments: IntArray,
    values: FloatArray,
    noise: FloatArray,
    scale: FloatArray,
    work: Outputs,
) -> bool:
    n, m, width = filters.means.shape[1], segments.size, 2 * segments.size
    mean, covariance = filters.means[e], filters.covariances[e]
    _measure(road, filters, points, e, segments, values, noise, scale, work)
    joint = work.joint
    start = (width + 7) // 8 * 8
    columns = start + n + 1
    padded = (columns + 7) // 8 * 8
    joint[:width, columns:padded] = 0.0
    for i in range(width):
        segment = segments[i % m]
        filters.innovations[e, segment, i // m] = joint[i, start + n] / np.sqrt(joint[i, i])
        if not joint[i, i] >= noise[i // m] * (1.0 - 1e-9):
            return False
    # Elimination turns [S, C, y] into [U, V, z] with U' U = S, V' V = C' S^-1 C, V' z = K y.
    if not eliminate(joint, width, padded):
        return False
    _reduce(joint, width, start, covariance)
    mirror(covariance)
    for i in range(n):
        total = 0.0
        for r in range(width):
            total += joint[r, start + i] * joint[r, start + n]
        mean[i] = points.centres[e, i] + total * scale[i % 2]
    project(road, mean, filters.is_box)
    return True


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _reduce(joint: FloatArray, width: int, start: int, covariance: FloatArray) -> None:
    """Subtract V' V from the lower half of the covariance, two rows of V at a time."""
    n = covariance.shape[0]
    for r in range(0, width - width % 2, 2):
        first, second = joint[r, start : start + n + 2], joint[r + 1, start : start + n + 2]
        for i in range(n):
            a, b = first[i], second[i]
            row = covariance[i]
            for j in range(i + 1):
                row[j] -= a * first[j] + b * second[j]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _measure(
    road: RoadArrays,
    filters: Filters,
    points: Points,
    e: int,
    segments: IntArray,
    values: FloatArray,
    noise: FloatArray,
    scale: FloatArray,
    work: Outputs,
) -> None:
    """Write the covariance S of outputs, theirs with the states, and the residuals to `joint`.

    The densities' covariance in the points is P less the step's process noise.
    """
    n, m = filters.means.shape[1], segments.size
    start = (2 * m + 7) // 8 * 8
    unit, states, joint = road.second_scale, points.states[e], work.joint
    for i in range(n):
        work.shift[i] = distances_from_first(
            states[i], scale[i % 2], points.weight, work.distances[i]
        )
    for i in range(m):
        s = segments[i]
        outputs = work.outputs[i]
        released_by_states(road, s, states[2 * s], states[2 * s + 1], outputs)
        joint[m + i, start + n] = outputs[0] / unit
        work.output_shift[i] = distances_from_first(outputs, unit, points.weight, outputs)
        joint[m + i, start + n] += work.output_shift[i]
    products(work.outputs, m, work.distances, n, False, work.cross)
    covariance = filters.covariances[e]
    q0 = filters.process_variance[0] if points.moved[e] else 0.0
    for i in range(m):
        s = segments[i]
        output_row, density_row = joint[m + i], joint[i]
        for j in range(n):
            density_row[start + j] = covariance[2 * s, j] - (q0 if j == 2 * s else 0.0)
            output_row[start + j] = (
                points.weight * work.cross[i, j]
                + points.surplus * work.output_shift[i] * work.shift[j]
            )
        density_row[start + n] = (values[s, 0] - points.centres[e, 2 * s]) / scale[0]
        output_row[start + n] = values[s, 1] / unit - output_row[start + n]
    products(work.outputs, m, work.outputs, m, True, work.cross)
    for i in range(m):
        for j in range(i + 1):
            spread = points.surplus * work.output_shift[i] * work.output_shift[j]
            joint[m + j, m + i] = points.weight * work.cross[i, j] + spread
        joint[m + i, m + i] += noise[1]
    for i in range(m):
        for j in range(m):
            joint[i, j] = joint[i, start + 2 * segments[j]]
            joint[i, m + j] = joint[m + j, start + 2 * segments[i]]
        joint[i, i] += noise[0]
