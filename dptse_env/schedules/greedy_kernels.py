"""Compiled kernels of the schedules that use the estimator's covariance, episode by episode."""

import numpy as np

from dptse_env.estimators.compiled.ekf_kernels import Packed
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
    step,
    to_traffic,
)
from dptse_env.utils.arrays import BoolArray, FloatArray
from dptse_env.utils.kernel_loops import copy_matrix, copy_vector
from dptse_env.utils.kernels import kernel, kernel_part

TRACE, LOGDET = 0, 1


@kernel
def choose_greedily(
    road_: Packed,
    problem_: Packed,
    criterion: int,
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
        criterion: TRACE or LOGDET.
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
        pick(problem, criterion, work, queried[k])
        if keeps:
            condition(problem, np.flatnonzero(queried[k]), work.covariance, work)
            copy_matrix(work.covariance, covariances[k])


@kernel_part
def pick(problem: Problem, criterion: int, work: Work, queried: BoolArray) -> None:
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
                gain = _gain(n, criterion, s, traffic, rows, weights, noise)
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
    criterion: int,
    s: int,
    traffic: FloatArray,
    rows: FloatArray,
    weights: FloatArray,
    noise: FloatArray,
) -> float:
    """Reduction of the weighted trace, or of the log determinant, by querying a segment.

    Arrays are separate arguments: reference counts of a tuple would take more time than the
    arithmetic.
    """
    f, a, b = rows[s, 0], rows[s, 1], rows[s, 2]
    x, y, z = traffic[s, s], traffic[s, n + s], traffic[n + s, n + s]
    s11 = f * f * x + noise[0]
    s12 = f * (a * x + b * y)
    s22 = a * a * x + 2.0 * a * b * y + b * b * z + noise[1]
    left = s22 - s12 * s12 / s11
    if criterion == LOGDET:
        return float(np.log(s11 * left / (noise[0] * noise[1])))
    xx, xy, yy = _products(n, s, traffic, weights)
    g11, g12 = f * f * xx, f * (a * xx + b * xy)
    g22 = a * a * xx + 2.0 * a * b * xy + b * b * yy
    ratio = s12 / s11
    return float(g11 / s11 + (g22 - 2.0 * ratio * g12 + ratio * ratio * g11) / left)


@kernel
def choose_by_swaps(
    road_: Packed,
    problem_: Packed,
    horizon: int,
    means: FloatArray,
    covariances: FloatArray,
    inputs: FloatArray,
    queried: BoolArray,
) -> None:
    """Pick greedily by the trace, then choose the best of all single swaps over a horizon.

    Arguments are those of `choose_greedily`, and the horizon in steps, including the coming one.
    `covariances` are always replaced by those after the coming step.
    """
    road, problem = RoadArrays(*road_), Problem(*problem_)
    work, after = make_work(road, problem), np.empty(covariances.shape[1:])
    scratch, ahead, best = make_scratch(road), np.empty_like(after), np.empty_like(after)
    for k in range(means.shape[0]):
        look_ahead(road, problem, means[k], covariances[k], inputs[k], work, scratch)
        condition(problem, problem.always, work.covariance, work)
        copy_matrix(work.covariance, ahead)
        to_traffic(problem, ahead, work)
        hold_speeds(problem, work)
        pick(problem, TRACE, work, queried[k])
        base = queried[k].copy()
        least = _roll_out(road, problem, horizon, base, ahead, after, best, work)
        for out in np.flatnonzero(base):
            for s in problem.can_query:
                if base[s]:
                    continue
                tried = base.copy()
                tried[out], tried[s] = False, True
                value = _roll_out(
                    road, problem, horizon, tried, ahead, after, work.covariance, work
                )
                if value < least:
                    least = value
                    copy_vector(tried, queried[k])
                    copy_matrix(work.covariance, best)
        copy_matrix(best, covariances[k])


@kernel_part
def _roll_out(
    road: RoadArrays,
    problem: Problem,
    horizon: int,
    queried: BoolArray,
    ahead: FloatArray,
    after: FloatArray,
    first: FloatArray,
    work: Work,
) -> float:
    """Return the sum of weighted traces over the horizon; write the coming step's P to `first`."""
    copy_matrix(ahead, after)
    condition(problem, np.flatnonzero(queried), after, work)
    copy_matrix(after, first)
    total = _spread(problem, after, work)
    for _ in range(horizon - 1):
        step(road, problem, after, work)
        condition(problem, problem.always, after, work)
        _spread(problem, after, work)
        # Afterwards segments are queried by the largest weighted variance.
        for _ in range(min(problem.bandwidth, problem.can_query.size)):
            best, largest = -1, -np.inf
            for s in problem.can_query:
                if work.sums[0, s] > largest:
                    best, largest = s, work.sums[0, s]
            work.sums[0, best] = -np.inf
            work.sums[1, best] = 1.0
        condition(problem, np.flatnonzero(work.sums[1]), after, work)
        total += _spread(problem, after, work)
    return total


@kernel_part
def _spread(problem: Problem, covariance: FloatArray, work: Work) -> float:
    """Return the weighted trace; write each segment's share of it, and zeros, to `work.sums`."""
    n, d, total = problem.n_mainline, 1.0 / problem.units[0], 0.0
    for s in range(n):
        p, q = work.to_speed[s, 0], work.to_speed[s, 1]
        x, y = covariance[2 * s, 2 * s], covariance[2 * s, 2 * s + 1]
        speed = p * p * x + 2.0 * p * q * y + q * q * covariance[2 * s + 1, 2 * s + 1]
        work.sums[0, s] = work.weights[s] * d * d * x + work.weights[n + s] * speed
        work.sums[1, s] = 0.0
        total += work.sums[0, s]
    return total
