"""Roads, models and random states that the tests of the model share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dptse_env.model.arz import ARZModel
from dptse_env.model.parameters import ARZParameters, load_parameters
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

    @property
    def segment_lanes(self) -> tuple[int, ...]:
        ramps = len(self.on_ramps) + len(self.off_ramps)
        return (self.lanes,) * self.n_mainline + (self.ramp_lanes,) * ramps


HIGHWAY = Road(on_ramps=(3, 9), off_ramps=(6, 12), exit_shares=(0.1, 0.1))
STRAIGHT = Road()


def random_states(model: ARZModel, n: int, rng: np.random.Generator) -> FloatArray:
    """States all over the cone, with empty, jammed and standing cells among them."""
    jam = model.jam_density
    density = rng.uniform(0.0, 1.0, (n, model.n_segments)) ** rng.choice([0.5, 2.0], (n, 1)) * jam
    density[rng.random(density.shape) < 0.05] = 0.0
    v_f = model.parameters.free_flow_speed
    largest = np.maximum(1.1 * v_f - model.relations.pressure(density, jam), 0.0)
    speed = largest * rng.uniform(0.0, 1.0, density.shape)
    speed[rng.random(density.shape) < 0.05] = 0.0
    return model.states(density, speed)


def random_inputs(model: ARZModel, n: int, rng: np.random.Generator) -> FloatArray:
    """Inputs of boundary cells all over the cone."""
    per_lane = model.parameters.jam_density / model.parameters.lanes
    density = rng.uniform(0.0, 1.2, (n, model.n_boundaries)) * per_lane
    density[:, :2] *= 3.0
    density[rng.random(density.shape) < 0.1] = 0.0
    speed = rng.uniform(0.0, 1.0, density.shape) * model.parameters.free_flow_speed
    return model.boundary_inputs(density, speed)


def model_of(
    road: Road,
    parameters: ARZParameters = PAPER,
    time_step: float = 1.0,
    reference_speed: float | None = None,
) -> ARZModel:
    return ARZModel(road, parameters, time_step, reference_speed)
