"""Compiled outputs of sigma points: what they measure, and its covariance with the states.

The numbers of m measured rows are ordered densities first, then speeds or flows.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.compiled.dense import products
from dptse_env.estimators.compiled.ekf_kernels import Filters
from dptse_env.estimators.compiled.sigma_points import Points, distances_from_first
from dptse_env.model.columns import released_by_states
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernels import kernel_part


class Outputs(NamedTuple):
    """Scratch space of `update`, for m of M rows that are measured."""

    distances: FloatArray  # (n_x, width) of the points, normalised
    outputs: FloatArray  # (M, width) distances of the speeds, or flows, measured
    flow: FloatArray  # (width,) of one of a row's segments [veh/h]
    shift: FloatArray  # (n_x,) weighted sums of distances
    output_shift: FloatArray  # (M,) weighted sums of outputs
    # (M, larger of n_x and M) inner products of outputs (rows) with states, then with outputs
    cross: FloatArray
    # (2 M, columns) rows of outputs: S, then their covariance with states, then the residual
    # in the last column
    joint: FloatArray
    noise: FloatArray  # (M, 2) variances of the noise in both numbers, normalised


@kernel_part
def first_column(m: int) -> int:
    """Return the column of `Outputs.joint` where the covariances with the states begin."""
    return (2 * m + 7) // 8 * 8


@kernel_part
def make_outputs(n_rows: int, n_states: int, width: int) -> Outputs:
    """Allocate the scratch space of `update` for points `(n_states, width)`."""
    # An odd number of cache lines, so that the numbers of a column lie in different cache sets.
    columns = ((first_column(n_rows) + n_states + 8) // 8 | 1) * 8
    return Outputs(
        np.empty((n_states, width)), np.empty((n_rows, width)), np.empty(width),
        np.empty(n_states), np.empty(n_rows), np.empty((n_rows, max(n_states, n_rows))),
        np.zeros((2 * n_rows, columns)), np.empty((n_rows, 2)),
    )  # fmt: skip


@kernel_part
def row_noise(
    road: RoadArrays,
    filters: Filters,
    e: int,
    rows: IntArray,
    sigma: FloatArray,
    noise: FloatArray,
) -> None:
    """Write the variances of the noise in the rows that are measured."""
    scale, unit = filters.density_scale, road.second_scale
    for i in range(rows.size):
        r = rows[i]
        noise[i, 0], noise[i, 1] = (sigma[r, 0] / scale) ** 2, (sigma[r, 1] / unit) ** 2
        if filters.count_variance[r] > 0.0:
            density = _average(filters.means, e, 2 * road.row_first[r], road.row_span[r])
            noise[i, 0] += filters.count_variance[r] * density / road.row_span[r]


@kernel_part(kept=True, fastmath={"contract"})
def measure(
    road: RoadArrays,
    filters: Filters,
    points: Points,
    e: int,
    rows: IntArray,
    values: FloatArray,
    centre: FloatArray,
    work: Outputs,
) -> None:
    """Write the covariance S of outputs, theirs with the states, and the residuals to `joint`.

    The numbers of a row are averages over its segments, and linear in what each of these releases:
    averages of the points' flows, and of the densities' covariances in the points.
    """
    n, m = filters.means.shape[1], rows.size
    start = first_column(m)
    scale, unit, states, joint = points.scale, road.second_scale, points.states[e], work.joint
    for i in range(n):
        work.shift[i] = distances_from_first(states[i], scale[i], points.weight, work.distances[i])
    for i in range(m):
        s, outputs = road.row_first[rows[i]], work.outputs[i]
        released_by_states(road, s, states[2 * s], states[2 * s + 1], centre[s], outputs)
        if road.row_span[rows[i]] > 1:
            _add_flows(road, rows[i], states, centre, work.flow, outputs)
        joint[m + i, start + n] = outputs[0] / unit
        work.output_shift[i] = distances_from_first(outputs, unit, points.weight, outputs)
        joint[m + i, start + n] += work.output_shift[i]
    products(work.outputs, m, work.distances, n, False, work.cross)
    covariance = filters.covariances[e]
    for i in range(m):
        first, span = road.row_first[rows[i]], road.row_span[rows[i]]
        output_row, density_row = joint[m + i], joint[i]
        _density_row(points, covariance, e, first, span, density_row[start:])
        for j in range(n):
            output_row[start + j] = (
                points.weight * work.cross[i, j]
                + points.surplus * work.output_shift[i] * work.shift[j]
            )
        density = _average(points.centres, e, 2 * first, span)
        density_row[start + n] = (values[rows[i], 0] - density) / scale[0]
        output_row[start + n] = values[rows[i], 1] / unit - output_row[start + n]
    products(work.outputs, m, work.outputs, m, True, work.cross)
    for i in range(m):
        for j in range(i + 1):
            spread = points.surplus * work.output_shift[i] * work.output_shift[j]
            joint[m + j, m + i] = points.weight * work.cross[i, j] + spread
        joint[m + i, m + i] += work.noise[i, 1]
    _average_densities(road.row_first, road.row_span, rows, start, joint)
    for i in range(m):
        joint[i, i] += work.noise[i, 0]


@kernel_part
def _average_densities(
    row_first: IntArray, row_span: IntArray, rows: IntArray, start: int, joint: FloatArray
) -> None:
    """Write the upper half of what S has of densities, from the covariances with the states."""
    m = rows.size
    for j in range(m):
        column, span = start + 2 * row_first[rows[j]], row_span[rows[j]]
        if span == 1:
            for i in range(j + 1):
                joint[i, j] = joint[i, column]
            for i in range(m):
                joint[j, m + i] = joint[m + i, column]
        else:
            for i in range(j + 1):
                joint[i, j] = _average(joint, i, column, span)
            for i in range(m):
                joint[j, m + i] = _average(joint, m + i, column, span)


@kernel_part(fastmath={"contract"})
def _add_flows(
    road: RoadArrays,
    row: int,
    states: FloatArray,
    centre: FloatArray,
    flow: FloatArray,
    out: FloatArray,
) -> None:
    """Turn the flows [veh/h] of a row's first segment, for every point, into the row's average."""
    first, span = road.row_first[row], road.row_span[row]
    for s in range(first + 1, first + span):
        released_by_states(road, s, states[2 * s], states[2 * s + 1], centre[s], flow)
        for j in range(out.size):
            out[j] += flow[j]
    for j in range(out.size):
        out[j] /= span


@kernel_part(fastmath={"contract"})
def _density_row(
    points: Points, covariance: FloatArray, e: int, first: int, span: int, out: FloatArray
) -> None:
    """Write the covariance of a row's average density with the states `(n_x,)`, in the points.

    That is P less the step's process noise, which the points do not have.
    """
    n, noise = covariance.shape[0], points.noise[e]
    for j in range(n):
        out[j] = covariance[2 * first, j]
    out[2 * first] -= noise[2 * first]
    if span == 1:
        return
    for s in range(first + 1, first + span):
        for j in range(n):
            out[j] += covariance[2 * s, j]
        out[2 * s] -= noise[2 * s]
    for j in range(n):
        out[j] /= span


@kernel_part
def _average(table: FloatArray, i: int, column: int, span: int) -> float:
    """Return the average over adjacent segments of numbers in row i, of the first in `column`."""
    total = table[i, column]
    for k in range(1, span):
        total += table[i, column + 2 * k]
    return float(total / span)
