"""Compiled kernels that propagate and update the estimator's covariance over the coming second.

They treat episodes one by one, as in `dptse_env.estimators.compiled`. States are normalised: rho by
rho_m, psi by rho_m v_f. Over the mainline, traffic is in the reward's units: all densities, then
all speeds. A segment's releases depend on that segment alone, so that its row in either coordinates
has two entries.
"""

from typing import Any, NamedTuple

import numpy as np

from dptse_env.estimators.compiled.algebra import propagate
from dptse_env.model.network import RoadArrays
from dptse_env.model.step import advance, measured, project, released
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.kernel_loops import copy_matrix, copy_vector
from dptse_env.utils.kernels import kernel_part


class Problem(NamedTuple):
    """Constants of a road and an estimator, for compiled code."""

    n_mainline: int  # n
    bandwidth: int  # B
    always: IntArray  # (F,) segments with a fixed sensor
    can_query: IntArray  # (A,) mainline segments without a fixed sensor
    noise: FloatArray  # (2,) variances of both releases, normalised
    centre: float  # v_0 of released flows [km/h], NaN where speeds are released
    # (2 S,) of a step: of rho and psi, normalised, or for a random walk of rho / rho_m and v / v_f
    process_variance: FloatArray
    is_walk: bool  # whether the estimator is a random walk
    is_box: bool  # whether means are projected into the box, not the cone
    density_scale: float  # rho_m [veh/km]
    units: FloatArray  # (2,) scales of the reward over rho_m and v_f
    term_weights: FloatArray  # (2,) weights of density and speed in the reward
    # (n_mainline,) lengths [km] if speeds are weighted by the probability of a vehicle, else (0,)
    lengths: FloatArray
    speed_cap: float  # largest deviation of a speed that counts, in the reward's units


class Work(NamedTuple):
    """Scratch space of an episode."""

    mean: FloatArray  # (2 S,) predicted state [veh/km, veh/h]
    blocks: FloatArray  # (S, K, 4) blocks of F
    covariance: FloatArray  # (2 S, 2 S)
    product: FloatArray  # (2 S, 2 S)
    transposed: FloatArray  # (2 S, 2 S)
    rows: FloatArray  # (S, 2) derivatives of the second release by the segment's rho and psi
    traffic: FloatArray  # (2 n, 2 n) covariance of density and speed over the mainline
    weights: FloatArray  # (2 n,) weights of their variances
    # (S, 2) derivatives of a speed by rho and psi, in the reward's units
    to_speed: FloatArray
    # (n, 3) derivatives of the first release by density, and of the second by density and speed,
    # in the reward's units
    traffic_rows: FloatArray
    vectors: FloatArray  # (2, 2 S)


@kernel_part
def make_work(road: RoadArrays, problem: Problem) -> Work:
    """Allocate the scratch space."""
    s, n = road.jam.size, problem.n_mainline
    square = np.empty((3, 2 * s, 2 * s))
    return Work(
        np.empty(2 * s), np.zeros((*road.neighbours.shape, 4)), square[0], square[1], square[2],
        np.empty((s, 2)), np.empty((2 * n, 2 * n)), np.empty(2 * n), np.empty((s, 2)),
        np.empty((n, 3)), np.empty((2, 2 * s)),
    )  # fmt: skip


@kernel_part
def look_ahead(
    road: RoadArrays,
    problem: Problem,
    mean: FloatArray,
    covariance: FloatArray,
    inputs: FloatArray,
    work: Work,
    scratch: Any,
) -> None:
    """Predict one step, x = f(x, u), P = F P F' + Q, and linearise releases and reward there."""
    copy_matrix(covariance, work.covariance)
    if problem.is_walk:
        copy_vector(mean, work.mean)
        _linearise(road, problem, work)
        drift(problem, work.covariance, work)
    else:
        copy_vector(mean, work.mean)
        advance(road, work.mean, inputs, work.mean, work.blocks, scratch)
        project(road, work.mean, problem.is_box)
        for s in range(work.blocks.shape[0]):
            for slot in range(work.blocks.shape[1]):
                work.blocks[s, slot, 1] *= road.free_flow_speed
                work.blocks[s, slot, 2] /= road.free_flow_speed
        noise, no_factors = problem.process_variance, np.empty((0, 2))
        propagate(
            road, work.blocks, no_factors, noise, work.covariance, work.product, work.transposed
        )
        _linearise(road, problem, work)


@kernel_part
def drift(problem: Problem, covariance: FloatArray, work: Work) -> None:
    """Add a random walk of density and speed: T^-1 Q T^-T to each segment's block."""
    for s in range(work.rows.shape[0]):
        # T = [[1, 0], [p, q]], normalised.
        p, q = work.to_speed[s, 0] * problem.units[1], work.to_speed[s, 1] * problem.units[1]
        a, b = problem.process_variance[0], problem.process_variance[1]
        covariance[2 * s, 2 * s] += a
        covariance[2 * s, 2 * s + 1] -= p / q * a
        covariance[2 * s + 1, 2 * s] -= p / q * a
        covariance[2 * s + 1, 2 * s + 1] += (b + p * p * a) / (q * q)


@kernel_part
def _linearise(road: RoadArrays, problem: Problem, work: Work) -> None:
    """Linearise releases and reward at the mean, and weigh the reward's terms."""
    v_f, scale, n = road.free_flow_speed, problem.density_scale, problem.n_mainline
    d_unit, v_unit = problem.units
    for s in range(road.jam.size):
        rho, psi = work.mean[2 * s], work.mean[2 * s + 1]
        _, by_rho, by_psi = released(road, s, rho, psi, problem.centre)
        a, b = by_rho * scale / road.second_scale, by_psi * scale * v_f / road.second_scale
        work.rows[s, 0], work.rows[s, 1] = a, b
        _, by_rho, by_psi = measured(rho, psi, road.jam[s], v_f, road.gamma)
        p, q = by_rho * scale / v_f / v_unit, by_psi * scale / v_unit
        work.to_speed[s, 0], work.to_speed[s, 1] = p, q
        if s < n:
            # H T^-1 with T = [[1 / d, 0], [p, q]].
            work.traffic_rows[s, 0] = d_unit
            work.traffic_rows[s, 1] = (a - b * p / q) * d_unit
            work.traffic_rows[s, 2] = b / q
            weighed = problem.lengths.size > 0
            occupied = 1.0 - np.exp(-problem.lengths[s] * rho) if weighed else 1.0
            work.weights[s] = problem.term_weights[0]
            work.weights[n + s] = problem.term_weights[1] * occupied


@kernel_part(fastmath={"contract"})
def downdate(
    covariance: FloatArray,
    first: int,
    second: int,
    by_first: float,
    by_second: tuple[float, float],
    noise: FloatArray,
    vectors: FloatArray,
) -> None:
    """Update by both releases of a segment: P - P H' (H P H' + R)^-1 H P, of rank two.

    With L L' = H P H' + R, the rows of L^-1 H P are written to `vectors` and their products
    subtracted from P.

    The density is component `first` of the covariance (m, m) and the other quantity component
    `second`; `by_first` and `by_second` are derivatives of the releases by them.
    """
    m = covariance.shape[0]
    row1, row2 = vectors[0], vectors[1]
    a, b = by_second
    # Elements, not views of rows, whose reference counts would take more time than the arithmetic.
    for j in range(m):
        row1[j] = by_first * covariance[first, j]
        row2[j] = a * covariance[first, j] + b * covariance[second, j]
    s11 = by_first * row1[first] + noise[0]
    s12 = by_first * row2[first]
    s22 = a * row2[first] + b * row2[second] + noise[1]
    l11 = 1.0 / np.sqrt(s11)
    l21 = s12 / s11
    l22 = 1.0 / np.sqrt(s22 - s12 * l21)
    for j in range(m):
        row2[j] = (row2[j] - l21 * row1[j]) * l22
        row1[j] *= l11
    for i in range(m):
        x, y = row1[i], row2[i]
        for j in range(m):
            covariance[i, j] -= x * row1[j] + y * row2[j]


@kernel_part
def condition(problem: Problem, segments: IntArray, covariance: FloatArray, work: Work) -> None:
    """Update a covariance of states by the releases of segments."""
    for s in segments:
        rows = (work.rows[s, 0], work.rows[s, 1])
        downdate(covariance, 2 * s, 2 * s + 1, 1.0, rows, problem.noise, work.vectors)


@kernel_part
def to_traffic(problem: Problem, covariance: FloatArray, work: Work) -> None:
    """Turn a covariance of states into that of density and speed over the mainline."""
    n, d = problem.n_mainline, 1.0 / problem.units[0]
    traffic, to_speed = work.traffic, work.to_speed
    for s in range(n):
        p, q = to_speed[s, 0], to_speed[s, 1]
        for t in range(n):
            u, v = to_speed[t, 0], to_speed[t, 1]
            upper, upper_too = covariance[2 * s, 2 * t], covariance[2 * s, 2 * t + 1]
            # Rows by T of s, then columns by T of t.
            speed = p * upper + q * covariance[2 * s + 1, 2 * t]
            speed_too = p * upper_too + q * covariance[2 * s + 1, 2 * t + 1]
            traffic[s, t] = d * d * upper
            traffic[s, n + t] = d * (u * upper + v * upper_too)
            traffic[n + s, t] = d * speed
            traffic[n + s, n + t] = u * speed + v * speed_too


@kernel_part
def hold_speeds(problem: Problem, work: Work) -> None:
    """Limit the weight of each speed, so that its variance counts up to the square of the cap."""
    n, largest = problem.n_mainline, problem.speed_cap**2
    for s in range(n, 2 * n):
        work.weights[s] *= min(1.0, largest / work.traffic[s, s])
