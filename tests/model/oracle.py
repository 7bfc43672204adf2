"""Roads and random states of the tests of the model, and its oracle in plain numpy."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from dptse_env.model import ARZModel, load_parameters
from dptse_env.model.parameters import STANDING, VACUUM
from dptse_env.utils.arrays import FloatArray
from tests.helpers import UNEVEN, make_channels, stretch

PUBLISHED = load_parameters("published")
W99 = load_parameters("w99-3lane")
NO_RELAXATION = replace(PUBLISHED, name="no relaxation", relaxation_time=float("inf"))

CHANNELS = make_channels((0, 3, 4, 13, 16), (1, 2, 3, 2, 1))
"""Channels of the highway, of one to three segments."""

HIGHWAY = stretch(on_ramps=(3, 9), off_ramps=(6, 12), exit_shares=(0.1, 0.1))
STRAIGHT = stretch()
# Every kind of face beside every other, an off-ramp that nobody takes, and wider roads outside.
CROWDED = stretch(
    on_ramps=(3, 5), off_ramps=(4, 6), exit_shares=(0.0, 0.5), ramp_lanes=3, more_outside=1
)
ROADS = {
    "highway": HIGHWAY,
    "uneven": UNEVEN,
    "crowded": CROWDED,
    "straight": STRAIGHT,
    "one cell": stretch(n_mainline=1),
}


def random_states(model: ARZModel, n: int, rng: np.random.Generator) -> FloatArray:
    """States all over the cone, with empty, jammed and standing cells, and a vacuum of some psi."""
    jam, v_f = model.jam_density, model.speed_scale
    density = rng.uniform(0.0, 1.0, (n, model.n_segments)) ** rng.choice([0.5, 2.0], (n, 1)) * jam
    kind = rng.random(density.shape)
    held = [kind < 0.05, kind < 0.1, kind < 0.15]
    density = np.select(held, [0.0, 0.5 * VACUUM * jam, jam], density)
    largest = np.maximum(1.1 * v_f - model.pressure(density), 0.0)
    speed = largest * rng.uniform(0.0, 1.0, density.shape)
    states = model.states(density, np.where(kind > 0.95, 0.0, speed))
    model.demand_factors(states)[:] = rng.uniform(0.1, 3.0, (n, model.n_demand_states))
    return states


def scattered_states(model: ARZModel, n: int, rng: np.random.Generator) -> FloatArray:
    """States within bounds and beyond, with negative components among them."""
    states = random_states(model, n, rng)
    states *= 1.0 + 0.5 * rng.normal(size=states.shape)
    return states + 0.1 * model.state_scale * rng.normal(size=states.shape)


def random_inputs(model: ARZModel, n: int, rng: np.random.Generator) -> FloatArray:
    """Inputs of boundary cells all over the cone."""
    per_lane = model.parameters.jam_density / model.parameters.lanes
    density = rng.uniform(0.0, 1.2, (n, model.n_boundaries)) * per_lane
    density *= model.road.lanes[model.n_segments :]
    density[rng.random(density.shape) < 0.1] = 0.0
    return model.boundary_inputs(density, rng.uniform(0.0, model.speed_scale, density.shape))


# The oracle ---------------------------------------------------------------------------------------


def positive(x, kink=0.0):
    """max(x, 0), with the derivative of x down to -kink."""
    value = np.maximum(x.real, 0.0)
    return value + 1j * np.where(x.real > -kink, x.imag, 0.0) if np.iscomplexobj(x) else value


def least(a, b):
    """min(a, b), with the derivative of a where they are equal."""
    return np.where(a.real <= b.real, a, b)


class Oracle:
    """The model of a road, face by face, in plain numpy: the oracle of the compiled one.

    It shares no code with that. Cells are rows of its arrays, and states of a batch their columns.
    States may be complex: all choices look at real parts alone, so that a step of 1e-30 along the
    imaginary axis gives derivatives without rounding.
    """

    def __init__(self, road, parameters, time_step=1.0, demand_memory=None):
        geometry = road.geometry
        per_lane = parameters.jam_density / parameters.lanes
        self.geometry, self.v_f, self.gamma = geometry, parameters.free_flow_speed, parameters.gamma
        self.jam = per_lane * np.array(geometry.segment_lanes)
        self.outer_jam = per_lane * road.road.lanes[self.jam.size :]
        self.ratio = time_step / 3600.0 / np.array(geometry.segment_lengths)
        self.pull = time_step / parameters.relaxation_time
        self.kept = None if demand_memory is None else np.exp(-time_step / demand_memory)

    # Relations: p, sigma, q_max, D and S.

    def pressure(self, rho, jam):
        return self.v_f * (rho / jam) ** self.gamma

    def critical_density(self, w, jam):
        return jam * (w / ((1.0 + self.gamma) * self.v_f)) ** (1.0 / self.gamma)

    def capacity(self, w, jam):
        return self.critical_density(w, jam) * w * self.gamma / (1.0 + self.gamma)

    def demand(self, rho, w, jam):
        p = self.pressure(rho, jam)
        free = rho.real <= self.critical_density(w, jam).real
        return np.where(free, rho * (w - p), self.capacity(w, jam))

    def supply(self, w, v, jam):
        settled = jam * (positive(w - v) / self.v_f) ** (1.0 / self.gamma)  # rho_M
        free = v.real >= w.real * self.gamma / (1.0 + self.gamma)
        return np.where(free, self.capacity(w, jam), settled * v)

    # Faces.

    def cells(self, states):
        """w, v and D of all cells, (S, n) each."""
        n = 2 * self.jam.size
        jam, rho, psi = self.jam[:, None], positive(states.T[0:n:2]), positive(states.T[1:n:2])
        empty = rho.real <= VACUUM * jam
        rho = np.where(empty, rho.real, rho)  # nothing depends on what a vacuum holds
        w = np.where(empty, self.v_f, psi / np.where(empty, 1.0, rho))
        v = positive(w - self.pressure(rho, jam), STANDING * self.v_f)
        return w, v, np.where(empty, 0.0, self.demand(rho, w, jam))

    def flows(self, states, inputs):
        """w and q [veh/h] of all cells, q from a cell to another, and q and w into each entry."""
        road, jam, outer, u = self.geometry, self.jam, self.outer_jam, inputs.T
        w, v, D = self.cells(states)
        q, passing, source, n_on = np.empty_like(D), {}, {}, len(road.on_ramps)
        junctions = {*road.on_ramps, *road.off_ramps}

        links = [(j - 1, j) for j in range(1, road.n_mainline) if j not in junctions]
        for ramp in (*road.on_ramp_segments, *road.off_ramp_segments):
            links += pairwise(ramp)
        for a, b in links:
            q[a] = passing[a, b] = least(D[a], self.supply(w[a], v[b], jam[b]))

        for b, ramp in zip(road.on_ramps, road.on_ramp_segments, strict=True):
            total = D[b - 1] + D[ramp[-1]]
            some = np.where(total.real > 0.0, total, 1.0)
            mixed = (D[b - 1] * w[b - 1] + D[ramp[-1]] * w[ramp[-1]]) / some
            k = least(np.ones_like(total), self.supply(mixed, v[b], jam[b]) / some)
            for a in (b - 1, ramp[-1]):
                q[a] = passing[a, b] = np.where(total.real > 0.0, k * D[a], D[a])

        ramps = zip(road.off_ramps, road.off_ramp_segments, road.exit_shares, strict=True)
        for b, ramp, share in ramps:
            a, off = b - 1, ramp[0]
            limit = self.supply(w[a], v[b], jam[b]) / (1.0 - share)
            if share > 0.0:
                branch = self.supply(w[a], v[off], jam[off]) / share
                tie = STANDING * jam[b] * self.v_f  # two blocked branches: that of the mainline
                held = np.where(branch.real < limit.real - tie, branch, limit)
                limit = held + np.minimum(branch.real, limit.real) - held.real
            q[a] = least(D[a], limit)
            passing[a, b], passing[a, off] = (1.0 - share) * q[a], share * q[a]

        # Inputs are D_in, w_in, rho_out, then D and w of each on-ramp, then rho of each off-ramp.
        exits = [road.n_mainline - 1, *(ramp[-1] for ramp in road.off_ramp_segments)]
        outside = [(u[2], outer[1]), *zip(u[2 * n_on + 3 :], outer[n_on + 2 :], strict=True)]
        for a, (density, jam_out) in zip(exits, outside, strict=True):
            speed = positive(w[a] - self.pressure(density, jam_out))
            q[a] = least(D[a], self.supply(w[a], speed, jam_out))

        entries = [0, *(ramp[0] for ramp in road.on_ramp_segments)]
        for i, c in enumerate(entries):
            offered, w_in = u[[0, 1]] if i == 0 else u[[2 * i + 1, 2 * i + 2]]
            if states.shape[1] > 2 * jam.size:
                offered = offered * states[:, 2 * jam.size + i]
            source[c] = least(offered, self.supply(w_in, v[c], jam[c])), w_in
        return w, q, passing, source

    # The update.

    def step(self, states, inputs):
        w, q, passing, source = self.flows(states, inputs)
        rho, psi = -q, -q * w
        for (a, b), flow in passing.items():
            rho[b] += flow
            psi[b] += flow * w[a]
        for c, (flow, w_in) in source.items():
            rho[c] += flow
            psi[c] += flow * w_in
        after, n, ratio = states.T.copy(), 2 * self.jam.size, self.ratio[:, None]
        before = states.T[0:n:2]
        after[0:n:2] += ratio * rho
        after[1:n:2] += ratio * psi + self.pull * (self.v_f * before - after[1:n:2])
        if self.kept is not None:
            after[n:] = self.kept * after[n:] + 1.0 - self.kept
        return after.T

    def jacobian(self, states, inputs):
        n, size = states.shape
        moved = (states[:, None] + 1e-30j * np.eye(size)).reshape(-1, size)
        after = self.step(moved, np.repeat(inputs, size, axis=0))
        return after.imag.reshape(n, size, size).swapaxes(1, 2) / 1e-30
