"""Roads, models and random states that the tests of the model share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dptse_env.model import ARZModel, ARZParameters, load_parameters
from dptse_env.model.parameters import VACUUM
from dptse_env.traffic import Corridor, Demand
from dptse_env.utils.arrays import FloatArray

PAPER = load_parameters("paper")
W99 = load_parameters("w99-3lane")
NO_RELAXATION = replace(PAPER, name="no relaxation", relaxation_time=float("inf"))


@dataclass(frozen=True)
class Road:
    """A road network with the fields that the model asks for."""

    n_mainline: int = 15
    on_ramps: tuple[int, ...] = ()
    off_ramps: tuple[int, ...] = ()
    exit_shares: tuple[float, ...] = ()
    segment_length: float = 0.1
    speed_limit: float = 102.0
    lanes: int = 3
    ramp_lanes: int = 1
    more_outside: int = 0

    @property
    def n_ramps(self) -> int:
        return len(self.on_ramps) + len(self.off_ramps)

    @property
    def on_ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        return tuple((self.n_mainline + i,) for i in range(len(self.on_ramps)))

    @property
    def off_ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        first = self.n_mainline + len(self.on_ramps)
        return tuple((first + o,) for o in range(len(self.off_ramps)))

    @property
    def segment_lanes(self) -> tuple[int, ...]:
        return (self.lanes,) * self.n_mainline + (self.ramp_lanes,) * self.n_ramps

    @property
    def segment_lengths(self) -> tuple[float, ...]:
        return (self.segment_length,) * (self.n_mainline + self.n_ramps)

    @property
    def speed_limits(self) -> tuple[float, ...]:
        return (self.speed_limit,) * (self.n_mainline + self.n_ramps)

    @property
    def boundary_lanes(self) -> tuple[int, ...]:
        lanes = (self.lanes,) * 2 + (self.ramp_lanes,) * self.n_ramps
        return tuple(each + self.more_outside for each in lanes)


UNEVEN = Corridor(
    name="uneven",
    n_mainline=8,
    on_ramps=(2, 3),
    off_ramps=(4, 6),
    exit_shares=(0.2, 0.1),
    demand=Demand(mainline=((0.0, 2000.0),), on_ramps=(300.0, 200.0)),
    incident=None,
    fixed_sensors=(7,),
    duration=200,
    lanes=(3, 3, 4, 4, 4, 3, 2, 2),
    ramp_lanes=(1, 2, 2, 1),
    segment_length=(0.1, 0.12, 0.2, 0.1, 0.35, 0.09, 0.1, 0.15),
    speed_limit=(102.0, 102.0, 102.0, 120.0, 120.0, 80.0, 80.0, 80.0),
    ramp_segments=(1, 3, 2, 1),
    ramp_length=(0.1, 0.08, 0.2, 0.15),
)
"""A road with segments and ramps of many kinds."""

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
