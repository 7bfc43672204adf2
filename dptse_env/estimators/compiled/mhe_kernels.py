"""Compiled kernels of the moving horizon estimator: a batch of episodes, one after the other."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from dptse_env.estimators.compiled import ekf_kernels as kernels
from dptse_env.estimators.compiled.active_set import held_for, minimise
from dptse_env.estimators.compiled.ekf_kernels import Filters, project, released
from dptse_env.estimators.compiled.window import Chain, factorise, space_for
from dptse_env.model.kernels import advance, scratch_of
from dptse_env.model.road_arrays import Road
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

Packed = tuple[Any, ...]


class Horizons(NamedTuple):
    """Windows of n episodes, up to L = N + 1 stages each; normalised but for the inputs.

    Attributes:
        length: `(n,)` stages in use.
        arrival_variance: `(n, 2)` in use.
        predicted: `(n, L, 2 S)` each stage's prediction, the first one the arrival's mean.
        inputs: `(n, L, n_u)` of the step that leaves each stage.
        observed: `(n, L, S)`.
        values: `(n, L, S, 2)`.
        noise: `(n, L, 2)`.
        blocks: `(n, L, S, K, 4)` of the step that leaves each stage.
        offsets: `(n, L, 2 S)` likewise.
        rows: `(n, L, S, 2)`.
        constants: `(n, L, S)`.
        solution: `(n, L, padded)`.
        side: `(n, L, padded)` which bound each variable was last held at.
        unsolved: `(n,)` whether the active set found no optimum.
        moving_variance: `(2,)` arrival variance of a window that moves.
        lower: `(2 S,)`.
        upper: `(2 S,)`.
        along: Whether to linearise along the last solution.
    """

    length: IntArray
    arrival_variance: FloatArray
    predicted: FloatArray
    inputs: FloatArray
    observed: BoolArray
    values: FloatArray
    noise: FloatArray
    blocks: FloatArray
    offsets: FloatArray
    rows: FloatArray
    constants: FloatArray
    solution: FloatArray
    side: IntArray
    unsolved: BoolArray
    moving_variance: FloatArray
    lower: FloatArray
    upper: FloatArray
    along: bool


@njit(cache=True, error_model="numpy")
def restart(road_: Packed, filters_: Packed, horizons_: Packed, episode: int) -> None:
    """Put one episode to a window of one stage, its prior."""
    road, filters, horizons = Road(*road_), Filters(*filters_), Horizons(*horizons_)
    kernels.restart(filters, episode)
    horizons.length[episode] = 1
    horizons.arrival_variance[episode] = filters.initial_variance
    _enter(road, filters, horizons, episode, 0)
    _linearise_measurement(road, filters, horizons, episode, 0, horizons.solution[episode, 0])
    horizons.unsolved[episode] = False


@njit(cache=True, error_model="numpy")
def _enter(road: Road, filters: Filters, horizons: Horizons, e: int, t: int) -> None:
    """Let the mean be a new stage, without measurements."""
    scale = filters.density_scale
    for i in range(filters.means.shape[1]):
        unit = scale if i % 2 == 0 else scale * road.free_flow_speed
        horizons.predicted[e, t, i] = filters.means[e, i] / unit
        horizons.solution[e, t, i] = horizons.predicted[e, t, i]
    horizons.observed[e, t] = False
    horizons.side[e, t] = 0
    horizons.noise[e, t] = 1.0


@njit(cache=True, error_model="numpy", nogil=True)
def predict(
    road_: Packed, filters_: Packed, horizons_: Packed, episodes: IntArray, inputs: FloatArray
) -> None:
    """Append the model's prediction, under inputs `(k, n_u)`, to each window."""
    road, filters, horizons = Road(*road_), Filters(*filters_), Horizons(*horizons_)
    scratch = scratch_of(road)
    blocks = np.empty((*road.neighbours.shape, 4))
    state = np.empty(filters.means.shape[1])
    centre = np.empty(horizons.solution.shape[2])
    capacity = horizons.solution.shape[1]
    for k in range(episodes.size):
        e = episodes[k]
        length = horizons.length[e]
        centre[:] = 0.0
        for t in range(length):
            centre += horizons.solution[e, t]
        centre /= length
        state[:] = filters.means[e]
        project(road, state, False)
        advance(road, state, inputs[k], state, blocks, scratch)
        project(road, state, filters.is_box)
        filters.means[e] = state
        horizons.inputs[e, length - 1] = inputs[k]
        if not horizons.along:
            _linearise_step(road, filters, horizons, e, length - 1, centre)
        if length == capacity:
            _shift(horizons, e)
            length -= 1
        horizons.length[e] = length + 1
        _enter(road, filters, horizons, e, length)
        if not horizons.along:
            _linearise_measurement(road, filters, horizons, e, length, centre)


@njit(cache=True, error_model="numpy")
def _shift(horizons: Horizons, e: int) -> None:
    """Forget the oldest stage."""
    horizons.arrival_variance[e] = horizons.moving_variance
    for t in range(horizons.solution.shape[1] - 1):
        horizons.predicted[e, t] = horizons.predicted[e, t + 1]
        horizons.inputs[e, t] = horizons.inputs[e, t + 1]
        horizons.observed[e, t] = horizons.observed[e, t + 1]
        horizons.values[e, t] = horizons.values[e, t + 1]
        horizons.noise[e, t] = horizons.noise[e, t + 1]
        horizons.blocks[e, t] = horizons.blocks[e, t + 1]
        horizons.offsets[e, t] = horizons.offsets[e, t + 1]
        horizons.rows[e, t] = horizons.rows[e, t + 1]
        horizons.constants[e, t] = horizons.constants[e, t + 1]
        horizons.solution[e, t] = horizons.solution[e, t + 1]
        horizons.side[e, t] = horizons.side[e, t + 1]


@njit(cache=True, error_model="numpy")
def _physical(road: Road, filters: Filters, point: FloatArray) -> FloatArray:
    """The state in the cone nearest to a normalised point."""
    state = np.empty(filters.means.shape[1])
    for i in range(state.size):
        unit = filters.density_scale if i % 2 == 0 else filters.density_scale * road.free_flow_speed
        state[i] = point[i] * unit
    project(road, state, False)
    return state


@njit(cache=True, error_model="numpy")
def _linearise_step(
    road: Road, filters: Filters, horizons: Horizons, e: int, t: int, point: FloatArray
) -> None:
    scale, v_f = filters.density_scale, road.free_flow_speed
    state = _physical(road, filters, point)
    offsets, blocks = horizons.offsets[e, t], horizons.blocks[e, t]
    advance(road, state, horizons.inputs[e, t], offsets, blocks, scratch_of(road))
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
    road: Road, filters: Filters, horizons: Horizons, e: int, t: int, point: FloatArray
) -> None:
    scale, unit = filters.density_scale, road.second_scale
    state = _physical(road, filters, point)
    for s in range(road.jam.size):
        rho, psi = state[2 * s], state[2 * s + 1]
        second, by_rho, by_psi = released(road, s, rho, psi)
        horizons.rows[e, t, s, 0] = by_rho * scale / unit
        horizons.rows[e, t, s, 1] = by_psi * scale * road.free_flow_speed / unit
        horizons.constants[e, t, s] = (second - by_rho * rho - by_psi * psi) / unit


@njit(cache=True, error_model="numpy", nogil=True)
def update(
    road_: Packed,
    filters_: Packed,
    horizons_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
) -> None:
    """Take in measurements, `sigma` no less than allowed; see `Estimator.update`."""
    road, filters, horizons = Road(*road_), Filters(*filters_), Horizons(*horizons_)
    n_segments, capacity, width = road.jam.size, *horizons.solution.shape[1:]
    space, held = space_for(capacity, n_segments, width), held_for(capacity, width)
    units = np.array([filters.density_scale, road.second_scale])
    for k in range(episodes.size):
        e = episodes[k]
        length = horizons.length[e]
        last = length - 1
        horizons.observed[e, last] = observed[k]
        sound = bool(np.isfinite(filters.means[e]).all())
        for s in range(n_segments):
            for j in range(2):
                value = values[k, s, j] / units[j] if observed[k, s] else 0.0
                horizons.values[e, last, s, j] = value
                sound = sound and bool(np.isfinite(value))
        for j in range(2):
            horizons.noise[e, last, j] = (sigma[j] / units[j]) ** 2
        if horizons.along:
            for t in range(length):
                point = horizons.solution[e, t]
                _linearise_measurement(road, filters, horizons, e, t, point)
                if t < last:
                    _linearise_step(road, filters, horizons, e, t, point)
        chain = _chain(filters, horizons, e)
        horizons.unsolved[e] = False
        if sound and factorise(road, chain, length, space):
            filters.covariances[e] = space.factors[last]
            _innovate(road, filters, horizons, e, space.before)
            if observed[k].any():
                held.side[:] = horizons.side[e]
                z = horizons.solution[e].copy()
                horizons.unsolved[e] = not minimise(
                    road, chain, length, space, horizons.lower, horizons.upper, held, z
                )
                if not horizons.unsolved[e]:
                    horizons.side[e] = held.side
                    accept(road, filters, horizons, e, z)
            # An optimum that is not finite has no residual, hence is unsolved.
            sound = bool(np.isfinite(filters.covariances[e]).all())
        else:
            sound = False
        filters.diverged[e] = not sound
        if not sound:
            restart(road_, filters_, horizons_, e)


@njit(cache=True, error_model="numpy")
def _chain(filters: Filters, horizons: Horizons, e: int) -> Chain:
    return Chain(
        horizons.predicted[e, 0],
        horizons.arrival_variance[e],
        filters.process_variance,
        horizons.blocks[e],
        horizons.offsets[e],
        horizons.observed[e],
        horizons.rows[e],
        horizons.constants[e],
        horizons.values[e],
        horizons.noise[e],
    )


@njit(cache=True, error_model="numpy")
def accept(road: Road, filters: Filters, horizons: Horizons, e: int, z: FloatArray) -> None:
    """Take a solution `(L, padded)`: its last state is the estimate."""
    horizons.solution[e] = z
    last, scale = horizons.length[e] - 1, filters.density_scale
    for i in range(filters.means.shape[1]):
        unit = scale if i % 2 == 0 else scale * road.free_flow_speed
        filters.means[e, i] = z[last, i] * unit
    project(road, filters.means[e], filters.is_box)


@njit(cache=True, error_model="numpy")
def _innovate(road: Road, filters: Filters, horizons: Horizons, e: int, before: FloatArray) -> None:
    """Write residuals at the prediction over the deviations that the window expects."""
    last = horizons.length[e] - 1
    scale, unit = filters.density_scale, road.second_scale
    innovations, noise = filters.innovations[e], horizons.noise[e, last]
    innovations[:] = 0.0
    for s in range(road.jam.size):
        if not horizons.observed[e, last, s]:
            continue
        rho, psi = filters.means[e, 2 * s], filters.means[e, 2 * s + 1]
        expected, _, _ = released(road, s, rho, psi)
        by_rho, by_psi = horizons.rows[e, last, s]
        a, b = before[2 * s, 2 * s], before[2 * s, 2 * s + 1]
        c = before[2 * s + 1, 2 * s + 1]
        variance = by_rho * by_rho * a + 2.0 * by_rho * by_psi * b + by_psi * by_psi * c
        density, second = horizons.values[e, last, s]
        innovations[s, 0] = (density - rho / scale) / np.sqrt(a + noise[0])
        innovations[s, 1] = (second - expected / unit) / np.sqrt(variance + noise[1])
