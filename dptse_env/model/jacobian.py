"""Analytic derivative of a step of the ARZ model by its state.

The outflow of a cell depends on the cells at its downstream face only. Its derivative is kept as
`by[n, cell, other, (rho, psi)]`; the step's Jacobian is then the balance of these, as the step is
the balance of the flows. At a kink (demand = supply) the branch of the demand is taken.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dptse_env.model.dynamics import ARZDynamics, Cells
from dptse_env.model.parameters import STANDING, VACUUM
from dptse_env.utils.arrays import BoolArray, FloatArray


class Gradients(NamedTuple):
    """Derivatives of a cell's w, speed and demand by its (rho, psi), `(n, S, 2)` each."""

    w: FloatArray
    speed: FloatArray
    demand: FloatArray


def step_jacobian(model: ARZDynamics, states: FloatArray, inputs: FloatArray) -> FloatArray:
    """Derivative `(n, n_x, n_x)` of `model.step`."""
    layout = model.layout
    cells = model.cells(states)
    gradients = _gradients(model, states, cells)
    flux = model.fluxes(states, inputs)
    by = np.zeros((*cells.density.shape, model.n_segments, 2))
    _links(model, cells, gradients, by)
    _merges(model, cells, gradients, by)
    _diverges(model, cells, gradients, by)
    _exits(model, cells, gradients, inputs, by)
    source_by = _source_gradient(model, states, cells, gradients, inputs)

    each = np.arange(model.n_segments)
    relative_by = cells.w[:, :, None, None] * by
    relative_by[:, each, each] += flux.outflow[:, :, None] * gradients.w

    balance = model.step_ratio[:, None] * (layout.routing - np.eye(model.n_segments))
    blocks = np.empty((*by.shape[:3], 2, 2))  # n, row's cell, column's cell, row, column
    blocks[..., 0, :] = np.einsum("cd,ndek->ncek", balance, by)
    blocks[..., 1, :] = np.einsum("cd,ndek->ncek", balance, relative_by)

    entries = layout.entries
    w_in = inputs[:, layout.entry_inputs + 1, None]
    blocks[:, entries, entries, 0] += model.step_ratio[entries, None] * source_by
    blocks[:, entries, entries, 1] += model.step_ratio[entries, None] * w_in * source_by

    blocks[:, each, each, 0, 0] += 1.0
    blocks[:, each, each, 1, 0] += model.relaxation * model.parameters.free_flow_speed
    blocks[:, each, each, 1, 1] += 1.0 - model.relaxation
    n = 2 * model.n_segments
    traffic = blocks.transpose(0, 1, 3, 2, 4).reshape(-1, n, n)
    return _with_demand(model, states, inputs, traffic) if model.n_demand_states else traffic


def _with_demand(
    model: ARZDynamics, states: FloatArray, inputs: FloatArray, traffic: FloatArray
) -> FloatArray:
    """Add rows and columns of the demand factors, which enter the entries where these are free."""
    layout, n = model.layout, traffic.shape[1]
    entries, each = layout.entries, n + np.arange(layout.entries.size)
    w_in, speed = inputs[:, layout.entry_inputs + 1], model.cells(states).speed[:, entries]
    supply = model.relations.supply(w_in, speed, model.jam_density[entries])
    free = model.demands(states, inputs) <= supply
    by = np.where(free, model.step_ratio[entries] * inputs[:, layout.entry_inputs], 0.0)
    whole = np.zeros((len(traffic), model.n_states, model.n_states))
    whole[:, :n, :n] = traffic
    whole[:, each, each] = 1.0
    whole[:, 2 * entries, each] = by
    whole[:, 2 * entries + 1, each] = by * w_in
    return whole


def _gradients(model: ARZDynamics, states: FloatArray, cells: Cells) -> Gradients:
    jam, relations = model.jam_density, model.relations
    rho = cells.density
    empty = rho <= VACUUM * jam
    held = np.where(empty, 1.0, rho)
    moving = ~empty & (model.components(states)[1] > 0.0)
    w = np.stack([np.where(moving, -cells.w / held, 0.0), np.where(moving, 1.0 / held, 0.0)], -1)

    pressure = relations.pressure(rho, jam)
    speed = w.copy()
    speed[..., 0] -= np.where(empty, 0.0, model.parameters.gamma * pressure / held)
    speed[cells.w - pressure <= -STANDING * model.parameters.free_flow_speed] = 0.0

    by_density, by_w = relations.demand_gradient(rho, cells.w, jam)
    demand = by_w[..., None] * w
    demand[..., 0] += by_density
    demand[empty] = 0.0
    return Gradients(w, speed, demand)


def _links(model: ARZDynamics, cells: Cells, gradients: Gradients, by: FloatArray) -> None:
    up, down = model.layout.links
    jam = model.jam_density[down]
    w, speed = cells.w[:, up], cells.speed[:, down]
    sends = cells.demand[:, up] <= model.relations.supply(w, speed, jam)
    by_w, by_speed = model.relations.supply_gradient(w, speed, jam)
    by[:, up, up] = _choose(sends, gradients.demand[:, up], by_w[..., None] * gradients.w[:, up])
    by[:, up, down] = _choose(sends, 0.0, by_speed[..., None] * gradients.speed[:, down])


def _merges(model: ARZDynamics, cells: Cells, gradients: Gradients, by: FloatArray) -> None:
    main, ramp, down = model.layout.merges
    jam, demand, speed = model.jam_density[down], cells.demand, cells.speed[:, down]
    total, mixed_w = model.merged(cells)
    supply = model.relations.supply(mixed_w, speed, jam)
    by_w, by_speed = model.relations.supply_gradient(mixed_w, speed, jam)
    serves_all = total <= supply
    held = np.where(total > 0.0, total, 1.0)

    # q_i = (D_i / total) S(w_mixed, v): the share and the supply both move with both branches.
    for cell in (main, ramp):
        share = demand[:, cell] / held
        for other in (main, ramp):
            other_share = (demand[:, other] / held)[..., None]
            surplus_w = (cells.w[:, other] - mixed_w) / held
            mixed_by = (
                other_share * gradients.w[:, other]
                + surplus_w[..., None] * gradients.demand[:, other]
            )
            same = 1.0 if cell is other else 0.0
            share_by = ((same - share) / held)[..., None] * gradients.demand[:, other]
            limited = share[..., None] * by_w[..., None] * mixed_by + supply[..., None] * share_by
            by[:, cell, other] = _choose(serves_all, same * gradients.demand[:, other], limited)
        limited = (share * by_speed)[..., None] * gradients.speed[:, down]
        by[:, cell, down] = _choose(serves_all, 0.0, limited)


def _diverges(model: ARZDynamics, cells: Cells, gradients: Gradients, by: FloatArray) -> None:
    up, main, off = model.layout.diverges
    share = model.layout.exit_shares
    on_main, on_ramp = model.diverge_supplies(cells)
    sends = cells.demand[:, up] <= np.minimum(on_main, on_ramp)
    # Two blocked branches tie: rounding must not choose between them.
    tie = STANDING * model.jam_density[main] * model.parameters.free_flow_speed
    by_main = on_main - tie <= on_ramp
    by[:, up, up] = _choose(sends, gradients.demand[:, up], 0.0)
    for branch, allows, part in ((main, by_main, 1.0 - share), (off, ~by_main, share)):
        limits = (~sends & allows).astype(np.float64) / np.where(part > 0.0, part, 1.0)
        by_w, by_speed = model.relations.supply_gradient(
            cells.w[:, up], cells.speed[:, branch], model.jam_density[branch]
        )
        by[:, up, up] += (limits * by_w)[..., None] * gradients.w[:, up]
        by[:, up, branch] = (limits * by_speed)[..., None] * gradients.speed[:, branch]


def _exits(
    model: ARZDynamics, cells: Cells, gradients: Gradients, inputs: FloatArray, by: FloatArray
) -> None:
    exits, jam = model.layout.exits, model.exit_jam_density
    w = cells.w[:, exits]
    speed = model.exit_speed(w, inputs[:, model.layout.exit_inputs])
    sends = cells.demand[:, exits] <= model.relations.supply(w, speed, jam)
    by_w, by_speed = model.relations.supply_gradient(w, speed, jam)
    # The speed behind the exit is w - p(rho_out): it moves with w unless the exit is blocked.
    total = by_w + np.where(speed > 0.0, by_speed, 0.0)
    by[:, exits, exits] = _choose(
        sends, gradients.demand[:, exits], total[..., None] * gradients.w[:, exits]
    )


def _source_gradient(
    model: ARZDynamics,
    states: FloatArray,
    cells: Cells,
    gradients: Gradients,
    inputs: FloatArray,
) -> FloatArray:
    layout = model.layout
    entries, jam = layout.entries, model.jam_density[layout.entries]
    demand, w_in = model.demands(states, inputs), inputs[:, layout.entry_inputs + 1]
    speed = cells.speed[:, entries]
    _, by_speed = model.relations.supply_gradient(w_in, speed, jam)
    unlimited = demand <= model.relations.supply(w_in, speed, jam)
    return _choose(unlimited, 0.0, by_speed[..., None] * gradients.speed[:, entries])


def _choose(
    condition: BoolArray, chosen: FloatArray | float, otherwise: FloatArray | float
) -> FloatArray:
    return np.where(condition[..., None], chosen, otherwise)
