"""Compiled kernels of the ensemble Kalman filter, episode by episode.

With D the deviations of outputs from their mean and X those of states, a member per column, the
update is `x += X D' (D D' + (M - 1) R)^-1 (z + noise - y)` for every member: S is factorised and
solved for the gain, which has fewer columns than there are members. Products of matrices use BLAS
and are small enough for one thread.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dptse_env.estimators.compiled.cholesky import solve
from dptse_env.estimators.compiled.ekf_kernels import Packed
from dptse_env.estimators.compiled.normals import Bits, Draws, fill, make_bits
from dptse_env.estimators.compiled.state_batch import (
    advance_states,
    make_batch_scratch,
    measured_speeds,
    project_states,
    released_by_states,
)
from dptse_env.model.parameters import LARGEST_W
from dptse_env.model.road_arrays import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class Ensembles(NamedTuple):
    """Members of n episodes and the parameters of their updates."""

    # (n, 2 S, width) a member per column [veh/km, veh/h]; columns beyond the members are padding
    # with copies of the first one
    members: FloatArray
    n_members: int  # M
    priors: FloatArray  # (n, 2 S) prior means
    streams: NDArray[np.uint64]  # (n, 2, 4, STREAM_WIDTH) of process noise and of measurement noise
    innovations: FloatArray  # (n, S, 2)
    diverged: BoolArray  # (n,)
    process_deviation: FloatArray  # (2,) of rho and psi in a step [veh/km, veh/h]
    initial_deviation: FloatArray  # (2,) of the members around a prior [veh/km, veh/h]
    density_scale: float  # rho_m [veh/km]
    inflation: float  # factor on distances from the mean before an update
    tapers: FloatArray  # (S, S) weights of covariances between segments; (0, 0) for none
    is_box: bool  # whether members are projected into the paper's box, not the cone


@njit(cache=True, error_model="numpy")
def restart(road_: Packed, ensembles_: Packed, episodes: IntArray) -> None:
    """Draw the members of episodes around their priors."""
    road, ensembles = RoadArrays(*road_), Ensembles(*ensembles_)
    for e in episodes:
        _restart(road, ensembles, e)


@njit(cache=True, error_model="numpy")
def _restart(road: RoadArrays, ensembles: Ensembles, e: int) -> None:
    members, n = ensembles.members[e], ensembles.n_members
    for i in range(members.shape[0]):
        members[i] = ensembles.priors[e, i]
    draws = np.empty(members.shape[0] * n, dtype=np.float32)
    fill(ensembles.streams[e, 0], draws, make_bits(draws.size))
    _perturb(members, n, ensembles.initial_deviation, draws)
    project_states(road, members, ensembles.is_box)


@njit(cache=True, error_model="numpy")
def _perturb(members: FloatArray, n: int, deviation: FloatArray, draws: Draws) -> None:
    """Add noise to the first n columns; those beyond repeat the first."""
    for i in range(members.shape[0]):
        row, draw, size = members[i], draws[i * n : (i + 1) * n], deviation[i % 2]
        for j in range(n):
            row[j] += size * draw[j]
        row[n:] = row[0]


@njit(cache=True, error_model="numpy", nogil=True)
def predict(road_: Packed, ensembles_: Packed, episodes: IntArray, inputs: FloatArray) -> None:
    """Predict members one step ahead under inputs `(k, n_u)`, with noise, and project them."""
    road, ensembles = RoadArrays(*road_), Ensembles(*ensembles_)
    n = ensembles.n_members
    size, width = ensembles.members.shape[1:]
    scratch = make_batch_scratch(road, width)
    draws = np.empty(size * n, dtype=np.float32)
    bits = make_bits(draws.size)
    for k in range(episodes.size):
        members = ensembles.members[episodes[k]]
        advance_states(road, members, inputs[k], scratch)
        fill(ensembles.streams[episodes[k], 0], draws, bits)
        _perturb(members, n, ensembles.process_deviation, draws)
        project_states(road, members, ensembles.is_box)


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _mean(row: FloatArray, n: int) -> float:
    """Return the mean of the first n relative to the first, exact for equal numbers."""
    first, total = row[0], 0.0
    for j in range(n):
        total += row[j] - first
    return float(first + total / n)


@njit(cache=True, error_model="numpy")
def _centre(row: FloatArray, n: int, unit: float, out: FloatArray) -> float:
    """Write distances from the mean, zero beyond n, and return the mean, both over `unit`."""
    mean, inverse = _mean(row, n), 1.0 / unit
    for j in range(n):
        out[j] = (row[j] - mean) * inverse
    out[n:] = 0.0
    return mean * inverse


@njit(cache=True, error_model="numpy")
def _inflate(members: FloatArray, n: int, factor: float) -> None:
    for i in range(members.shape[0]):
        row, mean = members[i], _mean(members[i], n)
        for j in range(row.size):
            row[j] = mean + factor * (row[j] - mean)


@njit(cache=True, error_model="numpy", nogil=True)
def update(
    road_: Packed,
    ensembles_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
) -> None:
    """Update by measurements, perturbed for each member; see `Estimator.update`."""
    road, ensembles = RoadArrays(*road_), Ensembles(*ensembles_)
    n_segments = road.jam.size
    draws = np.empty(2 * n_segments * ensembles.n_members, dtype=np.float32)
    bits = make_bits(draws.size)
    segments = np.empty(n_segments, dtype=np.int64)
    for k in range(episodes.size):
        e, n_seen = episodes[k], 0
        for s in range(n_segments):
            if observed[k, s]:
                segments[n_seen] = s
                n_seen += 1
        ensembles.innovations[e] = 0.0
        members, sound = ensembles.members[e], True
        if n_seen > 0:
            sound = _update_members(
                road, ensembles, e, segments[:n_seen], values[k], sigma, draws, bits
            )
            project_states(road, members, ensembles.is_box)
        ensembles.diverged[e] = not (sound and _is_finite(members))
        if ensembles.diverged[e]:
            ensembles.innovations[e] = 0.0
            _restart(road, ensembles, e)


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _is_finite(members: FloatArray) -> bool:
    total = 0.0
    for i in range(members.shape[0]):
        row = members[i]
        for j in range(row.size):
            total += 0.0 * row[j]
    return total == 0.0


@njit(cache=True, error_model="numpy")
def _update_members(
    road: RoadArrays,
    ensembles: Ensembles,
    e: int,
    segments: IntArray,
    values: FloatArray,
    sigma: FloatArray,
    draws: Draws,
    bits: Bits,
) -> bool:
    """Update the members of an episode by its measurements.

    Returns:
        Whether S is definite and the members are finite, before a projection that would bring
        infinities back into the bounds.
    """
    members, n = ensembles.members[e], ensembles.n_members
    if ensembles.inflation != 1.0:
        _inflate(members, n, ensembles.inflation)
        project_states(road, members, ensembles.is_box)
    m, width = 2 * segments.size, members.shape[1]
    used = draws[: m * n]
    fill(ensembles.streams[e, 1], used, bits)
    distances, residuals = np.empty((m, width)), np.empty((m, width))
    units = np.array([ensembles.density_scale, road.second_scale])
    noise = sigma / units
    centres = _compare(
        road, ensembles, e, segments, values, units, noise, used, distances, residuals
    )
    # Full vector registers for the solution; rows beyond the states are zero.
    states = np.zeros(((members.shape[0] + 7) // 8 * 8, width))
    for i in range(members.shape[0]):
        _centre(members[i], n, 1.0, states[i])
    joint, gain = np.dot(distances, distances.T), np.dot(distances, states.T)
    if ensembles.tapers.size > 0:
        _taper(ensembles.tapers, segments, joint, gain)
    inverse = 1.0 / (n - 1)
    for i in range(m):
        for j in range(i):
            joint[i, j] *= inverse
        joint[i, i] = inverse * joint[i, i] + noise[i % 2] ** 2
        deviation = np.sqrt(joint[i, i])
        ensembles.innovations[e, segments[i // 2], i % 2] = centres[i] / deviation
    if not solve(joint, gain):
        return False
    shift = np.dot(gain.T, residuals)
    for i in range(members.shape[0]):
        row, step = members[i], shift[i]
        for j in range(width):
            row[j] += inverse * step[j]
    return _is_finite(members)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _compare(
    road: RoadArrays,
    ensembles: Ensembles,
    e: int,
    segments: IntArray,
    values: FloatArray,
    units: FloatArray,
    noise: FloatArray,
    draws: Draws,
    distances: FloatArray,
    residuals: FloatArray,
) -> FloatArray:
    """Write deviations of outputs and residuals of members; return the residuals of the mean."""
    members, n = ensembles.members[e], ensembles.n_members
    centres, second = np.empty(2 * segments.size), np.empty(members.shape[1])
    for i in range(segments.size):
        s = segments[i]
        rho, psi = members[2 * s], members[2 * s + 1]
        released_by_states(road, s, rho, psi, second)
        for kind in range(2):
            r, row = 2 * i + kind, rho if kind == 0 else second
            distance, residual, draw = distances[r], residuals[r], draws[r * n : (r + 1) * n]
            centre = values[s, kind] / units[kind] - _centre(row, n, units[kind], distance)
            size = noise[kind]
            for j in range(n):
                residual[j] = centre + size * draw[j] - distance[j]
            residual[n:] = 0.0
            centres[r] = centre
    return centres


@njit(cache=True, error_model="numpy")
def _taper(tapers: FloatArray, segments: IntArray, joint: FloatArray, gain: FloatArray) -> None:
    """Weigh covariances among outputs, and those with the states, by distance."""
    for i in range(joint.shape[0]):
        weights = tapers[segments[i // 2]]
        for j in range(joint.shape[1]):
            joint[i, j] *= weights[segments[j // 2]]
        for j in range(2 * weights.size):
            gain[i, j] *= weights[j // 2]


@njit(cache=True, error_model="numpy", nogil=True)
def summarise(road_: Packed, members: FloatArray, n: int, out: FloatArray) -> None:
    """Write density and speed of the mean and the deviations of members to `out` `(4, n, S)`."""
    road = RoadArrays(*road_)
    v_f, gamma, width = road.free_flow_speed, road.gamma, members.shape[2]
    speed, mean = np.empty(width), np.empty((3, 1))
    for e in range(members.shape[0]):
        for s in range(road.jam.size):
            rho, psi = members[e, 2 * s], members[e, 2 * s + 1]
            mean[0, 0], out[2, e, s] = _moments(rho, n)
            mean[1, 0] = _mean(psi, n)
            measured_speeds(mean[0], mean[1], road.jam[s], v_f, gamma, mean[2])
            measured_speeds(rho, psi, road.jam[s], v_f, gamma, speed)
            _, out[3, e, s] = _moments(speed, n)
            out[0, e, s] = min(mean[0, 0], road.jam[s])
            out[1, e, s] = min(max(mean[2, 0], 0.0), LARGEST_W * v_f)


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _moments(row: FloatArray, n: int) -> tuple[float, float]:
    """Return mean and standard deviation of the first n."""
    mean, total = _mean(row, n), 0.0
    for j in range(n):
        total += (row[j] - mean) ** 2
    return mean, np.sqrt(total / (n - 1))
