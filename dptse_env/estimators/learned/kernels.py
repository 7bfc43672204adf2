"""The step of a recurrent network, compiled, for blocks of episodes."""

import numpy as np
from numba import njit

from dptse_env.estimators.learned.cells import (
    CHANNELS,
    DENSITY_RANGE,
    LEAST_DENSITY,
    LONGEST_AGE,
    N_FIXED,
    SPEED_RANGE,
    Cells,
)
from dptse_env.estimators.learned.network import (
    HIGHEST_SPREAD,
    LOWEST_SPREAD,
    Float32Array,
    Network,
)
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

N_CHANNELS = len(CHANNELS)
_ONE, _TWO, _HALF = np.float32(1.0), np.float32(2.0), np.float32(0.5)


@njit(cache=True, error_model="numpy", nogil=True)
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
    weight, total = np.empty((S, 2)), np.empty((S, 2))
    best, shares = np.empty(S), np.empty((S, 3))
    outside = np.empty((S, 2))
    for i in range(episodes.size):
        episode = episodes[i]
        prior = present[episode]
        weight[:], total[:], best[:], shares[:], outside[:] = 0.0, 0.0, 0.0, 0.0, 0.0
        innovations[episode] = 0.0
        for m in range(cells.row_first.size):
            if not observed[i, m]:
                continue
            _innovation(cells, m, values[i, m], sigma[i, m], centre[i], prior, innovations[episode])
            first, span = cells.row_first[m], cells.row_span[m]
            for s in range(first, first + span):
                for j in range(2):
                    own = 1.0 / max(sigma[i, m, j], 1e-12) ** 2
                    weight[s, j] += own
                    total[s, j] += own * values[i, m, j]
                    if j == 0 and own > best[s]:
                        best[s] = own
                        shares[s, 0] = np.log(span)
                        shares[s, 1] = 1.0 if s > first else 0.0
                        shares[s, 2] = 1.0 if s < first + span - 1 else 0.0
        for e in range(cells.entries.size):
            s = cells.entries[e]
            outside[s, 0] = inputs[episode, cells.entry_inputs[e]] / (2000.0 * cells.lanes[s])
        for e in range(cells.exits.size):
            outside[cells.exits[e], 1] = inputs[episode, cells.exit_inputs[e]] / cells.exit_units[e]
        for s in range(S):
            row = x[i, s]
            _write(cells, s, weight[s], total[s], centre[i, s], prior[s], row)
            row[11], row[12], row[13] = shares[s, 0], shares[s, 1], shares[s, 2]
            row[14] = 0.25 * np.log(1.0 + min(age[episode, s], LONGEST_AGE))
            row[17], row[18] = outside[s, 0], outside[s, 1]
            for j in range(N_FIXED):
                row[19 + j] = cells.fixed[s, j]
            age[episode, s] = 0.0 if weight[s, 0] > 0.0 else age[episode, s] + 1.0


@njit(cache=True, error_model="numpy")
def _write(
    cells: Cells,
    s: int,
    weight: FloatArray,
    total: FloatArray,
    centre: float,
    prior: FloatArray,
    row: Float32Array,
) -> None:
    """Write the channels that a measurement of a cell gives."""
    unit, limit = cells.unit[s], cells.limit
    density = prior[0] / unit
    row[0:10] = 0.0
    row[10] = 1.0 if cells.flows else 0.0
    row[15], row[16] = density, prior[1] / limit
    if cells.flows:
        row[5] = centre / limit
    if not weight[0] > 0.0:
        return
    row[0] = 1.0
    row[1] = _held(total[0] / weight[0] / unit, -8.0, 8.0)
    row[2] = _log(1.0 / np.sqrt(weight[0]) / unit)
    second, deviation = total[1] / weight[1] / limit, 1.0 / np.sqrt(weight[1]) / limit
    if cells.flows:
        carrier = max(density, LEAST_DENSITY)
        row[3], row[4] = _held(second / unit, -4.0, 4.0), _log(deviation / unit)
        row[6] = _held(centre / limit + second / unit / carrier, -1.0, 2.0)
        row[7] = _log(deviation / unit / carrier)
    else:
        row[6], row[7] = _held(second, -1.0, 2.0), _log(deviation)
    row[8], row[9] = row[1] - density, row[6] - prior[1] / limit


@njit(cache=True, error_model="numpy")
def _innovation(
    cells: Cells,
    m: int,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray,
    prior: FloatArray,
    innovations: FloatArray,
) -> None:
    """Write the residuals of a row over their predicted deviations, errors taken as independent."""
    first, span = cells.row_first[m], cells.row_span[m]
    density, second = 0.0, 0.0
    variance, second_variance = sigma[0] ** 2, sigma[1] ** 2
    for s in range(first, first + span):
        rho, v, rho_std, v_std = prior[s, 0], prior[s, 1], prior[s, 2], prior[s, 3]
        density += rho / span
        variance += (rho_std / span) ** 2
        if cells.flows:
            second += rho * (v - centre[s]) / span
            second_variance += ((rho * v_std) ** 2 + ((v - centre[s]) * rho_std) ** 2) / span**2
        else:
            second += v / span
            second_variance += (v_std / span) ** 2
    innovations[m, 0] = (values[0] - density) / np.sqrt(max(variance, 1e-12))
    innovations[m, 1] = (values[1] - second) / np.sqrt(max(second_variance, 1e-12))


@njit(cache=True, error_model="numpy", nogil=True)
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
        x: Shape (k, S, C + 2 H): the channels, and space for sums of hidden states.
        hidden: Hidden states, shape (n, S, H), updated.
        present: Estimates and deviations of this second, shape (n, S, 4), updated.
        ahead: Those of the next second before its release, shape (n, S, 4), updated.
    """
    S, H = cells.lanes.size, network.hidden.shape[0]
    g, q = np.empty((S, 3 * H), dtype=np.float32), np.empty((S, 3 * H), dtype=np.float32)
    raw = np.empty((S, network.heads.shape[1]), dtype=np.float32)
    # One product for each episode: its bits then do not depend on the batch that it is in.
    for i in range(episodes.size):
        h = hidden[episodes[i]]
        x[i, :, N_CHANNELS:] = 0.0
        for e in range(cells.edges.shape[0]):
            start, end = cells.edges[e, 0], cells.edges[e, 1]
            for j in range(H):
                x[i, end, N_CHANNELS + j] += h[start, j]
                x[i, start, N_CHANNELS + H + j] += h[end, j]
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


@njit(cache=True, error_model="numpy", fastmath={"contract"})
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


@njit(cache=True, error_model="numpy", inline="always")
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


@njit(cache=True, error_model="numpy")
def _read_heads(
    raw: Float32Array, bias: Float32Array, unit: float, limit: float, out: FloatArray
) -> None:
    """Write density, speed and their deviations."""
    out[0] = DENSITY_RANGE * unit * (0.5 + 0.5 * np.tanh(0.5 * float(raw[0] + bias[0])))
    out[1] = SPEED_RANGE * limit * (0.5 + 0.5 * np.tanh(0.5 * float(raw[1] + bias[1])))
    out[2] = unit * np.exp(_held(float(raw[2] + bias[2]), LOWEST_SPREAD, HIGHEST_SPREAD))
    out[3] = limit * np.exp(_held(float(raw[3] + bias[3]), LOWEST_SPREAD, HIGHEST_SPREAD))


@njit(cache=True, error_model="numpy", inline="always")
def _held(x: float, low: float, high: float) -> float:
    held: float = min(max(x, low), high)
    return held


@njit(cache=True, error_model="numpy", inline="always")
def _log(deviation: float) -> float:
    half: float = 0.5 * np.log(_held(deviation, 1e-3, 20.0))
    return half
