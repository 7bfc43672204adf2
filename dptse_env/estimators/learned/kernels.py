"""The step of a recurrent network, compiled, for blocks of episodes."""

import numpy as np

from dptse_env.estimators.learned.cells import DENSITY_RANGE, N_FIXED, SPEED_RANGE, Cells
from dptse_env.estimators.learned.channels import (
    CHANNELS,
    LARGEST_CORRECTION,
    LARGEST_INNOVATION,
    LARGEST_SIGMA,
    LEAST_SIGMA,
    LEAST_VARIANCE,
    LONGEST_AGE,
)
from dptse_env.estimators.learned.network import (
    HIGHEST_SPREAD,
    LOWEST_SPREAD,
    Float32Array,
    Network,
)
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import inline_part, kernel, kernel_part

N_CHANNELS = len(CHANNELS)
_ONE, _TWO, _HALF = np.float32(1.0), np.float32(2.0), np.float32(0.5)


@kernel
def read(
    cells: Cells,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
    inputs: FloatArray,
    present: FloatArray,
    age: FloatArray,
    innovations: FloatArray,
    x: Float32Array,
) -> None:
    """Write the channels of all cells, and innovations; count the age of measurements on.

    Args:
        cells: The road.
        episodes: Shape (k,).
        observed: Shape (k, M).
        values: Shape (k, M, 2).
        sigma: Shape (k, M, 2).
        centre: Shape (k, S).
        inputs: Inputs of the last prediction, shape (n, n_u).
        present: Predictions and their deviations, shape (n, S, 4).
        age: Seconds since the last measurement, shape (n, S), updated.
        innovations: Shape (n, M, 2), updated.
        x: Output, shape (k, S, C or more).
    """
    S = cells.lanes.size
    sums, second = np.empty((S, 10)), np.empty((S, 4))
    outside = np.empty((S, 2))
    for i in range(episodes.size):
        episode = episodes[i]
        prior = present[episode]
        sums[:], outside[:] = 0.0, 0.0
        innovations[episode] = 0.0
        for s in range(S):
            _predict_second(cells.flows, centre[i, s], prior[s], second[s])
        for m in range(cells.row_first.size):
            if observed[i, m]:
                first, span = cells.row_first[m], cells.row_span[m]
                covered = slice(first, first + span)
                _read_row(
                    values[i, m], sigma[i, m], prior[covered], second[covered], sums[covered],
                    innovations[episode, m],
                )  # fmt: skip
        for e in range(cells.entries.size):
            s = cells.entries[e]
            outside[s, 0] = inputs[episode, cells.entry_inputs[e]] / (2000.0 * cells.lanes[s])
        for e in range(cells.exits.size):
            outside[cells.exits[e], 1] = inputs[episode, cells.exit_inputs[e]] / cells.exit_units[e]
        for s in range(S):
            row = x[i, s]
            _write(cells, s, prior[s], second[s], sums[s], age[episode, s], row)
            row[18], row[19] = outside[s, 0], outside[s, 1]
            for j in range(N_FIXED):
                row[20 + j] = cells.fixed[s, j]
            age[episode, s] = 0.0 if sums[s, 0] > 0.0 else age[episode, s] + 1.0


@inline_part
def _predict_second(flows: bool, centre: float, prior: FloatArray, second: FloatArray) -> None:
    """Write the second number of a cell, its variance, and its derivatives by speed and density."""
    rho, v = prior[0], prior[1]
    by_speed, slip = (rho, v - centre) if flows else (1.0, 0.0)
    second[0] = rho * slip if flows else v
    second[1] = (by_speed * prior[3]) ** 2 + (slip * prior[2]) ** 2
    second[2], second[3] = by_speed, slip


@inline_part
def _read_row(
    values: FloatArray,
    sigma: FloatArray,
    prior: FloatArray,
    second: FloatArray,
    sums: FloatArray,
    innovation: FloatArray,
) -> None:
    """Write the innovation of a row, and add what it says to the sums of the cells it covers."""
    span = len(prior)
    share = 1.0 / span
    for j in range(2):
        mean, variance = 0.0, 0.0
        for s in range(span):
            mean += prior[s, 0] if j == 0 else second[s, 0]
            variance += prior[s, 2] ** 2 if j == 0 else second[s, 1]
        variance = max(variance * share**2 + sigma[j] ** 2, LEAST_VARIANCE)
        error = values[j] - mean * share
        innovation[j] = error / np.sqrt(variance)
        for s in range(span):
            sums[s, 2 + j] += np.log(_held(sigma[j], LEAST_SIGMA, LARGEST_SIGMA))
            sums[s, 4 + j] += innovation[j]
            sums[s, 6 + j] += share / variance * error
            sums[s, 8 + j] += share**2 / variance
    for s in range(span):
        sums[s, 0] += 1.0
        sums[s, 1] += share


@inline_part
def _write(
    cells: Cells,
    s: int,
    prior: FloatArray,
    second: FloatArray,
    sums: FloatArray,
    age: float,
    row: Float32Array,
) -> None:
    """Write the channels of a cell that `channels.read_rows` gives."""
    unit, limit, flows = cells.unit[s], cells.limit, 1.0 if cells.flows else 0.0
    by_speed, slip = second[2], second[3]
    density_variance, speed_variance = prior[2] ** 2, prior[3] ** 2
    count = sums[0]
    queried, each = min(count, 1.0), 1.0 / max(count, 1.0)
    log_unit = np.log(unit)
    row[0], row[1] = queried, sums[1]
    row[2] = 0.2 * (sums[2] * each - queried * log_unit)
    row[3] = 0.2 * (sums[3] * each - queried * (flows * log_unit + np.log(limit)))
    row[4], row[5] = prior[0] / unit, prior[1] / limit
    row[6], row[7] = 0.25 * np.log(prior[2] / unit), 0.25 * np.log(prior[3] / limit)
    for j in range(2):
        row[8 + j] = 0.5 * _held(sums[4 + j], -LARGEST_INNOVATION, LARGEST_INNOVATION)
    row[10] = 4.0 * _correction(density_variance * sums[6] / unit)
    row[11] = 4.0 * _correction(slip * density_variance * sums[7] / unit)
    row[12] = 4.0 * _correction(by_speed * speed_variance * sums[7] / limit)
    row[13] = min(density_variance * sums[8], 1.0)
    row[14] = min(by_speed**2 * speed_variance * sums[9], 1.0)
    row[15], row[16] = slip / limit, flows
    row[17] = 0.25 * np.log(1.0 + min(age, LONGEST_AGE))


@inline_part
def _correction(value: float) -> float:
    held: float = _held(value, -LARGEST_CORRECTION, LARGEST_CORRECTION)
    return held


@kernel
def advance(
    cells: Cells,
    network: Network,
    episodes: IntArray,
    x: Float32Array,
    hidden: Float32Array,
    present: FloatArray,
    ahead: FloatArray,
) -> None:
    """Advance the hidden states, and write what the heads read from them.

    Args:
        cells: The road.
        network: The weights.
        episodes: Shape (k,).
        x: Shape (k, S, C + 2 M): the channels, and space for sums of messages.
        hidden: Hidden states, shape (n, S, H), updated.
        present: Estimates and deviations of this second, shape (n, S, 4), updated.
        ahead: Those of the next second before its release, shape (n, S, 4), updated.
    """
    S, H = cells.lanes.size, network.hidden.shape[0]
    M = (network.inputs.shape[0] - N_CHANNELS) // 2
    g, q = np.empty((S, 3 * H), dtype=np.float32), np.empty((S, 3 * H), dtype=np.float32)
    raw = np.empty((S, network.heads.shape[1]), dtype=np.float32)
    # One product for each episode: its bits then do not depend on the batch that it is in.
    for i in range(episodes.size):
        h = hidden[episodes[i]]
        x[i, :, N_CHANNELS:] = 0.0
        for e in range(cells.edges.shape[0]):
            start, end = cells.edges[e, 0], cells.edges[e, 1]
            for j in range(M):
                x[i, end, N_CHANNELS + j] += h[start, j]
                x[i, start, N_CHANNELS + M + j] += h[end, j]
        np.dot(x[i], network.inputs, g)
        np.dot(h, network.hidden, q)
        for s in range(S):
            _gate(g[s], q[s], network.inputs_bias, network.hidden_bias, h[s])
        np.dot(h, network.heads, raw)
        for s in range(S):
            row = raw[s]
            unit, limit = cells.unit[s], cells.limit
            _read_heads(row[0:4], network.heads_bias[0:4], unit, limit, present[episodes[i], s])
            _read_heads(row[4:8], network.heads_bias[4:8], unit, limit, ahead[episodes[i], s])


@kernel_part(fastmath={"contract"})
def _gate(
    g: Float32Array, q: Float32Array, g_bias: Float32Array, q_bias: Float32Array, h: Float32Array
) -> None:
    """Move the hidden state of a cell."""
    H = h.size
    for j in range(H):
        z = _HALF + _HALF * _tanh(_HALF * (g[j] + g_bias[j] + q[j] + q_bias[j]))
        reset = g[H + j] + g_bias[H + j] + q[H + j] + q_bias[H + j]
        r = _HALF + _HALF * _tanh(_HALF * reset)
        memory = q[2 * H + j] + q_bias[2 * H + j]
        candidate = _tanh(g[2 * H + j] + g_bias[2 * H + j] + r * memory)
        h[j] = z * h[j] + (_ONE - z) * candidate


@inline_part
def _tanh(x: np.float32) -> np.float32:
    """Return tanh to some 1e-7, as an expression that compiles to vector instructions.

    Lambert's continued fraction at a quarter of the argument, and twice the formula of the double
    argument.
    """
    y = np.float32(0.25) * min(max(x, np.float32(-9.0)), np.float32(9.0))
    s = y * y
    upper = np.float32(10395.0) + s * (np.float32(1260.0) + np.float32(21.0) * s)
    lower = np.float32(10395.0) + s * (np.float32(4725.0) + s * (np.float32(210.0) + s))
    t = y * upper / lower
    t = _TWO * t / (_ONE + t * t)
    return _TWO * t / (_ONE + t * t)


@kernel_part
def _read_heads(
    raw: Float32Array, bias: Float32Array, unit: float, limit: float, out: FloatArray
) -> None:
    """Write density, speed and their deviations."""
    out[0] = DENSITY_RANGE * unit * (0.5 + 0.5 * np.tanh(0.5 * float(raw[0] + bias[0])))
    out[1] = SPEED_RANGE * limit * (0.5 + 0.5 * np.tanh(0.5 * float(raw[1] + bias[1])))
    out[2] = unit * np.exp(_held(float(raw[2] + bias[2]), LOWEST_SPREAD, HIGHEST_SPREAD))
    out[3] = limit * np.exp(_held(float(raw[3] + bias[3]), LOWEST_SPREAD, HIGHEST_SPREAD))


@inline_part
def _held(x: float, low: float, high: float) -> float:
    held: float = min(max(x, low), high)
    return held
