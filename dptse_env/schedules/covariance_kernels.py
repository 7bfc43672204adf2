"""Compiled kernels that propagate and update the estimator's covariance over the coming second.

One episode after the other, as in `dptse_env.estimators.compiled`. States are normalised: rho by
rho_m, psi by rho_m v_f. Over the mainline, traffic is in the reward's units: all densities, then
all speeds. What a segment releases depends on that segment alone, so that its row in either
coordinates has two entries.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from dptse_env.estimators.compiled.algebra import propagate
from dptse_env.estimators.compiled.ekf_kernels import measured, project, released
from dptse_env.model.kernels import advance
from dptse_env.model.road_arrays import RoadArrays
from dptse_env.utils.arrays import FloatArray, IntArray


class Problem(NamedTuple):
    """Constants of a road and an estimator, in a form that compiled code takes."""

    n_mainline: int  # n
    bandwidth: int  # B
    always: IntArray  # Segments with a fixed sensor, shape (F,)
    can_query: IntArray  # Mainline segments without one, shape (A,)
    noise: FloatArray  # Variances of both releases, normalised, shape (2,)
    # What a step adds, shape (2,): to rho and psi, normalised, or in a random walk to rho
    # over rho_m and v over v_f
    process_variance: FloatArray
    is_walk: bool  # Whether the estimator is a random walk, whose segments stay as they are
    is_box: bool  # Whether means are held to the box instead of the cone
    density_scale: float  # rho_m [veh/km]
    units: FloatArray  # Scales of the reward over rho_m and v_f, shape (2,)
    term_weights: FloatArray  # What density and speed weigh in the reward, shape (2,)
    # Length of a segment [km] where speeds weigh as probably as there is a vehicle; 0 where
    # they weigh in full
    length: float
    speed_cap: float  # Deviation in the reward's units beyond which that of a speed does not count


class Work(NamedTuple):
    """Scratch of one episode."""

    mean: FloatArray  # Predicted state, shape (2 S,) [veh/km, veh/h]
    blocks: FloatArray  # The blocks of F, shape (S, K, 4)
    covariance: FloatArray  # Shape (2 S, 2 S)
    product: FloatArray  # Shape (2 S, 2 S)
    transposed: FloatArray  # Shape (2 S, 2 S)
    rows: FloatArray  # Derivatives of the second release by the segment's rho and psi, shape (S, 2)
    traffic: FloatArray  # Covariance of density and speed over the mainline, shape (2 n, 2 n)
    weights: FloatArray  # What their variances weigh, shape (2 n,)
    # Derivatives of a speed by rho and psi, in the reward's units, shape (S, 2)
    to_speed: FloatArray
    # Derivatives of both releases by density and speed in the reward's units: the first by
    # density, the second by either, shape (n, 3)
    traffic_rows: FloatArray
    vectors: FloatArray  # Shape (2, 2 S)
    sums: FloatArray  # Each segment's share of a trace, then whether it is queried, shape (2, n)


@njit(cache=True, error_model="numpy")
def make_work(road: RoadArrays, problem: Problem) -> Work:
    """Allocate the scratch."""
    s, n = road.jam.size, problem.n_mainline
    square = np.empty((3, 2 * s, 2 * s))
    return Work(
        np.empty(2 * s), np.zeros((*road.neighbours.shape, 4)), square[0], square[1], square[2],
        np.empty((s, 2)), np.empty((2 * n, 2 * n)), np.empty(2 * n), np.empty((s, 2)),
        np.empty((n, 3)), np.empty((2, 2 * s)), np.empty((2, n)),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
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
    work.covariance[:] = covariance
    if problem.is_walk:
        work.mean[:] = mean
        _linearise(road, problem, work)
        drift(problem, work.covariance, work)
    else:
        work.mean[:] = mean
        advance(road, work.mean, inputs, work.mean, work.blocks, scratch)
        project(road, work.mean, problem.is_box)
        work.blocks[:, :, 1] *= road.free_flow_speed
        work.blocks[:, :, 2] /= road.free_flow_speed
        step(road, problem, work.covariance, work)
        _linearise(road, problem, work)


@njit(cache=True, error_model="numpy")
def step(road: RoadArrays, problem: Problem, covariance: FloatArray, work: Work) -> None:
    """Replace a covariance by the next second's, F staying as it is."""
    if problem.is_walk:
        drift(problem, covariance, work)
    else:
        noise = problem.process_variance
        propagate(road, work.blocks, noise, covariance, work.product, work.transposed)


@njit(cache=True, error_model="numpy")
def drift(problem: Problem, covariance: FloatArray, work: Work) -> None:
    """Let density and speed of every segment walk: each segment's block gets T^-1 Q T^-T."""
    for s in range(work.rows.shape[0]):
        # T = [[1, 0], [p, q]], normalised.
        p, q = work.to_speed[s, 0] * problem.units[1], work.to_speed[s, 1] * problem.units[1]
        a, b = problem.process_variance[0], problem.process_variance[1]
        covariance[2 * s, 2 * s] += a
        covariance[2 * s, 2 * s + 1] -= p / q * a
        covariance[2 * s + 1, 2 * s] -= p / q * a
        covariance[2 * s + 1, 2 * s + 1] += (b + p * p * a) / (q * q)


@njit(cache=True, error_model="numpy")
def _linearise(road: RoadArrays, problem: Problem, work: Work) -> None:
    """Linearise releases and reward at the mean, and weigh the reward's terms."""
    v_f, scale, n = road.free_flow_speed, problem.density_scale, problem.n_mainline
    d_unit, v_unit = problem.units
    for s in range(road.jam.size):
        rho, psi = work.mean[2 * s], work.mean[2 * s + 1]
        _, by_rho, by_psi = released(road, s, rho, psi)
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
            occupied = 1.0 if problem.length == 0.0 else 1.0 - np.exp(-problem.length * rho)
            work.weights[s] = problem.term_weights[0]
            work.weights[n + s] = problem.term_weights[1] * occupied


@njit(cache=True, error_model="numpy", fastmath={"contract"})
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
    taken from P.

    Args:
        covariance: Shape (m, m), replaced.
        first: Row of the segment's density.
        second: Row of its other component.
        by_first: Derivative of the first release by the density.
        by_second: Derivatives of the second release by both.
        noise: Shape (2,).
        vectors: Scratch, shape (2, at least m).
    """
    m = covariance.shape[0]
    one, two = vectors[0], vectors[1]
    a, b = by_second
    # Elements, not views of rows: those cost more in reference counts than the arithmetic does.
    for j in range(m):
        one[j] = by_first * covariance[first, j]
        two[j] = a * covariance[first, j] + b * covariance[second, j]
    s11 = by_first * one[first] + noise[0]
    s12 = by_first * two[first]
    s22 = a * two[first] + b * two[second] + noise[1]
    l11 = 1.0 / np.sqrt(s11)
    l21 = s12 / s11
    l22 = 1.0 / np.sqrt(s22 - s12 * l21)
    for j in range(m):
        two[j] = (two[j] - l21 * one[j]) * l22
        one[j] *= l11
    for i in range(m):
        x, y = one[i], two[i]
        for j in range(m):
            covariance[i, j] -= x * one[j] + y * two[j]


@njit(cache=True, error_model="numpy")
def condition(problem: Problem, segments: IntArray, covariance: FloatArray, work: Work) -> None:
    """Update a covariance of states by the releases of segments."""
    for s in segments:
        rows = (work.rows[s, 0], work.rows[s, 1])
        downdate(covariance, 2 * s, 2 * s + 1, 1.0, rows, problem.noise, work.vectors)


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def hold_speeds(problem: Problem, work: Work) -> None:
    """Weigh each speed such that its variance counts for the square of the cap at most."""
    n, largest = problem.n_mainline, problem.speed_cap**2
    for s in range(n, 2 * n):
        work.weights[s] *= min(1.0, largest / work.traffic[s, s])
