"""Compiled kernels of the moving horizon estimator, episode by episode."""

from typing import NamedTuple

import numpy as np
from numba import njit

from dptse_env.estimators.compiled import ekf_kernels as kernels
from dptse_env.estimators.compiled.active_set import make_active_set, minimise
from dptse_env.estimators.compiled.ekf_kernels import (
    Filters,
    Packed,
    project,
    released,
    variance_along,
)
from dptse_env.estimators.compiled.window import Chain, factorise, make_window_scratch
from dptse_env.model.kernels import advance, make_scratch
from dptse_env.model.road_arrays import RoadArrays
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class Windows(NamedTuple):
    """Windows of n episodes, up to L = N + 1 stages each; normalised but for the inputs."""

    length: IntArray  # (n,) stages in use
    arrival_variance: FloatArray  # (n, 2) in use
    predicted: FloatArray  # (n, L, 2 S) predictions of stages; the first is the arrival's mean
    inputs: FloatArray  # (n, L, n_u) of the step that leaves each stage
    observed: BoolArray  # (n, L, S)
    values: FloatArray  # (n, L, S, 2)
    noise: FloatArray  # (n, L, 2)
    blocks: FloatArray  # (n, L, S, K, 4) of the step that leaves each stage
    offsets: FloatArray  # (n, L, 2 S) likewise
    rows: FloatArray  # (n, L, S, 2)
    constants: FloatArray  # (n, L, S)
    solution: FloatArray  # (n, L, padded)
    side: IntArray  # (n, L, padded) bound at which each variable was last active
    unsolved: BoolArray  # (n,) whether the active-set method found no optimum
    moving_variance: FloatArray  # (2,) arrival variance of a window that moves
    lower: FloatArray  # (2 S,)
    upper: FloatArray  # (2 S,)
    along: bool  # whether to linearise along the last solution


@njit(cache=True, error_model="numpy")
def restart(road_: Packed, filters_: Packed, windows_: Packed, episode: int) -> None:
    """Reset an episode to a window of a single stage, its prior."""
    road, filters, windows = RoadArrays(*road_), Filters(*filters_), Windows(*windows_)
    kernels.restart(filters, episode)
    windows.length[episode] = 1
    windows.arrival_variance[episode] = filters.initial_variance
    _enter(road, filters, windows, episode, 0)
    _linearise_measurement(road, filters, windows, episode, 0, windows.solution[episode, 0])
    windows.unsolved[episode] = False


@njit(cache=True, error_model="numpy")
def _enter(road: RoadArrays, filters: Filters, windows: Windows, e: int, t: int) -> None:
    """Add the mean as a stage without measurements."""
    scale = filters.density_scale
    for i in range(filters.means.shape[1]):
        unit = scale if i % 2 == 0 else scale * road.free_flow_speed
        windows.predicted[e, t, i] = filters.means[e, i] / unit
        windows.solution[e, t, i] = windows.predicted[e, t, i]
    windows.observed[e, t] = False
    windows.side[e, t] = 0
    windows.noise[e, t] = 1.0


@njit(cache=True, error_model="numpy", nogil=True)
def predict(
    road_: Packed, filters_: Packed, windows_: Packed, episodes: IntArray, inputs: FloatArray
) -> None:
    """Append the model's prediction, under inputs `(k, n_u)`, to each window."""
    road, filters, windows = RoadArrays(*road_), Filters(*filters_), Windows(*windows_)
    scratch = make_scratch(road)
    blocks = np.empty((*road.neighbours.shape, 4))
    state = np.empty(filters.means.shape[1])
    centre = np.empty(windows.solution.shape[2])
    capacity = windows.solution.shape[1]
    for k in range(episodes.size):
        e = episodes[k]
        length = windows.length[e]
        centre[:] = 0.0
        for t in range(length):
            centre += windows.solution[e, t]
        centre /= length
        state[:] = filters.means[e]
        project(road, state, False)
        advance(road, state, inputs[k], state, blocks, scratch)
        project(road, state, filters.is_box)
        filters.means[e] = state
        windows.inputs[e, length - 1] = inputs[k]
        if not windows.along:
            _linearise_step(road, filters, windows, e, length - 1, centre)
        if length == capacity:
            _shift(windows, e)
            length -= 1
        windows.length[e] = length + 1
        _enter(road, filters, windows, e, length)
        if not windows.along:
            _linearise_measurement(road, filters, windows, e, length, centre)


@njit(cache=True, error_model="numpy")
def _shift(windows: Windows, e: int) -> None:
    """Drop the oldest stage."""
    windows.arrival_variance[e] = windows.moving_variance
    for t in range(windows.solution.shape[1] - 1):
        windows.predicted[e, t] = windows.predicted[e, t + 1]
        windows.inputs[e, t] = windows.inputs[e, t + 1]
        windows.observed[e, t] = windows.observed[e, t + 1]
        windows.values[e, t] = windows.values[e, t + 1]
        windows.noise[e, t] = windows.noise[e, t + 1]
        windows.blocks[e, t] = windows.blocks[e, t + 1]
        windows.offsets[e, t] = windows.offsets[e, t + 1]
        windows.rows[e, t] = windows.rows[e, t + 1]
        windows.constants[e, t] = windows.constants[e, t + 1]
        windows.solution[e, t] = windows.solution[e, t + 1]
        windows.side[e, t] = windows.side[e, t + 1]


@njit(cache=True, error_model="numpy")
def _physical(road: RoadArrays, filters: Filters, point: FloatArray) -> FloatArray:
    """Return the state in the cone nearest to a normalised point."""
    state = np.empty(filters.means.shape[1])
    for i in range(state.size):
        unit = filters.density_scale if i % 2 == 0 else filters.density_scale * road.free_flow_speed
        state[i] = point[i] * unit
    project(road, state, False)
    return state


@njit(cache=True, error_model="numpy")
def _linearise_step(
    road: RoadArrays, filters: Filters, windows: Windows, e: int, t: int, point: FloatArray
) -> None:
    scale, v_f = filters.density_scale, road.free_flow_speed
    state = _physical(road, filters, point)
    offsets, blocks = windows.offsets[e, t], windows.blocks[e, t]
    advance(road, state, windows.inputs[e, t], offsets, blocks, make_scratch(road))
    for c in range(road.jam.size):
        for slot in range(road.degree[c]):
            b, block = road.neighbours[c, slot], blocks[c, slot]
            offsets[2 * c] -= block[0] * state[2 * b] + block[1] * state[2 * b + 1]
            offsets[2 * c + 1] -= block[2] * state[2 * b] + block[3] * state[2 * b + 1]
            block[1] *= v_f
            block[2] /= v_f
        offsets[2 * c] /= scale
        offsets[2 * c + 1] /= scale * v_f


@njit(cache=True, error_model="numpy")
def _linearise_measurement(
    road: RoadArrays, filters: Filters, windows: Windows, e: int, t: int, point: FloatArray
) -> None:
    scale, unit = filters.density_scale, road.second_scale
    state = _physical(road, filters, point)
    for s in range(road.jam.size):
        rho, psi = state[2 * s], state[2 * s + 1]
        second, by_rho, by_psi = released(road, s, rho, psi)
        windows.rows[e, t, s, 0] = by_rho * scale / unit
        windows.rows[e, t, s, 1] = by_psi * scale * road.free_flow_speed / unit
        windows.constants[e, t, s] = (second - by_rho * rho - by_psi * psi) / unit


@njit(cache=True, error_model="numpy", nogil=True)
def update(
    road_: Packed,
    filters_: Packed,
    windows_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
) -> None:
    """Update by measurements, `sigma` no less than allowed; see `Estimator.update`."""
    road, filters, windows = RoadArrays(*road_), Filters(*filters_), Windows(*windows_)
    n_segments, capacity, width = road.jam.size, *windows.solution.shape[1:]
    scratch, active = (
        make_window_scratch(capacity, n_segments, width),
        make_active_set(capacity, width),
    )
    units = np.array([filters.density_scale, road.second_scale])
    for k in range(episodes.size):
        e = episodes[k]
        length = windows.length[e]
        last = length - 1
        windows.observed[e, last] = observed[k]
        sound = bool(np.isfinite(filters.means[e]).all())
        for s in range(n_segments):
            for j in range(2):
                value = values[k, s, j] / units[j] if observed[k, s] else 0.0
                windows.values[e, last, s, j] = value
                sound = sound and bool(np.isfinite(value))
        for j in range(2):
            windows.noise[e, last, j] = (sigma[j] / units[j]) ** 2
        if windows.along:
            for t in range(length):
                point = windows.solution[e, t]
                _linearise_measurement(road, filters, windows, e, t, point)
                if t < last:
                    _linearise_step(road, filters, windows, e, t, point)
        chain = _chain(filters, windows, e)
        windows.unsolved[e] = False
        if sound and factorise(road, chain, length, scratch):
            filters.covariances[e] = scratch.factors[last]
            _innovate(road, filters, windows, e, scratch.before)
            if observed[k].any():
                active.side[:] = windows.side[e]
                z = windows.solution[e].copy()
                windows.unsolved[e] = not minimise(
                    road, chain, length, scratch, windows.lower, windows.upper, active, z
                )
                if not windows.unsolved[e]:
                    windows.side[e] = active.side
                    accept(road, filters, windows, e, z)
            # An optimum that is not finite has no residual and counts as unsolved.
            sound = bool(np.isfinite(filters.covariances[e]).all())
        else:
            sound = False
        filters.diverged[e] = not sound
        if not sound:
            restart(road_, filters_, windows_, e)


@njit(cache=True, error_model="numpy")
def _chain(filters: Filters, windows: Windows, e: int) -> Chain:
    return Chain(
        windows.predicted[e, 0],
        windows.arrival_variance[e],
        filters.process_variance,
        windows.blocks[e],
        windows.offsets[e],
        windows.observed[e],
        windows.rows[e],
        windows.constants[e],
        windows.values[e],
        windows.noise[e],
    )


@njit(cache=True, error_model="numpy")
def accept(road: RoadArrays, filters: Filters, windows: Windows, e: int, z: FloatArray) -> None:
    """Accept a solution `(L, padded)`, whose last state is the estimate."""
    windows.solution[e] = z
    last, scale = windows.length[e] - 1, filters.density_scale
    for i in range(filters.means.shape[1]):
        unit = scale if i % 2 == 0 else scale * road.free_flow_speed
        filters.means[e, i] = z[last, i] * unit
    project(road, filters.means[e], filters.is_box)


@njit(cache=True, error_model="numpy")
def _innovate(
    road: RoadArrays, filters: Filters, windows: Windows, e: int, before: FloatArray
) -> None:
    """Write residuals at the prediction over the deviations that the window expects."""
    last = windows.length[e] - 1
    scale, unit = filters.density_scale, road.second_scale
    innovations, noise = filters.innovations[e], windows.noise[e, last]
    innovations[:] = 0.0
    for s in range(road.jam.size):
        if not windows.observed[e, last, s]:
            continue
        rho, psi = filters.means[e, 2 * s], filters.means[e, 2 * s + 1]
        expected, _, _ = released(road, s, rho, psi)
        by_rho, by_psi = windows.rows[e, last, s]
        variance = variance_along(before, s, by_rho, by_psi)
        density, second = windows.values[e, last, s]
        innovations[s, 0] = (density - rho / scale) / np.sqrt(before[2 * s, 2 * s] + noise[0])
        innovations[s, 1] = (second - expected / unit) / np.sqrt(variance + noise[1])
