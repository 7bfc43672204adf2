"""Compiled kernels of the schedules that use the estimator's covariance, episode by episode."""

import numpy as np

from dptse_env.model.network import RoadArrays
from dptse_env.model.step import make_scratch
from dptse_env.schedules.covariance_kernels import (
    Problem,
    Work,
    condition,
    downdate,
    hold_speeds,
    look_ahead,
    make_work,
    to_traffic,
)
from dptse_env.utils.arrays import BoolArray, FloatArray
from dptse_env.utils.kernel_loops import copy_matrix
from dptse_env.utils.kernels import Packed, kernel, kernel_part


@kernel
def choose_greedily(
    road_: Packed,
    problem_: Packed,
    keeps: bool,
    means: FloatArray,
    covariances: FloatArray,
    inputs: FloatArray,
    queried: BoolArray,
) -> None:
    """Pick segments in turn, for k episodes.

    Args:
        road_: The `RoadArrays`.
        problem_: The `Problem`.
        keeps: Whether to replace `covariances` by those after the coming step.
        means: Present states, shape (k, 2 S) [veh/km, veh/h].
        covariances: Their normalised covariances, shape (k, 2 S, 2 S).
        inputs: The model's inputs of the coming step, shape (k, n_u).
        queried: Output, the sets, shape (k, n_mainline).
    """
    road, problem = RoadArrays(*road_), Problem(*problem_)
    work = make_work(road, problem)
    scratch = make_scratch(road)
    for k in range(means.shape[0]):
        look_ahead(road, problem, means[k], covariances[k], inputs[k], work, scratch)
        condition(problem, problem.always, work.covariance, work)
        to_traffic(problem, work.covariance, work)
        hold_speeds(problem, work)
        pick(problem, work, queried[k])
        if keeps:
            condition(problem, np.flatnonzero(queried[k]), work.covariance, work)
            copy_matrix(work.covariance, covariances[k])


@kernel_part
def pick(problem: Problem, work: Work, queried: BoolArray) -> None:
    """Pick B segments, each with the largest gain given those before."""
    n, bandwidth, can_query, noise = (
        problem.n_mainline, problem.bandwidth, problem.can_query, problem.noise,
    )  # fmt: skip
    traffic, rows, weights, vectors = (
        work.traffic, work.traffic_rows, work.weights, work.vectors,
    )  # fmt: skip
    queried[:] = False
    for i in range(bandwidth):
        if i >= can_query.size:
            _fill_up(bandwidth - i, queried)
            return
        best, largest = -1, -np.inf
        for j in range(can_query.size):
            s = can_query[j]
            if not queried[s]:
                gain = _gain(n, s, traffic, rows, weights, noise)
                if gain > largest or best < 0:
                    best, largest = s, gain
        queried[best] = True
        if i + 1 < bandwidth:
            by_both = (rows[best, 1], rows[best, 2])
            downdate(traffic, best, n + best, rows[best, 0], by_both, noise, vectors)


@kernel_part
def _fill_up(n_left: int, queried: BoolArray) -> None:
    """Use remaining bandwidth on segments with a fixed sensor, without gain."""
    for s in range(queried.size):
        if n_left > 0 and not queried[s]:
            queried[s] = True
            n_left -= 1


@kernel_part(fastmath={"contract", "reassoc"})
def _products(
    n: int, s: int, traffic: FloatArray, weights: FloatArray
) -> tuple[float, float, float]:
    """Return weighted sums of squares and of products of a segment's two rows of C."""
    xx = xy = yy = 0.0
    for j in range(2 * n):
        x, y = traffic[s, j], traffic[n + s, j]
        w = weights[j] * x
        xx += w * x
        xy += w * y
        yy += weights[j] * y * y
    return xx, xy, yy


@kernel_part
def _gain(
    n: int,
    s: int,
    traffic: FloatArray,
    rows: FloatArray,
    weights: FloatArray,
    noise: FloatArray,
) -> float:
    """Return by how much a query of a segment reduces the weighted trace.

    Arrays are separate arguments: reference counts of a tuple would take more time than the
    arithmetic.
    """
    f, a, b = rows[s, 0], rows[s, 1], rows[s, 2]
    x, y, z = traffic[s, s], traffic[s, n + s], traffic[n + s, n + s]
    s11 = f * f * x + noise[0]
    s12 = f * (a * x + b * y)
    s22 = a * a * x + 2.0 * a * b * y + b * b * z + noise[1]
    left = s22 - s12 * s12 / s11
    xx, xy, yy = _products(n, s, traffic, weights)
    g11, g12 = f * f * xx, f * (a * xx + b * xy)
    g22 = a * a * xx + 2.0 * a * b * xy + b * b * yy
    ratio = s12 / s11
    return float(g11 / s11 + (g22 - 2.0 * ratio * g12 + ratio * ratio * g11) / left)
