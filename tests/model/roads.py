"""Roads, models and random states that the tests of the model share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dptse_env.model import ARZModel, ARZParameters, load_parameters
from dptse_env.model.parameters import VACUUM
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import FloatArray
from tests.helpers import UNEVEN, Road

PAPER = load_parameters("paper")
W99 = load_parameters("w99-3lane")
NO_RELAXATION = replace(PAPER, name="no relaxation", relaxation_time=float("inf"))


HIGHWAY = Road(on_ramps=(3, 9), off_ramps=(6, 12), exit_shares=(0.1, 0.1))
STRAIGHT = Road()
# Every kind of face beside every other, an off-ramp that nobody takes, and wider roads outside.
CROWDED = Road(
    on_ramps=(3, 5), off_ramps=(4, 6), exit_shares=(0.0, 0.5), ramp_lanes=3, more_outside=1
)
ROADS = {
    "highway": HIGHWAY,
    "uneven": UNEVEN,
    "crowded": CROWDED,
    "straight": STRAIGHT,
    "one cell": Road(n_mainline=1),
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
    density *= np.array(model.network.boundary_lanes)
    density[rng.random(density.shape) < 0.1] = 0.0
    return model.boundary_inputs(density, rng.uniform(0.0, model.speed_scale, density.shape))


def model_of(
    road: Road | Corridor, parameters: ARZParameters = PAPER, time_step: float = 1.0, **keywords
) -> ARZModel:
    return ARZModel(road, parameters, time_step, **keywords)
