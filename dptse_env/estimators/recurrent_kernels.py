"""The compiled step of the recurrent network: its features, its weights and its state.

Features are made of a release as by a Kalman filter that takes the errors of different cells, and
of density and speed, as independent. Channel m of a release averages two numbers over its cells:
the density rho, and y = rho (v - centre) where flows are released, or y = v where speeds are. The
prediction of a cell has the variances P_rho, P_v and hence P_y. The innovation e_m of a channel is
its measurement less the predicted average; V_m is its variance, noise included. The gain and the
correction of a cell are, over the channels that cover it,

    K_ms = P_s / (span_m V_m)      d_s = sum_m K_ms e_m

Features are innovations over their deviations, corrections and gains. So the deviation of the
noise, which ranges over three orders of magnitude between mechanisms and budgets, is taken into
account before the network sees a release.

Every cell of a road has a gated recurrent unit (Cho et al., 2014) with the same weights. It reads
the features x of the cell, and the sums u and d of the messages of the cells upstream and
downstream: the first 16 numbers of their hidden states.

    z = sigma(W_z [x, u, d] + b_z + V_z h + c_z)
    r = sigma(W_r [x, u, d] + b_r + V_r h + c_r)
    n = tanh(W_n [x, u, d] + b_n + r * (V_n h + c_n))
    h <- z * h + (1 - z) * n

Eight linear heads of h are density, speed and the logarithms of their deviations, for this second
and for the next one before its release.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.estimators.base import Measurement
from dptse_env.model import ARZ, ARZModel
from dptse_env.model.step import clip, pressure
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, all_finite, inline_part, kernel, kernel_part

Float32Array = NDArray[np.float32]

FEATURES = (
    "queried", "share", "log_density_sigma", "log_second_sigma", "predicted_density",
    "predicted_speed", "log_density_deviation", "log_speed_deviation", "density_innovation",
    "second_innovation", "density_correction", "density_correction_by_flow", "speed_correction",
    "density_gain", "speed_gain", "slip", "flows", "log_age", "inflow", "outside_density",
    "on_ramp", "off_ramp", "entry", "exit", "lanes", "log_length", "log_limit", "equilibrium_speed",
    "own_parameters", "own_equilibrium_speed",
)  # fmt: skip
"""The features of a cell."""
N_FEATURES = len(FEATURES)

LONGEST_AGE = 300.0
"""Seconds since a measurement after which a cell counts as never measured."""
LEAST_SIGMA, LARGEST_SIGMA = 0.1, 1e6
"""Range of deviations whose logarithms are features [veh/km, km/h or veh/h]."""
LEAST_VARIANCE = 1e-12
LARGEST_INNOVATION = 6.0
"""Largest innovation among the features, in deviations."""
LARGEST_CORRECTION = 2.0
"""Largest correction among the features, in units of density or speed."""

DENSITY_UNIT = 40.0
"""Unit of densities [veh/km] for each lane, between free flow and a jam."""
DENSITY_RANGE = 4.0
"""Largest density that is estimated, in its unit: vehicles that stand, 6.25 m each."""
SPEED_RANGE, OWN_SPEED_RANGE = 1.1, 1.4
"""Largest speed that is estimated, in its unit: a limit, or a speed of a road's own parameters,
which is a mean over all vehicles."""
ORDINARY = 10.0
"""Density of a lane [veh/km] whose equilibrium speed is the unit of speeds under own parameters."""

N_FIXED = 7
"""Number of the features of a cell that never change."""

N_HEADS = 8
MESSAGE = 16
"""Numbers of a hidden state that the cells next to it read, or all where there are fewer."""
LOWEST_SPREAD, HIGHEST_SPREAD = -7.0, 0.5
"""Range of the logarithms of reported deviations, in units of density and of speed."""

_ONE, _TWO, _HALF = np.float32(1.0), np.float32(2.0), np.float32(0.5)


class Cells(NamedTuple):
    """Features of the cells of a road that never change, and their units."""

    unit: FloatArray  # (S + R,) unit of densities [veh/km]
    speed_unit: float  # unit of speeds [km/h]
    fastest: float  # largest speed that is estimated [km/h]
    flows: bool  # whether flows are released, otherwise speeds
    fixed: FloatArray  # (S, N_FIXED) features
    arz: ARZ  # numbers of the traffic model, whose equilibrium speed is a feature
    own: float  # 1 where its parameters are the road's own, 0 where they are a shipped set


def make_cells(model: ARZModel) -> Cells:
    """Return the fixed features of a model's road.

    The unit of speeds is an equilibrium speed of the road's own parameters, at `ORDINARY` traffic.
    Where there are none it is the largest speed limit. So a limit that nobody drives at makes no
    difference to a road that has been calibrated. Neither does a free-flow speed that nobody
    reaches: a search trades it for gamma and the jam density.
    """
    road, S = model.road, model.n_segments
    n_on = road.entries.size - 1
    marks = np.zeros((S, 4))
    marks[:, 0] = (road.stretch > 0) & (road.stretch <= n_on)
    marks[:, 1] = road.stretch > n_on
    marks[road.entries, 2] = 1.0
    marks[road.exits, 3] = 1.0
    lengths, lanes, limits = road.lengths[:S], road.lanes[:S], road.limits[:S]
    own = model.parameters.is_own
    ordinary = _equilibrium_speed(model.arz, 0, ORDINARY * road.lanes[0])
    speed_unit = float(ordinary if own else limits.max())
    speeds = speed_unit * limits / limits.max()
    scales = np.stack([np.log(lengths / 0.1), np.log(speeds / 100.0)], axis=1)
    return Cells(
        unit=DENSITY_UNIT * road.lanes,
        speed_unit=speed_unit,
        fastest=speed_unit * (OWN_SPEED_RANGE if own else SPEED_RANGE),
        flows=model.releases_flow,
        fixed=np.concatenate([marks, lanes[:, None] / 3.0, scales], axis=1),
        arz=model.arz,
        own=float(own),
    )


class Weights(NamedTuple):
    """Weights of a network of width H with C features and messages of M numbers, float32."""

    inputs: Float32Array  # W, (C + 2 M, 3 H)
    inputs_bias: Float32Array  # b, (3 H,)
    hidden: Float32Array  # V, (H, 3 H)
    hidden_bias: Float32Array  # c, (3 H,)
    heads: Float32Array  # (H, 8)
    heads_bias: Float32Array  # (8,)

    @property
    def width(self) -> int:
        """Width H of the hidden state."""
        return len(self.hidden)


def message_width(width: int) -> int:
    """Return the size M of a message in a network of some width."""
    return min(width, MESSAGE)


def shapes(width: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of `Weights` of some width by name."""
    n_inputs = N_FEATURES + 2 * message_width(width)
    return {
        "inputs": (n_inputs, 3 * width),
        "inputs_bias": (3 * width,),
        "hidden": (width, 3 * width),
        "hidden_bias": (3 * width,),
        "heads": (width, N_HEADS),
        "heads_bias": (N_HEADS,),
    }


class Memory(NamedTuple):
    """Predictions, estimates and inputs of n episodes that features are made of."""

    inputs: FloatArray  # (n, n_u) the model's inputs of the last prediction
    present: FloatArray  # (n, S, 4) predictions, then estimates, and their deviations
    age: FloatArray  # (n, S) seconds since the last measurement
    innovations: FloatArray  # (n, M, 2)


class State(NamedTuple):
    """State of the network in n episodes."""

    hidden: Float32Array  # (n, S, H)
    ahead: FloatArray  # (n, S, 4) `Memory.present` of the next second before its release
    priors: FloatArray  # (n, S, 4) likewise, of the first second
    diverged: BoolArray  # (n,)


@kernel
def restart(bundle: Bundle, episodes: IntArray) -> None:
    """Begin episodes `(k,)` with their priors."""
    _, _, _, memory, _, state = bundle.parts
    for e in episodes:
        _restart(memory, state, e)


@kernel_part
def _restart(memory: Memory, state: State, e: int) -> None:
    state.hidden[e] = 0.0
    memory.present[e] = state.priors[e]
    state.ahead[e] = state.priors[e]
    memory.age[e] = LONGEST_AGE
    memory.innovations[e] = 0.0


@kernel
def predict(bundle: Bundle, episodes: IntArray, inputs: FloatArray) -> None:
    """Take the prediction of the next second, and keep the inputs `(k, n_u)`."""
    _, _, _, memory, _, state = bundle.parts
    for k in range(episodes.size):
        memory.present[episodes[k]] = state.ahead[episodes[k]]
        memory.inputs[episodes[k]] = inputs[k]


@kernel
def update(bundle: Bundle, episodes: IntArray, measured: Measurement) -> None:
    """Advance the network by the releases of episodes `(k,)`."""
    road, _, _, memory, weights, state = bundle.parts
    x = np.empty((episodes.size, road.n_segments, weights.inputs.shape[0]), np.float32)
    read(bundle, episodes, measured, x)
    advance(bundle, episodes, x)
    for k in range(episodes.size):
        e = episodes[k]
        # Gates hold what is not finite to their range: the hidden state does not show it.
        sound = all_finite(memory.inputs[e]) and all_finite(state.hidden[e].reshape(-1))
        for m in range(measured.observed.shape[1]):
            sound = sound and (not measured.observed[k, m] or all_finite(measured.values[k, m]))
        state.diverged[e] = not sound
        if not sound:
            _restart(memory, state, e)


@kernel
def read(bundle: Bundle, episodes: IntArray, measured: Measurement, x: Float32Array) -> None:
    """Write the features of all cells, and innovations; update the ages of measurements.

    Args:
        bundle: Road, channels, `Cells` and `Memory`, whose age and innovations are updated; more
            parts may follow.
        episodes: Shape (k,).
        measured: The release of the k episodes.
        x: Output, shape (k, S, C or more).
    """
    road, channels, cells, memory = bundle.parts[:4]
    inputs, present, age, innovations = memory
    S = road.n_segments
    sums, second = np.empty((S, 10)), np.empty((S, 4))
    outside = np.empty((S, 2))
    for i in range(episodes.size):
        episode = episodes[i]
        prior = present[episode]
        sums[:], outside[:] = 0.0, 0.0
        innovations[episode] = 0.0
        for s in range(S):
            _predict_second(cells.flows, measured.centre[i, s], prior[s], second[s])
        for m in range(channels.first.size):
            if measured.observed[i, m]:
                first, span = channels.first[m], channels.span[m]
                covered = slice(first, first + span)
                values, sigma = measured.values[i, m], measured.sigma[i, m]
                _read_channel(
                    values, sigma, prior[covered], second[covered], sums[covered],
                    innovations[episode, m],
                )  # fmt: skip
        for e in range(road.entries.size):
            s = road.entries[e]
            outside[s, 0] = inputs[episode, road.entry_inputs[e]] / (2000.0 * road.lanes[s])
        for e in range(road.exits.size):
            density, unit = inputs[episode, road.exit_inputs[e]], cells.unit[road.exit_cells[e]]
            outside[road.exits[e], 1] = density / unit
        for s in range(S):
            row = x[i, s]
            _write(cells, s, prior[s], second[s], sums[s], age[episode, s], row)
            row[18], row[19] = outside[s, 0], outside[s, 1]
            for j in range(N_FIXED):
                row[20 + j] = cells.fixed[s, j]
            row[27] = _equilibrium_speed(cells.arz, s, prior[s, 0]) / cells.speed_unit
            row[28], row[29] = cells.own, cells.own * row[27]
            age[episode, s] = 0.0 if sums[s, 0] > 0.0 else age[episode, s] + 1.0


@kernel_part
def _equilibrium_speed(arz: ARZ, s: int, density: float) -> float:
    """Return V_e = v_f - p(rho), at which traffic of a density settles, 0 in a jam."""
    v_f = arz.free_flow_speed
    return max(v_f - pressure(density, arz.jam[s], v_f, arz.gamma), 0.0)


@inline_part
def _predict_second(flows: bool, centre: float, prior: FloatArray, second: FloatArray) -> None:
    """Write the second number of a cell, its variance, and its derivatives by speed and density."""
    rho, v = prior[0], prior[1]
    by_speed, slip = (rho, v - centre) if flows else (1.0, 0.0)
    second[0] = rho * slip if flows else v
    second[1] = (by_speed * prior[3]) ** 2 + (slip * prior[2]) ** 2
    second[2], second[3] = by_speed, slip


@inline_part
def _read_channel(
    values: FloatArray,
    sigma: FloatArray,
    prior: FloatArray,
    second: FloatArray,
    sums: FloatArray,
    innovation: FloatArray,
) -> None:
    """Write the innovation of a channel, and add its terms to the sums of its cells."""
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
            sums[s, 2 + j] += np.log(clip(sigma[j], LEAST_SIGMA, LARGEST_SIGMA))
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
    """Write the features of a cell, from the sums over the channels that cover it."""
    unit, speed_unit, flows = cells.unit[s], cells.speed_unit, 1.0 if cells.flows else 0.0
    by_speed, slip = second[2], second[3]
    density_variance, speed_variance = prior[2] ** 2, prior[3] ** 2
    count = sums[0]
    queried, each = min(count, 1.0), 1.0 / max(count, 1.0)
    log_unit = np.log(unit)
    row[0], row[1] = queried, sums[1]
    row[2] = 0.2 * (sums[2] * each - queried * log_unit)
    row[3] = 0.2 * (sums[3] * each - queried * (flows * log_unit + np.log(speed_unit)))
    row[4], row[5] = prior[0] / unit, prior[1] / speed_unit
    row[6], row[7] = 0.25 * np.log(prior[2] / unit), 0.25 * np.log(prior[3] / speed_unit)
    for j in range(2):
        row[8 + j] = 0.5 * clip(sums[4 + j], -LARGEST_INNOVATION, LARGEST_INNOVATION)
    row[10] = 4.0 * _correction(density_variance * sums[6] / unit)
    row[11] = 4.0 * _correction(slip * density_variance * sums[7] / unit)
    row[12] = 4.0 * _correction(by_speed * speed_variance * sums[7] / speed_unit)
    row[13] = min(density_variance * sums[8], 1.0)
    row[14] = min(by_speed**2 * speed_variance * sums[9], 1.0)
    row[15], row[16] = slip / speed_unit, flows
    row[17] = 0.25 * np.log(1.0 + min(age, LONGEST_AGE))


@kernel_part
def _correction(value: float) -> float:
    return clip(value, -LARGEST_CORRECTION, LARGEST_CORRECTION)


@kernel
def advance(bundle: Bundle, episodes: IntArray, x: Float32Array) -> None:
    """Advance the hidden states, and write the estimates of their heads.

    Args:
        bundle: Road, channels, `Cells`, `Memory`, `Weights` and `State`.
        episodes: Shape (k,).
        x: Shape (k, S, C + 2 M): the features, and space for sums of messages.
    """
    road, _, cells, memory, weights, state = bundle.parts
    present, hidden, ahead = memory.present, state.hidden, state.ahead
    S, H = road.n_segments, weights.hidden.shape[0]
    M = min(H, MESSAGE)
    C = weights.inputs.shape[0] - 2 * M
    g, q = np.empty((S, 3 * H), dtype=np.float32), np.empty((S, 3 * H), dtype=np.float32)
    raw = np.empty((S, weights.heads.shape[1]), dtype=np.float32)
    # One product for each episode: its bits then do not depend on the batch that it is in.
    for i in range(episodes.size):
        h = hidden[episodes[i]]
        x[i, :, C:] = 0.0
        for e in range(road.edges.shape[0]):
            start, end = road.edges[e, 0], road.edges[e, 1]
            for j in range(M):
                x[i, end, C + j] += h[start, j]
                x[i, start, C + M + j] += h[end, j]
        np.dot(x[i], weights.inputs, g)
        np.dot(h, weights.hidden, q)
        for s in range(S):
            _gate(g[s], q[s], weights.inputs_bias, weights.hidden_bias, h[s])
        np.dot(h, weights.heads, raw)
        for s in range(S):
            row = raw[s]
            _read_heads(row[0:4], weights.heads_bias[0:4], cells, s, present[episodes[i], s])
            _read_heads(row[4:8], weights.heads_bias[4:8], cells, s, ahead[episodes[i], s])


@kernel_part(fastmath={"contract"})
def _gate(
    g: Float32Array, q: Float32Array, g_bias: Float32Array, q_bias: Float32Array, h: Float32Array
) -> None:
    """Update the hidden state of a cell."""
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
    """Return tanh to within some 1e-7, as an expression that compiles to vector instructions.

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
    raw: Float32Array, bias: Float32Array, cells: Cells, s: int, out: FloatArray
) -> None:
    """Write density, speed and their deviations from the outputs of four heads."""
    unit, speed_unit = cells.unit[s], cells.speed_unit
    out[0] = DENSITY_RANGE * unit * (0.5 + 0.5 * np.tanh(0.5 * float(raw[0] + bias[0])))
    out[1] = cells.fastest * (0.5 + 0.5 * np.tanh(0.5 * float(raw[1] + bias[1])))
    out[2] = unit * np.exp(clip(float(raw[2] + bias[2]), LOWEST_SPREAD, HIGHEST_SPREAD))
    out[3] = speed_unit * np.exp(clip(float(raw[3] + bias[3]), LOWEST_SPREAD, HIGHEST_SPREAD))
