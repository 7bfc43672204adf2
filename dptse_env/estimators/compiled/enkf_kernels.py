"""Compiled kernels of the ensemble Kalman filter: one episode at a time, members in columns."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dptse_env.estimators.compiled.kernels import Packed
from dptse_env.estimators.compiled.swarm import (
    advance_swarm,
    flock_of,
    measured_speeds,
    project_swarm,
)
from dptse_env.estimators.compiled.ukf_kernels import factor, products
from dptse_env.model.arz import LARGEST_W
from dptse_env.model.network import BoolArray, FloatArray
from dptse_env.model.road import Road

Draws = NDArray[np.float32]


@njit(cache=True, error_model="numpy")
def scatter(
    road_: Packed, swarm: FloatArray, n: int, deviation: FloatArray, draws: Draws, is_box: bool
) -> None:
    """Add noise of `deviation` `(2,)` [veh/km, veh/h] to the first n columns and project all.

    Columns beyond n repeat the first.
    """
    road = Road(*road_)
    for i in range(swarm.shape[0]):
        row, draw, size = swarm[i], draws[i], deviation[i % 2]
        for j in range(n):
            row[j] += size * draw[j]
        row[n:] = row[0]
    project_swarm(road, swarm, is_box)


@njit(cache=True, error_model="numpy")
def predict(
    road_: Packed,
    swarm: FloatArray,
    n: int,
    inputs: FloatArray,
    deviation: FloatArray,
    draws: Draws,
    is_box: bool,
) -> None:
    """Move the members of one episode, disturb each and project it."""
    road = Road(*road_)
    advance_swarm(road, swarm, inputs, flock_of(road, swarm.shape[1]))
    scatter(road_, swarm, n, deviation, draws, is_box)


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _centre(row: FloatArray, n: int, unit: float, out: FloatArray) -> float:
    """Write distances from the mean, zero beyond n, and return the mean, both over `unit`."""
    first, total = row[0], 0.0
    for j in range(n):
        total += row[j] - first
    mean = first + total / n
    for j in range(n):
        out[j] = (row[j] - mean) / unit
    out[n:] = 0.0
    return float(mean / unit)


@njit(cache=True, error_model="numpy")
def update(
    road_: Packed,
    swarm: FloatArray,
    n: int,
    density_scale: float,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    draws: Draws,
    innovations: FloatArray,
    is_box: bool,
) -> bool:
    """Take the measurements of one episode in, perturbed for each member by `draws`.

    Returns:
        Whether the members are finite and the predicted covariance was definite.
    """
    road = Road(*road_)
    innovations[:] = 0.0
    if observed.any() and not _take_in(
        road, swarm, n, density_scale, observed, values, sigma, draws, innovations
    ):
        return False
    project_swarm(road, swarm, is_box)
    return bool(np.isfinite(swarm).all())


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _take_in(
    road: Road,
    swarm: FloatArray,
    n: int,
    density_scale: float,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    draws: Draws,
    innovations: FloatArray,
) -> bool:
    width, m, v_f = swarm.shape[1], 2 * observed.sum(), road.free_flow_speed
    start = (m + 7) // 8 * 8
    # Rows are outputs: S, then the residuals of the members.
    joint = np.zeros((m, start + width))
    distances, means = np.empty((m, width)), np.empty(m)
    speed = np.empty(width)
    units = np.array([density_scale, v_f])
    r = 0
    for s in range(observed.size):
        if not observed[s]:
            continue
        measured_speeds(swarm[2 * s], swarm[2 * s + 1], road.jam[s], v_f, road.gamma, speed)
        for kind in range(2):
            row, unit = (swarm[2 * s], units[0]) if kind == 0 else (speed, units[1])
            residual, draw, noise = joint[r, start:], draws[r], sigma[kind] / unit
            means[r] = _centre(row, n, unit, distances[r])
            centre = values[s, kind] / unit - means[r]
            for j in range(n):
                residual[j] = centre + noise * draw[j] - distances[r, j]
            innovations[s, kind] = centre
            r += 1
    products(distances, m, distances, m, True, joint)
    r = 0
    for i in range(m):
        noise = sigma[i % 2] / units[i % 2]
        for j in range(i + 1):
            joint[j, i] = joint[i, j] / (n - 1)
        joint[i, i] += noise**2
    for s in range(observed.size):
        if observed[s]:
            innovations[s, 0] /= np.sqrt(joint[r, r])
            innovations[s, 1] /= np.sqrt(joint[r + 1, r + 1])
            r += 2
    if not factor(joint, m):
        return False
    _back(joint, m, start)
    states, cross = np.empty(swarm.shape), np.empty((swarm.shape[0], m + 1))
    for i in range(swarm.shape[0]):
        _centre(swarm[i], n, float(n - 1), states[i])
    products(states, swarm.shape[0], distances, m, False, cross)
    _shift(swarm, cross, joint, m, start)
    return True


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _back(joint: FloatArray, m: int, start: int) -> None:
    """Solve U x = z for the residuals, in place."""
    for i in range(m - 1, -1, -1):
        row = joint[i, start:]
        inverse = 1.0 / joint[i, i]
        for j in range(row.size):
            row[j] *= inverse
        for k in range(i):
            other, head = joint[k, start:], joint[k, i]
            for j in range(row.size):
                other[j] -= head * row[j]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _shift(swarm: FloatArray, cross: FloatArray, joint: FloatArray, m: int, start: int) -> None:
    """Add `cross` times the solved residuals to the members, two outputs at a time."""
    width = swarm.shape[1]
    for r in range(0, m, 2):
        first, second = joint[r, start:], joint[r + 1, start:]
        for i in range(swarm.shape[0]):
            row, a, b = swarm[i], cross[i, r], cross[i, r + 1]
            for j in range(width):
                row[j] += a * first[j] + b * second[j]


@njit(cache=True, error_model="numpy")
def summarise(road_: Packed, swarms: FloatArray, n: int, out: FloatArray) -> None:
    """Write density and speed of the mean and the members' deviations to `out` `(4, E, S)`."""
    road = Road(*road_)
    v_f, width = road.free_flow_speed, swarms.shape[2]
    rest, speed, mean_speed = np.empty(width), np.empty(width), np.empty(width)
    rho_row, psi_row = np.empty(width), np.empty(width)
    for e in range(swarms.shape[0]):
        for s in range(road.jam.size):
            rho, psi = swarms[e, 2 * s], swarms[e, 2 * s + 1]
            rho_row[:] = _centre(rho, n, 1.0, rest)
            out[2, e, s] = np.sqrt((rest**2).sum() / (n - 1))
            psi_row[:] = _centre(psi, n, 1.0, rest)
            measured_speeds(rho_row, psi_row, road.jam[s], v_f, road.gamma, mean_speed)
            measured_speeds(rho, psi, road.jam[s], v_f, road.gamma, speed)
            _centre(speed, n, 1.0, rest)
            out[0, e, s] = rho_row[0]
            out[1, e, s] = min(max(mean_speed[0], 0.0), LARGEST_W * v_f)
            out[3, e, s] = np.sqrt((rest**2).sum() / (n - 1))
