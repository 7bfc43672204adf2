"""The ARZ model for a batch of states of a road: sigma points, or members of an ensemble.

The equations are those of `dptse_env.model.step` without derivatives. States are stored by
component, `(n_x, width)`, a column each, so that every inner loop runs over contiguous memory
without a branch and compiles to vector instructions. Padding columns must also be states.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.model.arrays import ARZ, Channels
from dptse_env.model.parameters import (
    LARGEST_FACTOR,
    LARGEST_W,
    LEAST_DENSITY,
    LEAST_FACTOR,
    LEAST_W,
    MEASUREMENT_FLOOR,
    VACUUM,
)
from dptse_env.model.power import power
from dptse_env.road import EXIT, LINK, MERGE, Road
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel_part


class BatchScratch(NamedTuple):
    """Scratch space of `advance_states`, `(S, width)` each but the last."""

    w: FloatArray  # [km/h]
    speed: FloatArray  # [km/h]
    demand: FloatArray  # [veh/h]
    root: FloatArray  # (w / ((1 + gamma) v_f)) ** (1 / gamma): critical density over jam density
    flow: FloatArray  # q out of each cell [veh/h]
    row: FloatArray  # (4, width)


@kernel_part
def make_batch_scratch(road: Road, width: int) -> BatchScratch:
    """Allocate the scratch space for a road and a batch of states."""
    n = road.n_segments
    table = np.empty((5, n, width))
    return BatchScratch(table[0], table[1], table[2], table[3], table[4], np.empty((4, width)))


@kernel_part(fastmath={"contract"})
def _tabulate(
    rho_row: FloatArray,
    psi_row: FloatArray,
    jam: float,
    v_f: float,
    gamma: float,
    w_row: FloatArray,
    speed: FloatArray,
    demand: FloatArray,
    root: FloatArray,
) -> None:
    """Write w, speed, demand and critical density over jam density of one cell."""
    share, empty_below, factor = gamma / (1.0 + gamma), VACUUM * jam, 1.0 + gamma
    by_jam, by_w = 1.0 / jam, 1.0 / (factor * v_f)
    for j in range(rho_row.size):
        rho = 0.0 if rho_row[j] < 0.0 else rho_row[j]
        psi = 0.0 if psi_row[j] < 0.0 else psi_row[j]
        p = v_f * power(rho * by_jam, gamma)
        is_empty = rho <= empty_below
        w = v_f if is_empty else psi / rho
        v = w - p
        critical = power(w * by_w, 1.0 / gamma)
        d = rho * v if factor * p <= w else jam * critical * w * share
        w_row[j] = w
        speed[j] = 0.0 if v < 0.0 else v
        demand[j] = 0.0 if is_empty else d
        root[j] = critical


@kernel_part(fastmath={"contract"})
def _supplies(
    w_row: FloatArray,
    root: FloatArray,
    speed: FloatArray,
    jam: float,
    v_f: float,
    gamma: float,
    out: FloatArray,
) -> None:
    """Write the supply of a cell moving at `speed` for drivers w [veh/h]."""
    share, exponent, by_v_f = gamma / (1.0 + gamma), 1.0 / gamma, 1.0 / v_f
    congested = 0
    for j in range(w_row.size):
        congested += 0 if speed[j] >= w_row[j] * share else 1
        out[j] = jam * root[j] * w_row[j] * share
    if congested == 0:
        return
    for j in range(w_row.size):
        settled = jam * power((w_row[j] - speed[j]) * by_v_f, exponent) * speed[j]
        out[j] = out[j] if speed[j] >= w_row[j] * share else settled


@kernel_part
def _merge(
    scratch: BatchScratch, c: int, down: int, other: int, jam: float, v_f: float, gamma: float
) -> None:
    demand, other_demand = scratch.demand[c], scratch.demand[other]
    w, other_w, flow = scratch.w[c], scratch.w[other], scratch.flow[c]
    mixed, root, supply = scratch.row[0], scratch.row[1], scratch.row[2]
    by_w, exponent = 1.0 / ((1.0 + gamma) * v_f), 1.0 / gamma
    for j in range(mixed.size):
        total = demand[j] + other_demand[j]
        relative = demand[j] * w[j] + other_demand[j] * other_w[j]
        mixed[j] = v_f if total <= 0.0 else relative / total
        root[j] = power(mixed[j] * by_w, exponent)
    _supplies(mixed, root, scratch.speed[down], jam, v_f, gamma, supply)
    for j in range(mixed.size):
        total = demand[j] + other_demand[j]
        served = demand[j] / total * supply[j]
        flow[j] = demand[j] if total <= supply[j] or total <= 0.0 else served


@kernel_part
def _flow_out(road: Road, arz: ARZ, scratch: BatchScratch, c: int, inputs: FloatArray) -> None:
    v_f, gamma = arz.free_flow_speed, arz.gamma
    kind, down, third = road.kind[c], road.parties[c, 1], road.parties[c, 2]
    w, root, demand, flow = scratch.w[c], scratch.root[c], scratch.demand[c], scratch.flow[c]
    supply = scratch.row[2]
    if kind == MERGE:
        _merge(scratch, c, down, third, arz.jam[down], v_f, gamma)
        return
    if kind == EXIT:
        jam, speed = arz.jam[road.exit_cells[road.exit_of[c]]], scratch.row[0]
        density = inputs[road.exit_inputs[road.exit_of[c]]]
        p = v_f * (max(density, 0.0) / jam) ** gamma if np.isfinite(density) else np.nan
        for j in range(speed.size):
            v = w[j] - p
            speed[j] = 0.0 if v < 0.0 else v
        _supplies(w, root, speed, jam, v_f, gamma, supply)
    else:
        _supplies(w, root, scratch.speed[down], arz.jam[down], v_f, gamma, supply)
        if kind != LINK:
            share, off = road.share[c], scratch.row[1]
            for j in range(supply.size):
                supply[j] = supply[j] / (1.0 - share)
            if share > 0.0:
                _supplies(w, root, scratch.speed[third], arz.jam[third], v_f, gamma, off)
                for j in range(supply.size):
                    branch = off[j] / share
                    supply[j] = branch if branch < supply[j] else supply[j]
    for j in range(flow.size):
        flow[j] = demand[j] if demand[j] <= supply[j] else supply[j]


@kernel_part
def _enter(
    road: Road, arz: ARZ, scratch: BatchScratch, e: int, inputs: FloatArray, states: FloatArray
) -> None:
    """Add the inflow of an entry from outside; demand that is not served is lost."""
    v_f, gamma, n = arz.free_flow_speed, arz.gamma, 2 * road.n_segments
    c = road.entries[e]
    source, w_in = inputs[road.entry_inputs[e]], inputs[road.entry_inputs[e] + 1]
    w, root, supply = scratch.row[0], scratch.row[1], scratch.row[2]
    w[:] = w_in
    root[:] = (w_in / ((1.0 + gamma) * v_f)) ** (1.0 / gamma)
    _supplies(w, root, scratch.speed[c], arz.jam[c], v_f, gamma, supply)
    rho, psi, demand = states[2 * c], states[2 * c + 1], scratch.row[3]
    demand[:] = source
    if states.shape[0] > n:
        demand *= states[n + e]
    for j in range(supply.size):
        entered = arz.step_ratio[c] * (supply[j] if demand[j] > supply[j] else demand[j])
        rho[j] += entered
        psi[j] += entered * w_in


@kernel_part(fastmath={"contract"})
def _leave(
    rho: FloatArray, psi: FloatArray, flow: FloatArray, w: FloatArray, ratio: float, pull: float,
    v_f: float,
) -> None:  # fmt: skip
    for j in range(rho.size):
        gone = ratio * flow[j]
        psi[j] += pull * (v_f * rho[j] - psi[j]) - gone * w[j]
        rho[j] -= gone


@kernel_part(fastmath={"contract"})
def _arrive(
    rho: FloatArray, psi: FloatArray, flow: FloatArray, w: FloatArray, ratio: float
) -> None:
    for j in range(rho.size):
        come = ratio * flow[j]
        rho[j] += come
        psi[j] += come * w[j]


@kernel_part
def advance_states(
    road: Road, arz: ARZ, states: FloatArray, inputs: FloatArray, scratch: BatchScratch
) -> None:
    """Predict every column of `states` `(n_x, width)` one step ahead under inputs `(n_u,)`."""
    v_f, gamma, ratio = arz.free_flow_speed, arz.gamma, arz.step_ratio
    for c in range(road.n_segments):
        _tabulate(
            states[2 * c], states[2 * c + 1], arz.jam[c], v_f, gamma,
            scratch.w[c], scratch.speed[c], scratch.demand[c], scratch.root[c],
        )  # fmt: skip
    for c in range(road.n_segments):
        _flow_out(road, arz, scratch, c, inputs)
    for c in range(road.n_segments):
        rho, psi = states[2 * c], states[2 * c + 1]
        _leave(rho, psi, scratch.flow[c], scratch.w[c], ratio[c], arz.relaxation, v_f)
    for e in range(road.entries.size):
        _enter(road, arz, scratch, e, inputs, states)
    for i in range(2 * road.n_segments, states.shape[0]):
        factor = states[i]
        for j in range(factor.size):
            factor[j] = 1.0 + arz.kept * (factor[j] - 1.0)
    for e in range(road.edges.shape[0]):
        start, end = road.edges[e, 0], road.edges[e, 1]
        part = ratio[end] * road.edge_share[e]
        _arrive(states[2 * end], states[2 * end + 1], scratch.flow[start], scratch.w[start], part)


@kernel_part(fastmath={"contract"})
def _into_cone(
    rho_row: FloatArray, psi_row: FloatArray, jam: float, v_f: float, gamma: float
) -> None:
    by_jam, least_w, largest_w = 1.0 / jam, LEAST_W * v_f, LARGEST_W * v_f
    for j in range(rho_row.size):
        rho = LEAST_DENSITY if rho_row[j] < LEAST_DENSITY else rho_row[j]
        rho = jam if rho > jam else rho
        p = v_f * power(rho * by_jam, gamma)
        low, high = (p if p > least_w else least_w) * rho, largest_w * rho
        psi = low if psi_row[j] < low else psi_row[j]
        rho_row[j] = rho
        psi_row[j] = high if psi > high else psi


@kernel_part
def _into_box(row: FloatArray, largest: float) -> None:
    for j in range(row.size):
        value = 0.0 if row[j] < 0.0 else row[j]
        row[j] = largest if value > largest else value


@kernel_part
def project_states(road: Road, arz: ARZ, states: FloatArray, is_box: bool) -> None:
    """Project every column into its bounds, as `ARZModel.project`; a NaN stays NaN."""
    v_f, gamma = arz.free_flow_speed, arz.gamma
    for c in range(road.n_segments):
        rho, psi, jam = states[2 * c], states[2 * c + 1], arz.jam[c]
        if is_box:
            _into_box(rho, jam)
            _into_box(psi, jam * v_f)
        else:
            _into_cone(rho, psi, jam, v_f, gamma)
    for i in range(2 * road.n_segments, states.shape[0]):
        row = states[i]
        for j in range(row.size):
            factor = LEAST_FACTOR if row[j] < LEAST_FACTOR else row[j]
            row[j] = LARGEST_FACTOR if factor > LARGEST_FACTOR else factor


@kernel_part(fastmath={"contract"})
def measured_speeds(
    rho_row: FloatArray, psi_row: FloatArray, jam: float, v_f: float, gamma: float, out: FloatArray
) -> None:
    """Write the measured speeds [km/h], with floored density as in `ARZModel.measure`."""
    floor, by_jam = MEASUREMENT_FLOOR * jam, 1.0 / jam
    for j in range(rho_row.size):
        rho = floor if rho_row[j] < floor else rho_row[j]
        out[j] = psi_row[j] / rho - v_f * power(rho * by_jam, gamma)


@kernel_part(fastmath={"contract"})
def _released(
    arz: ARZ,
    s: int,
    rho_row: FloatArray,
    psi_row: FloatArray,
    v_0: float,
    out: FloatArray,
) -> None:
    """Write flows centred on v_0 [km/h], or measured speeds [km/h] where it is NaN."""
    jam, v_f = arz.jam[s], arz.free_flow_speed
    if np.isnan(v_0):
        measured_speeds(rho_row, psi_row, jam, v_f, arz.gamma, out)
        return
    by_jam = 1.0 / jam
    for j in range(rho_row.size):
        rho = rho_row[j]
        held = 0.0 if rho < 0.0 else rho
        out[j] = psi_row[j] - rho * (v_f * power(held * by_jam, arz.gamma) + v_0)


@kernel_part(fastmath={"contract"})
def measure_channel(
    arz: ARZ,
    channels: Channels,
    m: int,
    states: FloatArray,
    centre: FloatArray,
    density: FloatArray,
    second: FloatArray,
    work: FloatArray,
) -> None:
    """Write both numbers of channel m for each state, as `ARZModel.measure`.

    Args:
        arz: The model.
        channels: What is measured.
        m: Index of the channel.
        states: `(n_x, width)`, a state per column.
        centre: `(S,)` speeds that flows are centred on [km/h]; NaN where speeds are measured.
        density: `(width,)` output, the mean density of the channel's segments [veh/km].
        second: `(width,)` output, the mean of their centred flows [veh/h] or speeds [km/h].
        work: `(width,)` scratch.
    """
    first, span = channels.first[m], channels.span[m]
    part = 1.0 / span
    for s in range(first, first + span):
        rho, psi = states[2 * s], states[2 * s + 1]
        _released(arz, s, rho, psi, centre[s], work)
        if s == first:
            for j in range(rho.size):
                density[j], second[j] = part * rho[j], part * work[j]
        else:
            for j in range(rho.size):
                density[j] += part * rho[j]
                second[j] += part * work[j]
