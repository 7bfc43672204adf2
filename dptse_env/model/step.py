"""Compiled kernels of the ARZ model for one state: the next state, and the step's Jacobian.

The pressure is p(rho) = v_f (rho / rho_m)^gamma (Aw-Rascle 2000, Zhang 2002). Along drivers of one
w the flow is q_w(rho) = rho (w - p(rho)), largest at the critical density sigma(w) =
rho_m (w / ((1 + gamma) v_f))^(1 / gamma): q_max(w) = sigma(w) w gamma / (1 + gamma). The demand of
a cell is what it can send: q_w(rho) up to sigma(w), q_max(w) beyond. Its supply is what it can take
in of drivers w: they reach the density rho_M = p^-1(w - v) at the cell's speed v, and rho_M v
enters, unless rho_M is below sigma(w): then q_max(w).

A cell's outflow depends on at most three cells, its parties: itself and those at its downstream
face. A step's Jacobian is a weighted sum of the outflows' gradients, by a table of the road. At a
kink, demand = supply, it takes the side of the demand.

Parts do not allocate: callers pass scratch space (`make_scratch`), so that a part can run inside a
kernel, once per step and episode.
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
    STANDING,
    VACUUM,
)
from dptse_env.road import EXIT, LINK, MERGE, Road
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel, kernel_part

# Columns of the table of cells: values, then partial derivatives by the cell's rho and psi.
_W, _V, _D, _W_RHO, _W_PSI, _V_RHO, _V_PSI, _D_RHO, _D_PSI = range(9)

Outflow = tuple[float, float, float, float, float, float, float]


class Scratch(NamedTuple):
    """Working space of `advance`."""

    cells: FloatArray  # (S, 9) w, speed and demand of each cell and their derivatives
    outflow: FloatArray  # (S, 2) q and phi out of each cell
    gradient: FloatArray  # (S, 3, 4) derivatives of (q, phi) by each party's (rho, psi)
    # (1 + I, 3) derivatives of each entry's next (rho, psi) and factor by its demand factor
    by_factor: FloatArray


@kernel_part
def make_scratch(road: Road) -> Scratch:
    """Allocate the working space for a road."""
    n = road.n_segments
    by_factor = np.zeros((road.entries.size, 3))
    return Scratch(np.empty((n, 9)), np.empty((n, 2)), np.zeros((n, 3, 4)), by_factor)


@kernel_part
def pressure(density: float, jam: float, v_f: float, gamma: float) -> float:
    """p(rho) [km/h]."""
    return float(v_f * (max(density, 0.0) / jam) ** gamma)


@kernel_part
def supply(
    w: float, speed: float, jam: float, v_f: float, gamma: float
) -> tuple[float, float, float]:
    """Supply [veh/h] and its partial derivatives by w and by the cell's speed [veh/km]."""
    share = gamma / (1.0 + gamma)
    if speed >= w * share:
        critical = jam * (w / ((1.0 + gamma) * v_f)) ** (1.0 / gamma)
        return critical * w * share, critical, 0.0
    gap = w - speed
    settled = jam * (gap / v_f) ** (1.0 / gamma)
    slope = settled / (gamma * gap)
    return settled * speed, speed * slope, settled - speed * slope


@kernel_part
def _tabulate(road: Road, arz: ARZ, state: FloatArray, cells: FloatArray) -> None:
    """Fill the table of cells: w, speed, demand and their derivatives."""
    v_f, gamma = arz.free_flow_speed, arz.gamma
    for c in range(road.n_segments):
        jam = arz.jam[c]
        rho = max(state[2 * c], 0.0)
        psi = max(state[2 * c + 1], 0.0)
        p = pressure(rho, jam, v_f, gamma)
        if rho <= VACUUM * jam:
            cells[c, :] = 0.0
            cells[c, _W], cells[c, _V] = v_f, max(v_f - p, 0.0)
            continue
        w = psi / rho
        w_rho, w_psi = (-w / rho, 1.0 / rho) if psi > 0.0 else (0.0, 0.0)
        cells[c, _W], cells[c, _W_RHO], cells[c, _W_PSI] = w, w_rho, w_psi
        moving = w - p > -STANDING * v_f
        cells[c, _V] = max(w - p, 0.0)
        cells[c, _V_RHO] = w_rho - gamma * p / rho if moving else 0.0
        cells[c, _V_PSI] = w_psi if moving else 0.0
        if (1.0 + gamma) * p <= w:
            cells[c, _D] = rho * (w - p)
            cells[c, _D_RHO] = w - (1.0 + gamma) * p + rho * w_rho
            cells[c, _D_PSI] = rho * w_psi
        else:
            critical = jam * (w / ((1.0 + gamma) * v_f)) ** (1.0 / gamma)
            cells[c, _D] = critical * w * (gamma / (1.0 + gamma))
            cells[c, _D_RHO] = critical * w_rho
            cells[c, _D_PSI] = critical * w_psi


# The four kinds of faces. Each function returns q and its derivatives by (rho, psi) of the three
# parties. Arguments are indices and numbers instead of the road: reference counts of a view or a
# tuple of arrays would take more time than the arithmetic.


@kernel_part
def _link(cells: FloatArray, a: int, b: int, jam: float, v_f: float, gamma: float) -> Outflow:
    s, by_w, by_v = supply(cells[a, _W], cells[b, _V], jam, v_f, gamma)
    if cells[a, _D] <= s:
        return cells[a, _D], cells[a, _D_RHO], cells[a, _D_PSI], 0.0, 0.0, 0.0, 0.0
    return (
        s,
        by_w * cells[a, _W_RHO],
        by_w * cells[a, _W_PSI],
        by_v * cells[b, _V_RHO],
        by_v * cells[b, _V_PSI],
        0.0,
        0.0,
    )


@kernel_part
def _merge(
    cells: FloatArray, a: int, b: int, other: int, jam: float, v_f: float, gamma: float
) -> Outflow:
    total = cells[a, _D] + cells[other, _D]
    if total <= 0.0:
        return cells[a, _D], cells[a, _D_RHO], cells[a, _D_PSI], 0.0, 0.0, 0.0, 0.0
    share, other_share = cells[a, _D] / total, cells[other, _D] / total
    relative = cells[a, _D] * cells[a, _W] + cells[other, _D] * cells[other, _W]
    mixed_w = relative / total
    s, by_w, by_v = supply(mixed_w, cells[b, _V], jam, v_f, gamma)
    if total <= s:
        return cells[a, _D], cells[a, _D_RHO], cells[a, _D_PSI], 0.0, 0.0, 0.0, 0.0
    # q = share * s, with w_mixed and the share moving with both branches.
    by_w *= share
    by_v *= share
    own_d = (by_w * (cells[a, _W] - mixed_w) + s * (1.0 - share)) / total
    other_d = (by_w * (cells[other, _W] - mixed_w) - s * share) / total
    return (
        share * s,
        by_w * share * cells[a, _W_RHO] + own_d * cells[a, _D_RHO],
        by_w * share * cells[a, _W_PSI] + own_d * cells[a, _D_PSI],
        by_v * cells[b, _V_RHO],
        by_v * cells[b, _V_PSI],
        by_w * other_share * cells[other, _W_RHO] + other_d * cells[other, _D_RHO],
        by_w * other_share * cells[other, _W_PSI] + other_d * cells[other, _D_PSI],
    )


@kernel_part
def _diverge(
    cells: FloatArray,
    a: int,
    main: int,
    off: int,
    main_jam: float,
    off_jam: float,
    share: float,
    v_f: float,
    gamma: float,
) -> Outflow:
    s, by_w, by_v = supply(cells[a, _W], cells[main, _V], main_jam, v_f, gamma)
    s, by_w, by_v = s / (1.0 - share), by_w / (1.0 - share), by_v / (1.0 - share)
    by_off = 0.0
    if share > 0.0:
        s_off, by_w_off, by_v_off = supply(cells[a, _W], cells[off, _V], off_jam, v_f, gamma)
        if s_off / share < s - STANDING * main_jam * v_f:
            by_w, by_v, by_off = by_w_off / share, 0.0, by_v_off / share
        s = min(s, s_off / share)
    if cells[a, _D] <= s:
        return cells[a, _D], cells[a, _D_RHO], cells[a, _D_PSI], 0.0, 0.0, 0.0, 0.0
    return (
        s,
        by_w * cells[a, _W_RHO],
        by_w * cells[a, _W_PSI],
        by_v * cells[main, _V_RHO],
        by_v * cells[main, _V_PSI],
        by_off * cells[off, _V_RHO],
        by_off * cells[off, _V_PSI],
    )


@kernel_part
def _exit(
    cells: FloatArray, a: int, density: float, jam: float, v_f: float, gamma: float
) -> Outflow:
    speed = max(cells[a, _W] - pressure(density, jam, v_f, gamma), 0.0)
    s, by_w, by_v = supply(cells[a, _W], speed, jam, v_f, gamma)
    if cells[a, _D] <= s:
        return cells[a, _D], cells[a, _D_RHO], cells[a, _D_PSI], 0.0, 0.0, 0.0, 0.0
    # The speed behind the exit is w - p(rho_out): it moves with w unless the exit is blocked.
    slope = by_w + by_v if speed > 0.0 else by_w
    return s, slope * cells[a, _W_RHO], slope * cells[a, _W_PSI], 0.0, 0.0, 0.0, 0.0


@kernel_part
def _flows_out(
    road: Road,
    arz: ARZ,
    cells: FloatArray,
    inputs: FloatArray,
    outflow: FloatArray,
    gradient: FloatArray,
) -> None:
    """Outflow of every cell and its gradient by the cell's parties."""
    v_f, gamma = arz.free_flow_speed, arz.gamma
    jam, parties = arz.jam, road.parties
    for c in range(road.n_segments):
        kind, b, third = road.kind[c], parties[c, 1], parties[c, 2]
        if kind == LINK:
            flow = _link(cells, c, b, jam[b], v_f, gamma)
        elif kind == EXIT:
            e = road.exit_of[c]
            density, outside = inputs[road.exit_inputs[e]], jam[road.exit_cells[e]]
            flow = _exit(cells, c, density, outside, v_f, gamma)
        elif kind == MERGE:
            flow = _merge(cells, c, b, third, jam[b], v_f, gamma)
        else:
            flow = _diverge(cells, c, b, third, jam[b], jam[third], road.share[c], v_f, gamma)
        w = cells[c, _W]
        outflow[c, 0], outflow[c, 1] = flow[0], flow[0] * w
        for party in range(3):
            by_rho, by_psi = flow[1 + 2 * party], flow[2 + 2 * party]
            gradient[c, party, 0], gradient[c, party, 1] = by_rho, by_psi
            gradient[c, party, 2], gradient[c, party, 3] = w * by_rho, w * by_psi
        gradient[c, 0, 2] += flow[0] * cells[c, _W_RHO]
        gradient[c, 0, 3] += flow[0] * cells[c, _W_PSI]


@kernel_part
def _sources(
    road: Road,
    arz: ARZ,
    cells: FloatArray,
    state: FloatArray,
    inputs: FloatArray,
    after: FloatArray,
    blocks: FloatArray,
    by_factor: FloatArray,
) -> None:
    """Add inflows from outside; demand that is not served is lost."""
    n = 2 * road.n_segments
    for e in range(road.entries.size):
        c = road.entries[e]
        column = road.entry_inputs[e]
        source, w_in = inputs[column], inputs[column + 1]
        if state.size > n:
            by_factor[e, 0] = arz.step_ratio[c] * source
            source *= state[n + e]
        s, _, by_v = supply(w_in, cells[c, _V], arz.jam[c], arz.free_flow_speed, arz.gamma)
        if source > s:
            source = s
            slope = arz.step_ratio[c] * by_v
            blocks[c, 0, 0] += slope * cells[c, _V_RHO]
            blocks[c, 0, 1] += slope * cells[c, _V_PSI]
            blocks[c, 0, 2] += slope * w_in * cells[c, _V_RHO]
            blocks[c, 0, 3] += slope * w_in * cells[c, _V_PSI]
            by_factor[e, 0] = 0.0
        by_factor[e, 1] = w_in * by_factor[e, 0]
        after[2 * c] += arz.step_ratio[c] * source
        after[2 * c + 1] += arz.step_ratio[c] * source * w_in


@kernel_part
def advance(
    road: Road,
    arz: ARZ,
    state: FloatArray,
    inputs: FloatArray,
    after: FloatArray,
    blocks: FloatArray,
    scratch: Scratch,
) -> None:
    """Write the state one step later and the step's Jacobian.

    Args:
        road: The road.
        arz: The model.
        state: `(n_x,)`, with a demand factor for each entry at its end or without.
        inputs: `(n_u,)`.
        after: `(n_x,)` output, the next state; may be `state` itself.
        blocks: `(S, K, 4)` output, the Jacobian: derivatives of a cell's next (rho, psi) by a
            neighbour's (rho, psi), row by row, in the order of `road.neighbours`.
        scratch: From `make_scratch`; left with the derivatives by the demand factors.
    """
    cells, outflow, gradient = scratch.cells, scratch.outflow, scratch.gradient
    v_f, ratio, relaxation = arz.free_flow_speed, arz.step_ratio, arz.relaxation
    _tabulate(road, arz, state, cells)
    _flows_out(road, arz, cells, inputs, outflow, gradient)

    blocks[:] = 0.0
    for c in range(road.n_segments):
        rho, psi = state[2 * c], state[2 * c + 1]
        after[2 * c] = rho - ratio[c] * outflow[c, 0]
        after[2 * c + 1] = psi - ratio[c] * outflow[c, 1] + relaxation * (v_f * rho - psi)
        blocks[c, 0, 0] = 1.0
        blocks[c, 0, 2], blocks[c, 0, 3] = relaxation * v_f, 1.0 - relaxation
    _sources(road, arz, cells, state, inputs, after, blocks, scratch.by_factor)
    n = 2 * road.n_segments
    for e in range(state.size - n):
        after[n + e] = 1.0 + arz.kept * (state[n + e] - 1.0)
        scratch.by_factor[e, 2] = arz.kept

    for e in range(road.edges.shape[0]):
        start, end = road.edges[e, 0], road.edges[e, 1]
        weight = ratio[end] * road.edge_share[e]
        after[2 * end] += weight * outflow[start, 0]
        after[2 * end + 1] += weight * outflow[start, 1]
    for m in range(road.terms.shape[0]):
        row, slot = road.terms[m, 0], road.terms[m, 1]
        start, party = road.terms[m, 2], road.terms[m, 3]
        for k in range(4):
            blocks[row, slot, k] += arz.term_weight[m] * gradient[start, party, k]


@kernel
def next_states(
    road: Road, arz: ARZ, states: FloatArray, inputs: FloatArray, after: FloatArray
) -> None:
    """Write the states (n, n_x) one step after `states` (n, n_x) under `inputs` (n, n_u)."""
    scratch = make_scratch(road)
    blocks = np.empty((*road.neighbours.shape, 4))
    for i in range(states.shape[0]):
        advance(road, arz, states[i], inputs[i], after[i], blocks, scratch)


@kernel
def jacobians(
    road: Road, arz: ARZ, states: FloatArray, inputs: FloatArray, derivatives: FloatArray
) -> None:
    """Write the derivatives of a step of `states` into zeros, shape (n, n_x, n_x)."""
    scratch = make_scratch(road)
    blocks = np.empty((*road.neighbours.shape, 4))
    after = np.empty(states.shape[1])
    for i in range(states.shape[0]):
        advance(road, arz, states[i], inputs[i], after, blocks, scratch)
        for c in range(road.n_segments):
            for slot in range(road.degree[c]):
                b = road.neighbours[c, slot]
                for k in range(4):
                    derivatives[i, 2 * c + k // 2, 2 * b + k % 2] = blocks[c, slot, k]
        for j in range(2 * road.n_segments, after.size):
            e = j - 2 * road.n_segments
            derivatives[i, j, j] = scratch.by_factor[e, 2]
            for k in range(2):
                derivatives[i, 2 * road.entries[e] + k, j] = scratch.by_factor[e, k]


@kernel
def write_inputs(
    road: Road, arz: ARZ, density: FloatArray, speed: FloatArray, inputs: FloatArray
) -> None:
    """Write the inputs (n, n_u) of boundary cells; see `ARZModel.boundary_inputs`.

    Args:
        road: The road.
        arz: The model.
        density: Densities of the boundary cells (n, R) [veh/km].
        speed: Their speeds (n, R) [km/h].
        inputs: Written.
    """
    v_f, gamma, S = arz.free_flow_speed, arz.gamma, road.n_segments
    for i in range(density.shape[0]):
        for e in range(road.exits.size):
            inputs[i, road.exit_inputs[e]] = density[i, road.exit_cells[e] - S]
        for e in range(road.entries.size):
            cell = road.entry_cells[e]
            rho, jam, demand, w = density[i, cell - S], arz.jam[cell], 0.0, v_f
            if rho > VACUUM * jam:
                p = v_f * _rounded_power(rho / jam, gamma)
                w = clip(speed[i, cell - S] + p, 0.0, LARGEST_W * v_f)
                if (1.0 + gamma) * p <= w:
                    demand = rho * (w - p)
                else:
                    critical = jam * _rounded_power(w / (1.0 + gamma) / v_f, 1.0 / gamma)
                    demand = critical * w * (gamma / (1.0 + gamma))
            inputs[i, road.entry_inputs[e]], inputs[i, road.entry_inputs[e] + 1] = demand, w


@kernel_part
def _rounded_power(base: float, exponent: float) -> float:
    """Return a power, squares and roots correctly rounded, as numpy has them."""
    if exponent == 2.0:
        return base * base
    return float(np.sqrt(base) if exponent == 0.5 else base**exponent)


@kernel_part
def normalise(arz: ARZ, density_scale: float, blocks: FloatArray, by_factor: FloatArray) -> None:
    """Normalise a step's derivatives: rho by rho_m, psi by rho_m v_f."""
    v_f = arz.free_flow_speed
    for s in range(blocks.shape[0]):
        for slot in range(blocks.shape[1]):
            blocks[s, slot, 1] *= v_f
            blocks[s, slot, 2] /= v_f
    for e in range(by_factor.shape[0]):
        by_factor[e, 0] /= density_scale
        by_factor[e, 1] /= density_scale * v_f


@kernel_part
def project(road: Road, arz: ARZ, state: FloatArray, is_box: bool) -> None:
    """Project a state into its bounds, as `ARZModel.project`; a NaN stays NaN."""
    v_f = arz.free_flow_speed
    for c in range(road.n_segments):
        rho, psi, jam = state[2 * c], state[2 * c + 1], arz.jam[c]
        if is_box:
            rho = clip(rho, 0.0, jam)
            low, high = 0.0, jam * v_f
        else:
            rho = clip(rho, LEAST_DENSITY, jam)
            least_w = max(pressure(rho, jam, v_f, arz.gamma), LEAST_W * v_f)
            low, high = least_w * rho, LARGEST_W * v_f * rho
        state[2 * c], state[2 * c + 1] = rho, clip(psi, low, high)
    for i in range(2 * road.n_segments, state.size):
        state[i] = clip(state[i], LEAST_FACTOR, LARGEST_FACTOR)


@kernel_part
def clip(value: float, low: float, high: float) -> float:
    """Return a value held between two others; a NaN stays NaN."""
    if value < low:
        return low
    if value > high:
        return high
    return value


@kernel_part
def floored_speed(
    rho: float, psi: float, jam: float, v_f: float, gamma: float
) -> tuple[float, float, float]:
    """Return a speed [km/h], its density floored, and its derivatives by rho and psi."""
    floor = MEASUREMENT_FLOOR * jam
    floored = max(rho, floor)
    p = pressure(floored, jam, v_f, gamma)
    slope = -(psi / floored + gamma * p) / floored if rho > floor else 0.0
    return psi / floored - p, slope, 1.0 / floored


@kernel_part
def _released(
    rho: float, psi: float, centre: float, jam: float, v_f: float, gamma: float
) -> tuple[float, float, float]:
    """Return a segment's released second number, and its derivatives by rho and psi.

    That is the flow [veh/h] centred on a speed [km/h], or the speed where the centre is NaN.
    """
    if np.isnan(centre):
        return floored_speed(rho, psi, jam, v_f, gamma)
    p = pressure(rho, jam, v_f, gamma)
    flow = psi - rho * (p + centre)
    return flow, -(1.0 + gamma) * p - centre, 1.0


@kernel_part
def write_channel(
    arz: ARZ,
    channels: Channels,
    units: FloatArray,
    state: FloatArray,
    centre: FloatArray,
    m: int,
    weights: FloatArray,
    constants: FloatArray,
) -> None:
    """Write both numbers of a channel as weights'x + constant, at a state and normalised.

    They are the mean density of its segments, and the mean of their flows centred on a
    speed, or of their speeds where the centre is NaN.

    Args:
        arz: The model.
        channels: What is measured.
        units: `(n_x,)` units of normalised states [veh/km, veh/h].
        state: `(n_x,)` where the channel is linearised [veh/km, veh/h].
        centre: `(S,)` v_0 [km/h] or NaN.
        m: Index of the channel.
        weights: `(2, >= 2 span)`, written, of the components from 2 `first[m]` on.
        constants: `(2,)`, written.
    """
    first, span, v_f, gamma = channels.first[m], channels.span[m], arz.free_flow_speed, arz.gamma
    constants[0] = constants[1] = 0.0
    for i in range(span):
        s = first + i
        rho, psi = state[2 * s], state[2 * s + 1]
        second, by_rho, by_psi = _released(rho, psi, centre[s], arz.jam[s], v_f, gamma)
        part = 1.0 / (span * arz.second_scale)
        weights[0, 2 * i], weights[0, 2 * i + 1] = 1.0 / span, 0.0
        weights[1, 2 * i] = part * by_rho * units[2 * s]
        weights[1, 2 * i + 1] = part * by_psi * units[2 * s + 1]
        constants[1] += part * (second - by_rho * rho - by_psi * psi)
