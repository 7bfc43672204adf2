"""Dynamics of the ARZ traffic model on a road with junctions, in plain numpy (paper, eq. 1 and 2).

State `x = [rho_0, psi_0, rho_1, psi_1, ...]` over the S segments, with density rho [veh/km] and
relative flow psi = rho w [veh/h], where w = v + p(rho) [km/h] is what drivers carry with them.
Inputs `u = [D_in, w_in, rho_out, D_on1, w_on1, ..., rho_off1, ...]`: demands at the entries [veh/h]
with their w [km/h], and densities behind the exits [veh/km]. Arrays have a leading batch axis n.

With demand states the state has a further component for each entry at its end: a factor on the
demand that the inputs give there, which a step leaves as it is.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.model.network import Layout, RoadNetwork, make_layout
from dptse_env.model.parameters import LARGEST_W, SECONDS_PER_HOUR, VACUUM, ARZParameters
from dptse_env.model.relations import Relations
from dptse_env.utils.arrays import FloatArray


class Cells(NamedTuple):
    """Quantities of every cell, `(n, S)` each: rho, w, v = max(w - p, 0) and demand D."""

    density: FloatArray
    w: FloatArray
    speed: FloatArray
    demand: FloatArray


class Fluxes(NamedTuple):
    """Flows of a step: vehicles q [veh/h] and relative flow phi = q w [veh km/h^2]."""

    outflow: FloatArray  # (n, S) q out of each cell; at the cells layout.exits out of the road
    relative_outflow: FloatArray  # (n, S) phi out of each cell
    source: FloatArray  # (n, 1 + I) q into the road at the cells layout.entries
    relative_source: FloatArray  # (n, 1 + I) phi into the road there


class ARZDynamics:
    """Second-order macroscopic traffic flow, Godunov scheme, proportional merge, FIFO diverge.

    Args:
        network: The road.
        parameters: Parameters of the model; each cell's jam density follows its lanes.
        time_step: T [s].
        demand_states: Whether the state has a factor on the demand of each entry.

    Raises:
        ValueError: The network is impossible, or the time step violates the CFL condition.
    """

    def __init__(
        self,
        network: RoadNetwork,
        parameters: ARZParameters,
        time_step: float = 1.0,
        demand_states: bool = False,
    ) -> None:
        """Derive the arrays that the equations need and check the time step."""
        self.network = network
        self.parameters = parameters
        self.time_step = time_step
        self.layout: Layout = make_layout(network)
        self.relations = Relations(parameters.free_flow_speed, parameters.gamma)
        self.n_segments = self.layout.n_segments
        self.n_demand_states = self.layout.entries.size if demand_states else 0
        self.n_states = 2 * self.n_segments + self.n_demand_states
        self.n_inputs = self.layout.n_inputs
        self.n_boundaries = self.layout.n_boundaries
        per_lane = parameters.jam_density / parameters.lanes
        self.jam_density = per_lane * self.layout.lanes
        self.entry_jam_density = per_lane * self.layout.entry_lanes
        self.exit_jam_density = per_lane * self.layout.exit_lanes
        # The scale of the mainline for all cells, so that equal numbers have an equal meaning.
        self.density_scale = per_lane * max(network.segment_lanes[: network.n_mainline])
        self.speed_scale = parameters.free_flow_speed
        self.largest_speed = LARGEST_W * parameters.free_flow_speed
        parameters.require_time_step(time_step, min(network.segment_lengths))
        # T / l [h/km] of each segment
        self.step_ratio: FloatArray = time_step / SECONDS_PER_HOUR / self.layout.lengths
        self.relaxation = time_step / parameters.relaxation_time  # T / tau

    # States -------------------------------------------------------------------------------------

    def states(self, density: FloatArray, speed: FloatArray) -> FloatArray:
        """State `(n, n_x)` of densities [veh/km] and speeds [km/h] `(n, S)`; psi = rho (v + p).

        Demand factors are 1.
        """
        w = speed + self.relations.pressure(density, self.jam_density)
        return self.compose(density, density * w)

    def components(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Views of rho [veh/km] and psi [veh/h] `(n, S)` of states."""
        end = 2 * self.n_segments
        return states[..., 0:end:2], states[..., 1:end:2]

    def demand_factors(self, states: FloatArray) -> FloatArray:
        """View of the factors on the demands `(n, E)`, E = 0 without demand states."""
        return states[..., 2 * self.n_segments :]

    def compose(
        self, density: FloatArray, psi: FloatArray, factors: FloatArray | None = None
    ) -> FloatArray:
        """State `(n, n_x)` of rho and psi `(n, S)` and demand factors `(n, E)`, 1 by default."""
        pairs = np.stack([density, psi], axis=-1).reshape(*density.shape[:-1], -1)
        if self.n_demand_states == 0:
            return pairs
        if factors is None:
            factors = np.ones((*density.shape[:-1], self.n_demand_states))
        return np.concatenate([pairs, factors], axis=-1)

    @property
    def state_scale(self) -> FloatArray:
        """Units `(n_x,)` of normalised states: rho_m, rho_m v_f, and 1 for demand factors."""
        rho_m = self.density_scale
        pairs = np.tile([rho_m, rho_m * self.speed_scale], self.n_segments)
        return np.concatenate([pairs, np.ones(self.n_demand_states)])

    def density(self, states: FloatArray) -> FloatArray:
        """Density `(n, S)` [veh/km]."""
        return self.components(states)[0].copy()

    def speed(self, states: FloatArray) -> FloatArray:
        """Speed `(n, S)` [km/h], `max(w - p(rho), 0)`; the free speed v_f in a vacuum."""
        return self.cells(states).speed

    def cells(self, states: FloatArray) -> Cells:
        """Derive w, speed and demand of every cell."""
        density, psi = (np.maximum(part, 0.0) for part in self.components(states))
        empty = density <= VACUUM * self.jam_density
        w = np.where(empty, self.parameters.free_flow_speed, psi / np.where(empty, 1.0, density))
        speed = np.maximum(w - self.relations.pressure(density, self.jam_density), 0.0)
        demand = np.where(empty, 0.0, self.relations.demand(density, w, self.jam_density))
        return Cells(density, w, speed, demand)

    # Dynamics -----------------------------------------------------------------------------------

    def fluxes(self, states: FloatArray, inputs: FloatArray) -> Fluxes:
        """Flows through every face under `states` `(n, 2 S)` and `inputs` `(n, n_u)`."""
        layout, jam = self.layout, self.jam_density
        cells = self.cells(states)
        _, w, speed, demand = cells
        outflow = np.empty_like(demand)

        up, down = layout.links  # q = min(D, S)
        outflow[:, up] = np.minimum(
            demand[:, up], self.relations.supply(w[:, up], speed[:, down], jam[down])
        )

        main, ramp, down = layout.merges  # both branches are scaled back alike
        total, mixed_w = self.merged(cells)
        supply = self.relations.supply(mixed_w, speed[:, down], jam[down])
        served = np.minimum(1.0, supply / np.where(total > 0.0, total, 1.0))
        served = np.where(total > 0.0, served, 1.0)
        outflow[:, main] = served * demand[:, main]
        outflow[:, ramp] = served * demand[:, ramp]

        up = layout.diverges[0]  # first in, first out: one blocked branch blocks both
        outflow[:, up] = np.minimum(demand[:, up], np.min(self.diverge_supplies(cells), axis=0))

        exits = layout.exits
        outside = self.exit_speed(w[:, exits], inputs[:, layout.exit_inputs])
        outflow[:, exits] = np.minimum(
            demand[:, exits], self.relations.supply(w[:, exits], outside, self.exit_jam_density)
        )

        entries = layout.entries  # demand that is not served vanishes
        w_in = inputs[:, layout.entry_inputs + 1]
        source = np.minimum(
            self.demands(states, inputs),
            self.relations.supply(w_in, speed[:, entries], jam[entries]),
        )
        return Fluxes(outflow, outflow * w, source, source * w_in)

    def demands(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Demands at the entries `(n, 1 + I)` [veh/h], by the states' factors if they have any."""
        demands: FloatArray = inputs[:, self.layout.entry_inputs]
        return demands * self.demand_factors(states) if self.n_demand_states else demands

    def step(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """States `(n, n_x)` one time step later (paper, eq. 1a and 1b for a general T)."""
        rho, psi = self.components(states)
        flux = self.fluxes(states, inputs)
        inflow = flux.outflow @ self.layout.routing.T
        relative_inflow = flux.relative_outflow @ self.layout.routing.T
        inflow[:, self.layout.entries] += flux.source
        relative_inflow[:, self.layout.entries] += flux.relative_source
        v_f = self.parameters.free_flow_speed
        return self.compose(
            rho + self.step_ratio * (inflow - flux.outflow),
            psi
            + self.step_ratio * (relative_inflow - flux.relative_outflow)
            + self.relaxation * (v_f * rho - psi),
            self.demand_factors(states),
        )

    def merged(self, cells: Cells) -> tuple[FloatArray, FloatArray]:
        """Total demand and the mean w of the drivers before each merge, `(n, I)` each."""
        main, ramp, _ = self.layout.merges
        demand, w = cells.demand, cells.w
        total = demand[:, main] + demand[:, ramp]
        relative = demand[:, main] * w[:, main] + demand[:, ramp] * w[:, ramp]
        v_f = self.parameters.free_flow_speed
        return total, np.where(total > 0.0, relative / np.where(total > 0.0, total, 1.0), v_f)

    def diverge_supplies(self, cells: Cells) -> FloatArray:
        """Flow before each diverge that each branch (mainline, off-ramp) admits, `(2, n, O)`."""
        up, main, off = self.layout.diverges
        supply, jam = self.relations.supply, self.jam_density
        share = self.layout.exit_shares
        ramp_supply = supply(cells.w[:, up], cells.speed[:, off], jam[off])
        return np.stack(
            [
                supply(cells.w[:, up], cells.speed[:, main], jam[main]) / (1.0 - share),
                np.where(share > 0.0, ramp_supply / np.where(share > 0.0, share, 1.0), np.inf),
            ]
        )

    def exit_speed(self, w: FloatArray, density: FloatArray) -> FloatArray:
        """Speed `(n, 1 + O)` [km/h] of drivers w behind an exit of the given density."""
        return np.maximum(w - self.relations.pressure(density, self.exit_jam_density), 0.0)

    def boundary_inputs(self, density: FloatArray, speed: FloatArray) -> FloatArray:
        """Inputs `(n, n_u)` of the boundary cells' densities and speeds `(n, R)`.

        Boundary cells: upstream, downstream, before each on-ramp, after each off-ramp. The demand
        of an empty cell is zero for any speed, NaN included. w is clipped to [0, 1.1 v_f], so that
        no input violates the CFL condition.
        """
        layout, v_f = self.layout, self.parameters.free_flow_speed
        inputs = np.empty((density.shape[0], self.n_inputs))
        rho = density[:, layout.entry_boundaries]
        occupied = rho > VACUUM * self.entry_jam_density
        v = np.where(occupied, speed[:, layout.entry_boundaries], 0.0)
        w = v + self.relations.pressure(rho, self.entry_jam_density)
        w = np.where(occupied, np.clip(w, 0.0, self.largest_speed), v_f)
        demand = self.relations.demand(rho, w, self.entry_jam_density)
        inputs[:, layout.entry_inputs] = np.where(occupied, demand, 0.0)
        inputs[:, layout.entry_inputs + 1] = w
        inputs[:, layout.exit_inputs] = density[:, layout.exit_boundaries]
        return inputs
