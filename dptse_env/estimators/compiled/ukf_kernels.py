"""Compiled kernels of the unscented Kalman filter: a batch of episodes, one after the other.

With d_i the points' distances from the first one, d = W sum d_i and W the weight of all points
but the first, the weighted covariance is `W sum d_i d_i' + (beta - alpha^2) d d'`: the large
negative weights of the first point cancel, nothing is lost to rounding, and what the points say
of a state and its measurement is a covariance by construction, projected or not.

The points of a step carry the process noise of earlier steps, not its own: P gets Q after they
have moved, and the next points are drawn from that. On a linear system this is the Kalman filter
of x' = F (x + w), noise ahead of the motion. Adding the derivative's `H Q H'` to what is measured
would put it behind; on synthetic traffic that filter amplified rounding far more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from dptse_env.estimators.compiled.algebra import is_covariance, mirror
from dptse_env.estimators.compiled.kernels import Filters, Packed, project, restart
from dptse_env.estimators.compiled.swarm import (
    advance_swarm,
    flock_of,
    measured_speeds,
    project_swarm,
)
from dptse_env.model.network import BoolArray, FloatArray, IntArray
from dptse_env.model.road import Road


class Points(NamedTuple):
    """Sigma points of n episodes.

    Attributes:
        swarms: `(n, 2 S, width)` projected points after the last motion [veh/km, veh/h]; the
            mean's image first, then pairs; columns beyond 4 S + 1 repeat the first.
        centres: `(n, 2 S)` their weighted means, before any projection.
        moved: `(n,)` whether they moved since they last took in a measurement.
        weight: W of every point but the first.
        surplus: beta - alpha^2.
        spread: Points are the mean plus and minus `spread` times columns of a root of P.
    """

    swarms: FloatArray
    centres: FloatArray
    moved: BoolArray
    weight: float
    surplus: float
    spread: float


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def factor(matrix: FloatArray, n: int) -> bool:
    """Replace the upper half of a symmetric `(n, width)` matrix by U with U' U = matrix.

    Returns:
        Whether all pivots were positive.
    """
    width = matrix.shape[1]
    for k in range(n):
        pivot = matrix[k, k]
        if not 0.0 < pivot < np.inf:
            return False
        inverse = 1.0 / np.sqrt(pivot)
        start = k // 8 * 8
        for j in range(start, width):
            matrix[k, j] *= inverse
        for i in range(k + 1, n):
            head = matrix[k, i]
            start = i // 8 * 8
            for j in range(start, width):
                matrix[i, j] -= head * matrix[k, j]
    return True


@njit(cache=True, error_model="numpy")
def _draw(
    mean: FloatArray, root: FloatArray, spread: float, scale: FloatArray, swarm: FloatArray
) -> None:
    """Write the points of a mean and the upper root of its covariance."""
    n = mean.size
    for i in range(n):
        row, centre = swarm[i], mean[i]
        row[:] = centre
        step = spread * scale[i % 2]
        for k in range(i + 1):
            shift = step * root[k, i]
            row[1 + k] += shift
            row[1 + n + k] -= shift


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _distances(row: FloatArray, scale: float, weight: float, out: FloatArray) -> float:
    """Write normalised distances from the first point and return their weighted sum."""
    first, inverse, total = row[0], 1.0 / scale, 0.0
    for j in range(row.size):
        out[j] = (row[j] - first) * inverse
        total += out[j]
    return weight * total


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def products(
    left: FloatArray, n_left: int, right: FloatArray, n_right: int, is_lower: bool, out: FloatArray
) -> None:
    """Write inner products of rows; where `is_lower`, those up to the diagonal and a few more."""
    width = left.shape[1]
    for i in range(0, n_left, 2):
        a0, a1 = left[i], left[min(i + 1, n_left - 1)]
        last = min(i + 2, n_right) if is_lower else n_right
        for j in range(0, last, 2):
            b0, b1 = right[j], right[min(j + 1, n_right - 1)]
            s00 = s01 = s10 = s11 = 0.0
            for k in range(width):
                s00 += a0[k] * b0[k]
                s01 += a0[k] * b1[k]
                s10 += a1[k] * b0[k]
                s11 += a1[k] * b1[k]
            out[i, j] = s00
            if j + 1 < n_right:
                out[i, j + 1] = s01
            if i + 1 < n_left:
                out[i + 1, j] = s10
                if j + 1 < n_right:
                    out[i + 1, j + 1] = s11


@njit(cache=True, error_model="numpy")
def predict(
    road_: Packed, filters_: Packed, points_: Packed, episodes: IntArray, inputs: FloatArray
) -> None:
    """Move episodes one step ahead: draw points, move and project them, then mean and P."""
    road, filters, points = Road(*road_), Filters(*filters_), Points(*points_)
    n, width = points.swarms.shape[1:]
    flock, distances = flock_of(road, width), np.empty((n, width))
    root, shift = np.empty(filters.covariances.shape[1:]), np.empty(n)
    scale = np.array([filters.density_scale, filters.density_scale * road.free_flow_speed])
    for k in range(episodes.size):
        e = episodes[k]
        mean, covariance, swarm = filters.means[e], filters.covariances[e], points.swarms[e]
        root[:] = covariance
        if not factor(root, n):
            mean[:] = np.nan  # the update finds it and starts over
        _draw(mean, root, points.spread, scale, swarm)
        advance_swarm(road, swarm, inputs[k], flock)
        project_swarm(road, swarm, filters.is_box)
        _gather(points, e, scale, distances, shift, covariance)
        for i in range(n):
            covariance[i, i] += filters.process_variance[i % 2]
        mean[:] = points.centres[e]
        project(road, mean, filters.is_box)
        points.moved[e] = True


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _gather(
    points: Points,
    e: int,
    scale: FloatArray,
    distances: FloatArray,
    shift: FloatArray,
    covariance: FloatArray,
) -> None:
    """Write mean and covariance of one episode's points."""
    swarm, n = points.swarms[e], shift.size
    for i in range(n):
        shift[i] = _distances(swarm[i], scale[i % 2], points.weight, distances[i])
        points.centres[e, i] = swarm[i, 0] + shift[i] * scale[i % 2]
    products(distances, n, distances, n, True, covariance)
    for i in range(n):
        for j in range(i + 1):
            covariance[i, j] = (
                points.weight * covariance[i, j] + points.surplus * shift[i] * shift[j]
            )
    mirror(covariance)


class Outputs(NamedTuple):
    """Working space of `update`: what is measured, m numbers, densities first.

    Attributes:
        distances: `(2 S, width)` of the points, normalised.
        speeds: `(S, width)` distances of the speeds measured.
        shift: `(2 S,)` weighted sums of `distances`.
        speed_shift: `(S,)` weighted sums of `speeds`.
        cross: `(2 S, padded)` covariance of speeds (rows) with states, then scratch.
        joint: `(2 S, columns)` rows of outputs: S, then their covariance with states, then the
            residual in the last column.
    """

    distances: FloatArray
    speeds: FloatArray
    shift: FloatArray
    speed_shift: FloatArray
    cross: FloatArray
    joint: FloatArray


@njit(cache=True, error_model="numpy")
def update(
    road_: Packed,
    filters_: Packed,
    points_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
) -> None:
    """Take in measurements; see `Estimator.update`."""
    road, filters, points = Road(*road_), Filters(*filters_), Points(*points_)
    n, width = points.swarms.shape[1:]
    padded = filters.covariances.shape[2]
    segments, n_seen = np.empty(road.jam.size, dtype=np.int64), 0
    work = Outputs(
        np.empty((n, width)), np.empty((n // 2, width)), np.empty(n), np.empty(n // 2),
        np.zeros((n, padded)), np.zeros((n, 2 * padded + 8)),
    )  # fmt: skip
    scale = np.array([filters.density_scale, filters.density_scale * road.free_flow_speed])
    noise = np.array(
        [(sigma[0] / filters.density_scale) ** 2, (sigma[1] / road.free_flow_speed) ** 2]
    )
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
            sound = sound and _take_in(
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
    road: Road, filters: Filters, points: Points, e: int, scale: FloatArray, work: Outputs
) -> bool:
    """Draw points where nothing has moved since the last measurement: a motion by nothing."""
    n = filters.means.shape[1]
    covariance, root = filters.covariances[e], work.cross
    root[:] = covariance
    if not factor(root, n):
        return False
    _draw(filters.means[e], root, points.spread, scale, points.swarms[e])
    project_swarm(road, points.swarms[e], filters.is_box)
    _gather(points, e, scale, work.distances, work.shift, covariance)
    return True


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _take_in(
    road: Road,
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
    if not factor(joint[:width, :padded], width):
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
    """Take V' V from the lower half of the covariance, two rows of V at a time."""
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
    road: Road,
    filters: Filters,
    points: Points,
    e: int,
    segments: IntArray,
    values: FloatArray,
    noise: FloatArray,
    scale: FloatArray,
    work: Outputs,
) -> None:
    """Write the outputs' covariance S, theirs with the states, and the residuals to `joint`.

    Densities among themselves: the covariance of the points is P less the step's process noise.
    """
    n, m = filters.means.shape[1], segments.size
    start = (2 * m + 7) // 8 * 8
    v_f, swarm, joint = road.free_flow_speed, points.swarms[e], work.joint
    for i in range(n):
        work.shift[i] = _distances(swarm[i], scale[i % 2], points.weight, work.distances[i])
    for i in range(m):
        s = segments[i]
        speeds = work.speeds[i]
        measured_speeds(swarm[2 * s], swarm[2 * s + 1], road.jam[s], v_f, road.gamma, speeds)
        joint[m + i, start + n] = speeds[0] / v_f
        work.speed_shift[i] = _distances(speeds, v_f, points.weight, speeds)
        joint[m + i, start + n] += work.speed_shift[i]
    products(work.speeds, m, work.distances, n, False, work.cross)
    covariance = filters.covariances[e]
    q0 = filters.process_variance[0] if points.moved[e] else 0.0
    for i in range(m):
        s = segments[i]
        speed_row, density_row = joint[m + i], joint[i]
        for j in range(n):
            density_row[start + j] = covariance[2 * s, j] - (q0 if j == 2 * s else 0.0)
            speed_row[start + j] = (
                points.weight * work.cross[i, j]
                + points.surplus * work.speed_shift[i] * work.shift[j]
            )
        density_row[start + n] = (values[s, 0] - points.centres[e, 2 * s]) / scale[0]
        speed_row[start + n] = values[s, 1] / v_f - speed_row[start + n]
    products(work.speeds, m, work.speeds, m, True, work.cross)
    for i in range(m):
        for j in range(i + 1):
            spread = points.surplus * work.speed_shift[i] * work.speed_shift[j]
            joint[m + j, m + i] = points.weight * work.cross[i, j] + spread
        joint[m + i, m + i] += noise[1]
    for i in range(m):
        for j in range(m):
            joint[i, j] = joint[i, start + 2 * segments[j]]
            joint[i, m + j] = joint[m + j, start + 2 * segments[i]]
        joint[i, i] += noise[0]
