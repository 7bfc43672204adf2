"""Compiled kernels of the ensemble Kalman filter, episode by episode.

With D the deviations of outputs from their mean and X those of states, a member per column, the
update is `x += X D' (D D' + (M - 1) R)^-1 (z + noise - y)` for every member: S is factorised and
solved for the gain, which has fewer columns than there are members. Products of matrices use BLAS
and are small enough for one thread.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.estimators.compiled.cholesky import solve
from dptse_env.estimators.compiled.driver_noise import couple_members
from dptse_env.estimators.compiled.ekf_kernels import Packed
from dptse_env.estimators.compiled.moments import centre_row, is_finite, mean_of, moments_of
from dptse_env.estimators.compiled.normals import Bits, Draws, fill, make_bits
from dptse_env.estimators.compiled.row_outputs import average_outputs
from dptse_env.model.columns import (
    advance_states,
    make_batch_scratch,
    measured_speeds,
    project_states,
    released_by_states,
)
from dptse_env.model.network import RoadArrays
from dptse_env.model.parameters import LARGEST_W
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernel_loops import copy_vector
from dptse_env.utils.kernels import kernel, kernel_part


class Ensembles(NamedTuple):
    """Members of n episodes and the parameters of their updates."""

    # (n, n_x, width) a member per column [veh/km, veh/h], with demand factors if there are any;
    # columns beyond the members are padding with copies of the first one
    members: FloatArray
    n_members: int
    priors: FloatArray  # (n, n_x) prior means
    streams: NDArray[np.uint64]  # (n, 2, 4, STREAM_WIDTH) of process noise and of measurement noise
    innovations: FloatArray  # (n, M, 2)
    diverged: BoolArray  # (n,)
    process_deviation: FloatArray  # (n_x,) of a step [veh/km, veh/h, 1]; of psi, or of rho_m w
    noise_in_w: bool  # whether it is of w
    density_growth: float  # deviation over rho_m that rho = rho_m adds to the noise of rho
    count_variance: FloatArray  # (M,) variance of densities beside the noise, over rho, normalised
    initial_deviation: FloatArray  # (n_x,) of the members around a prior [veh/km, veh/h, 1]
    density_scale: float  # rho_m [veh/km]
    inflation: float  # factor on distances from the mean before an update
    tapers: FloatArray  # (M, n_x) weights of covariances of rows with states; (0, 0) for none
    row_tapers: FloatArray  # (M, M) weights of covariances among rows; (0, 0) for none
    is_box: bool  # whether members are projected into the paper's box, not the cone


class Measured(NamedTuple):
    """Measurements of an episode."""

    rows: IntArray  # (m,) those that are observed
    values: FloatArray  # (M, 2)
    sigma: FloatArray  # (M, 2)
    centre: FloatArray  # (S,)


@kernel
def restart(road_: Packed, ensembles_: Packed, episodes: IntArray) -> None:
    """Draw the members of episodes around their priors."""
    road, ensembles = RoadArrays(*road_), Ensembles(*ensembles_)
    for e in episodes:
        _restart(road, ensembles, e)


@kernel_part(kept=True)
def _restart(road: RoadArrays, ensembles: Ensembles, e: int) -> None:
    members, n = ensembles.members[e], ensembles.n_members
    for i in range(members.shape[0]):
        members[i] = ensembles.priors[e, i]
    draws = _make_draws(members.shape[0] * n)
    fill(ensembles.streams[e, 0], draws, make_bits(draws.size))
    _perturb(members, n, ensembles.initial_deviation, draws)
    project_states(road, members, ensembles.is_box)


@kernel_part
def _make_draws(size: int) -> Draws:
    """Allocate at least `size` numbers, an even number of them, as `fill` writes pairs."""
    return np.empty(size + size % 2, dtype=np.float32)


@kernel_part
def _perturb(members: FloatArray, n: int, deviation: FloatArray, draws: Draws) -> None:
    """Add noise to the first n columns; those beyond repeat the first."""
    for i in range(members.shape[0]):
        row, draw, size = members[i], draws[i * n : (i + 1) * n], deviation[i]
        for j in range(n):
            row[j] += size * draw[j]
        row[n:] = row[0]


@kernel
def predict(road_: Packed, ensembles_: Packed, episodes: IntArray, inputs: FloatArray) -> None:
    """Predict members one step ahead under inputs `(k, n_u)`, with noise, and project them."""
    road, ensembles = RoadArrays(*road_), Ensembles(*ensembles_)
    n = ensembles.n_members
    size, width = ensembles.members.shape[1:]
    scratch = make_batch_scratch(road, width)
    draws, deviation = _make_draws(size * n), np.empty(size)
    bits = make_bits(draws.size)
    for k in range(episodes.size):
        members = ensembles.members[episodes[k]]
        _process_deviation(road, ensembles, members, deviation)
        advance_states(road, members, inputs[k], scratch)
        fill(ensembles.streams[episodes[k], 0], draws, bits)
        if ensembles.noise_in_w:
            couple_members(road, ensembles.density_scale, members, n, deviation, draws)
        _perturb(members, n, deviation, draws)
        project_states(road, members, ensembles.is_box)


@kernel_part
def _process_deviation(
    road: RoadArrays, ensembles: Ensembles, members: FloatArray, deviation: FloatArray
) -> None:
    """Write the deviations `(n_x,)` of the process noise of a step that leaves the members."""
    copy_vector(ensembles.process_deviation, deviation)
    if ensembles.density_growth == 0.0:
        return
    scale = ensembles.density_scale
    for s in range(road.jam.size):
        share = mean_of(members[2 * s], ensembles.n_members) / scale
        grown = (ensembles.density_growth * scale) ** 2 * share
        deviation[2 * s] = np.sqrt(deviation[2 * s] ** 2 + grown)


@kernel_part
def _inflate(members: FloatArray, n: int, factor: float) -> None:
    for i in range(members.shape[0]):
        row, mean = members[i], mean_of(members[i], n)
        for j in range(row.size):
            row[j] = mean + factor * (row[j] - mean)


@kernel
def update(
    road_: Packed,
    ensembles_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
) -> None:
    """Update by measurements, perturbed for each member; see `Estimator.update`."""
    road, ensembles = RoadArrays(*road_), Ensembles(*ensembles_)
    n_rows = road.row_first.size
    draws = np.empty(2 * n_rows * ensembles.n_members, dtype=np.float32)
    bits = make_bits(draws.size)
    rows = np.empty(n_rows, dtype=np.int64)
    for k in range(episodes.size):
        e, n_seen = episodes[k], 0
        for m in range(n_rows):
            if observed[k, m]:
                rows[n_seen] = m
                n_seen += 1
        ensembles.innovations[e] = 0.0
        members, sound = ensembles.members[e], True
        if n_seen > 0:
            measured = Measured(rows[:n_seen], values[k], sigma[k], centre[k])
            sound = _update_members(road, ensembles, e, measured, draws, bits)
            project_states(road, members, ensembles.is_box)
        ensembles.diverged[e] = not (sound and is_finite(members))
        if ensembles.diverged[e]:
            ensembles.innovations[e] = 0.0
            _restart(road, ensembles, e)


@kernel_part(kept=True)
def _update_members(
    road: RoadArrays,
    ensembles: Ensembles,
    e: int,
    measured: Measured,
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
    size, width = 2 * measured.rows.size, members.shape[1]
    used = draws[: size * n]
    fill(ensembles.streams[e, 1], used, bits)
    distances, residuals = np.empty((size, width)), np.empty((size, width))
    differences, noise = _compare(road, ensembles, e, measured, used, distances, residuals)
    # Full vector registers for the solution; rows beyond the states are zero.
    states = np.zeros(((members.shape[0] + 7) // 8 * 8, width))
    for i in range(members.shape[0]):
        centre_row(members[i], n, 1.0, states[i])
    joint, gain = np.dot(distances, distances.T), np.dot(distances, states.T)
    if ensembles.tapers.size > 0:
        _taper(ensembles, measured.rows, joint, gain)
    inverse = 1.0 / (n - 1)
    for i in range(size):
        for j in range(i):
            joint[i, j] *= inverse
        joint[i, i] = inverse * joint[i, i] + noise[i] ** 2
        deviation = np.sqrt(joint[i, i])
        ensembles.innovations[e, measured.rows[i // 2], i % 2] = differences[i] / deviation
    if not solve(joint, gain):
        return False
    shift = np.dot(gain.T, residuals)
    for i in range(members.shape[0]):
        row, step = members[i], shift[i]
        for j in range(width):
            row[j] += inverse * step[j]
    return is_finite(members)


@kernel_part(kept=True, fastmath={"contract"})
def _compare(
    road: RoadArrays,
    ensembles: Ensembles,
    e: int,
    measured: Measured,
    draws: Draws,
    distances: FloatArray,
    residuals: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Write deviations of outputs and residuals of members, normalised.

    Returns:
        The residuals of the mean, and the deviations of the noise, `(2 m,)` each.
    """
    members, n = ensembles.members[e], ensembles.n_members
    units = np.array([ensembles.density_scale, road.second_scale])
    differences, noise = np.empty(2 * measured.rows.size), np.empty(2 * measured.rows.size)
    width = members.shape[1]
    second, average, work = np.empty(width), np.empty(width), np.empty(width)
    for i in range(measured.rows.size):
        m = measured.rows[i]
        first, span = road.row_first[m], road.row_span[m]
        if span == 1:
            density = members[2 * first]
            v_0 = measured.centre[first]
            released_by_states(road, first, density, members[2 * first + 1], v_0, second)
        else:
            density = average
            average_outputs(road, members, first, span, measured.centre, density, second, work)
        for kind in range(2):
            r, row = 2 * i + kind, density if kind == 0 else second
            distance, residual, draw = distances[r], residuals[r], draws[r * n : (r + 1) * n]
            mean = centre_row(row, n, units[kind], distance)
            size = measured.sigma[m, kind] / units[kind]
            if kind == 0 and ensembles.count_variance[m] > 0.0:
                counted = ensembles.count_variance[m] * mean * units[0] / span
                size = np.sqrt(size**2 + counted)
            difference = measured.values[m, kind] / units[kind] - mean
            for j in range(n):
                residual[j] = difference + size * draw[j] - distance[j]
            residual[n:] = 0.0
            differences[r], noise[r] = difference, size
    return differences, noise


@kernel_part
def _taper(ensembles: Ensembles, rows: IntArray, joint: FloatArray, gain: FloatArray) -> None:
    """Weigh covariances among outputs, and those with the states, by distance."""
    for i in range(joint.shape[0]):
        among, weights = ensembles.row_tapers[rows[i // 2]], ensembles.tapers[rows[i // 2]]
        for j in range(joint.shape[1]):
            joint[i, j] *= among[rows[j // 2]]
        for j in range(weights.size):
            gain[i, j] *= weights[j]


@kernel
def summarise(road_: Packed, members: FloatArray, n: int, out: FloatArray) -> None:
    """Write density and speed of the mean and the deviations of members to `out` `(4, n, S)`."""
    road = RoadArrays(*road_)
    v_f, gamma, width = road.free_flow_speed, road.gamma, members.shape[2]
    speed, mean = np.empty(width), np.empty((3, 1))
    for e in range(members.shape[0]):
        for s in range(road.jam.size):
            rho, psi = members[e, 2 * s], members[e, 2 * s + 1]
            mean[0, 0], out[2, e, s] = moments_of(rho, n)
            mean[1, 0] = mean_of(psi, n)
            measured_speeds(mean[0], mean[1], road.jam[s], v_f, gamma, mean[2])
            measured_speeds(rho, psi, road.jam[s], v_f, gamma, speed)
            _, out[3, e, s] = moments_of(speed, n)
            out[0, e, s] = min(mean[0, 0], road.jam[s])
            out[1, e, s] = min(max(mean[2, 0], 0.0), LARGEST_W * v_f)
