"""Compiled windows of the moving horizon estimator: their stages, and how these are linearised."""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators.compiled.chain import Chain
from dptse_env.estimators.compiled.ekf_kernels import Filters
from dptse_env.model.network import RoadArrays
from dptse_env.model.step import advance, make_scratch, normalise, project, released
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernel_loops import copy_blocks, copy_matrix, copy_vector
from dptse_env.utils.kernels import kernel_part

UNSOLVED = -1  # instead of a number of rounds


class Windows(NamedTuple):
    """Windows of n episodes, up to L = N + 2 stages each; normalised but for inputs and centres.

    A prediction makes a full window one stage longer, until the update drops the oldest one.
    """

    length: IntArray  # (n,) stages in use
    # (n,) stages at the last update, for its covariance; 0 once that is written, or without one
    updated: IntArray
    arrival_variance: FloatArray  # (n, n_x) in use
    predicted: FloatArray  # (n, L, n_x) predictions of stages; the first is the arrival's mean
    inputs: FloatArray  # (n, L, n_u) of the step that leaves each stage
    process_variance: FloatArray  # (n, L, n_x) likewise
    blocks: FloatArray  # (n, L, S, K, 4) likewise
    by_factor: FloatArray  # (n, L, E, 2) likewise, of the demand factors; E = 0 without
    offsets: FloatArray  # (n, L, n_x) likewise
    observed: BoolArray  # (n, L, M)
    values: FloatArray  # (n, L, M, 2)
    noise: FloatArray  # (n, L, M, 2)
    centre: FloatArray  # (n, L, S) v_0 [km/h] of each stage's flows, NaN where they are speeds
    slopes: FloatArray  # (n, L, S, 2)
    constants: FloatArray  # (n, L, S)
    # (n, padded) where the last stage's measurement is linearised, unless along the solution
    point: FloatArray
    solution: FloatArray  # (n, L, padded)
    side: IntArray  # (n, L, padded) bound at which each variable was last, for the active set
    rounds: IntArray  # (n,) rounds that the last program took, or UNSOLVED
    moving_variance: FloatArray  # (n_x,) arrival variance of a window that moves
    lower: FloatArray  # (n_x,)
    upper: FloatArray  # (n_x,)
    units: FloatArray  # (n_x,) of normalised states
    along: bool  # whether to linearise along the last solution


@kernel_part
def enter(filters: Filters, windows: Windows, e: int, t: int) -> None:
    """Add the mean as a stage without measurements."""
    for i in range(windows.units.size):
        windows.predicted[e, t, i] = filters.means[e, i] / windows.units[i]
        windows.solution[e, t, i] = windows.predicted[e, t, i]
    windows.observed[e, t] = False
    windows.side[e, t] = 0
    windows.noise[e, t] = 1.0


@kernel_part(kept=True)
def shift(windows: Windows, e: int) -> None:
    """Drop the oldest stage."""
    windows.length[e] -= 1
    copy_vector(windows.moving_variance, windows.arrival_variance[e])
    for t in range(windows.solution.shape[1] - 1):
        copy_vector(windows.predicted[e, t + 1], windows.predicted[e, t])
        copy_vector(windows.inputs[e, t + 1], windows.inputs[e, t])
        copy_vector(windows.process_variance[e, t + 1], windows.process_variance[e, t])
        copy_blocks(windows.blocks[e, t + 1], windows.blocks[e, t])
        copy_matrix(windows.by_factor[e, t + 1], windows.by_factor[e, t])
        copy_vector(windows.offsets[e, t + 1], windows.offsets[e, t])
        copy_vector(windows.observed[e, t + 1], windows.observed[e, t])
        copy_matrix(windows.values[e, t + 1], windows.values[e, t])
        copy_matrix(windows.noise[e, t + 1], windows.noise[e, t])
        copy_vector(windows.centre[e, t + 1], windows.centre[e, t])
        copy_matrix(windows.slopes[e, t + 1], windows.slopes[e, t])
        copy_vector(windows.constants[e, t + 1], windows.constants[e, t])
        copy_vector(windows.solution[e, t + 1], windows.solution[e, t])
        copy_vector(windows.side[e, t + 1], windows.side[e, t])


@kernel_part
def _physical(road: RoadArrays, windows: Windows, point: FloatArray) -> FloatArray:
    """Return the state in the cone nearest to a normalised point."""
    state = np.empty(windows.units.size)
    for i in range(state.size):
        state[i] = point[i] * windows.units[i]
    project(road, state, False)
    return state


@kernel_part(kept=True)
def linearise_step(
    road: RoadArrays, filters: Filters, windows: Windows, e: int, t: int, point: FloatArray
) -> None:
    """Linearise the step that leaves a stage, at the physical state nearest to a point."""
    n, scale, v_f = 2 * road.jam.size, filters.density_scale, road.free_flow_speed
    state, scratch = _physical(road, windows, point), make_scratch(road)
    offsets, blocks, by_factor = windows.offsets[e, t], windows.blocks[e, t], scratch.by_factor
    advance(road, state, windows.inputs[e, t], offsets, blocks, scratch)
    for i in range(n, state.size):
        c, slopes = road.entries[i - n], by_factor[i - n]
        offsets[2 * c] -= slopes[0] * state[i]
        offsets[2 * c + 1] -= slopes[1] * state[i]
        offsets[i] = 0.0
    for c in range(road.jam.size):
        for slot in range(road.degree[c]):
            b, block = road.neighbours[c, slot], blocks[c, slot]
            offsets[2 * c] -= block[0] * state[2 * b] + block[1] * state[2 * b + 1]
            offsets[2 * c + 1] -= block[2] * state[2 * b] + block[3] * state[2 * b + 1]
        offsets[2 * c] /= scale
        offsets[2 * c + 1] /= scale * v_f
    normalise(road, scale, blocks, by_factor)
    copy_matrix(by_factor[: state.size - n], windows.by_factor[e, t])


@kernel_part
def linearise_measurement(
    road: RoadArrays, filters: Filters, windows: Windows, e: int, t: int, point: FloatArray
) -> None:
    """Linearise the second number of every segment, at the physical state nearest to a point."""
    scale, unit = filters.density_scale, road.second_scale
    state = _physical(road, windows, point)
    for s in range(road.jam.size):
        rho, psi = state[2 * s], state[2 * s + 1]
        second, by_rho, by_psi = released(road, s, rho, psi, windows.centre[e, t, s])
        windows.slopes[e, t, s, 0] = by_rho * scale / unit
        windows.slopes[e, t, s, 1] = by_psi * scale * road.free_flow_speed / unit
        windows.constants[e, t, s] = (second - by_rho * rho - by_psi * psi) / unit


@kernel_part
def chain_of(windows: Windows, e: int) -> Chain:
    """Return the linearised window of an episode; its arrays are views."""
    return Chain(
        windows.predicted[e, 0],
        windows.arrival_variance[e],
        windows.process_variance[e],
        windows.blocks[e],
        windows.by_factor[e],
        windows.offsets[e],
        windows.observed[e],
        windows.slopes[e],
        windows.constants[e],
        windows.values[e],
        windows.noise[e],
    )
