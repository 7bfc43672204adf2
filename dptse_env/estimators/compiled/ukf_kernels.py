"""Compiled kernels of the unscented Kalman filter, episode by episode.

The points of a step include the process noise of earlier steps only: Q is added to P after their
prediction, and the next points are made from that. On a linear system this is the Kalman filter of
x' = F (x + w), with noise before the motion. Adding the derivative's `H Q H'` to the covariance of
measurements would place it after the motion; on recorded traffic that filter is no better, and much
worse at small alpha.
"""

import numpy as np

from dptse_env.estimators.compiled.algebra import is_covariance, mirror
from dptse_env.estimators.compiled.dense import eliminate
from dptse_env.estimators.compiled.ekf_kernels import (
    Filters,
    Packed,
    process_noise,
    restart,
)
from dptse_env.estimators.compiled.sigma_points import Points, draw, gather
from dptse_env.estimators.compiled.ukf_outputs import (
    Outputs,
    first_column,
    make_outputs,
    measure,
    row_noise,
)
from dptse_env.model.columns import (
    advance_states,
    make_batch_scratch,
    project_states,
)
from dptse_env.model.network import RoadArrays
from dptse_env.model.step import project
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernel_loops import all_finite, copy_matrix, copy_vector
from dptse_env.utils.kernels import kernel, kernel_part


@kernel
def predict(
    road_: Packed, filters_: Packed, points_: Packed, episodes: IntArray, inputs: FloatArray
) -> None:
    """Predict one step ahead by points, which are made, predicted and projected."""
    road, filters, points = RoadArrays(*road_), Filters(*filters_), Points(*points_)
    n, width = points.states.shape[1:]
    scratch, distances = make_batch_scratch(road, width), np.empty((n, width))
    root, shift = np.empty(filters.covariances.shape[1:]), np.empty(n)
    for k in range(episodes.size):
        e = episodes[k]
        mean, covariance, states = filters.means[e], filters.covariances[e], points.states[e]
        copy_matrix(covariance, root)
        if not eliminate(root, n, filters.covariances.shape[2]):
            mean[:] = np.nan  # detected by the update, which resets the filter
        process_noise(road, filters, mean, points.noise[e])
        draw(points, e, mean, root)
        advance_states(road, states, inputs[k], scratch)
        project_states(road, states, filters.is_box)
        gather(points, e, distances, shift, covariance)
        copy_vector(points.centres[e], mean)
        project(road, mean, filters.is_box)
        for i in range(n):
            covariance[i, i] += points.noise[e, i]
        points.moved[e] = True


@kernel
def update(
    road_: Packed,
    filters_: Packed,
    points_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
) -> None:
    """Update by measurements; see `Estimator.update`."""
    road, filters, points = RoadArrays(*road_), Filters(*filters_), Points(*points_)
    n_rows = road.row_first.size
    work = make_outputs(n_rows, *points.states.shape[1:])
    rows, variances = np.empty(n_rows, dtype=np.int64), np.empty(filters.covariances.shape[2])
    for k in range(episodes.size):
        e = episodes[k]
        n_seen = 0
        for r in range(n_rows):
            if observed[k, r]:
                rows[n_seen] = r
                n_seen += 1
        filters.innovations[e] = 0.0
        sound = True
        if n_seen > 0:
            seen = rows[:n_seen]
            row_noise(road, filters, e, seen, sigma[k], work.noise)
            if not points.moved[e]:
                sound = _stay(road, filters, points, e, work)
            sound = sound and _update_episode(
                road, filters, points, e, seen, values[k], centre[k], work
            )
            points.moved[e] = False
        mean, covariance = filters.means[e], filters.covariances[e]
        filters.diverged[e] = not (
            sound and all_finite(mean) and is_covariance(covariance, variances)
        )
        if filters.diverged[e]:
            restart(filters, e)
            points.moved[e] = False


@kernel_part(kept=True)
def _stay(road: RoadArrays, filters: Filters, points: Points, e: int, work: Outputs) -> bool:
    """Make points without a prediction, after another update in the same step."""
    covariance = filters.covariances[e]
    root = covariance.copy()
    if not eliminate(root, root.shape[0], root.shape[1]):
        return False
    draw(points, e, filters.means[e], root)
    project_states(road, points.states[e], filters.is_box)
    gather(points, e, work.distances, work.shift, covariance)
    points.noise[e] = 0.0
    return True


@kernel_part(kept=True, fastmath={"contract"})
def _update_episode(
    road: RoadArrays,
    filters: Filters,
    points: Points,
    e: int,
    rows: IntArray,
    values: FloatArray,
    centre: FloatArray,
    work: Outputs,
) -> bool:
    n, m, width = filters.means.shape[1], rows.size, 2 * rows.size
    mean, covariance = filters.means[e], filters.covariances[e]
    measure(road, filters, points, e, rows, values, centre, work)
    joint, noise = work.joint, work.noise
    start = first_column(m)
    columns = start + n + 1
    padded = (columns + 7) // 8 * 8
    joint[:width, columns:padded] = 0.0
    for i in range(width):
        variance = joint[i, i]
        filters.innovations[e, rows[i % m], i // m] = joint[i, start + n] / np.sqrt(variance)
        if not variance >= noise[i % m, i // m] * (1.0 - 1e-9):
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
        mean[i] = points.centres[e, i] + total * points.scale[i]
    project(road, mean, filters.is_box)
    return True


@kernel_part(fastmath={"contract"})
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
