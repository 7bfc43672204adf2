"""What the estimator is told of the road's surroundings: the model's inputs, by second."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from dptse_env.arrays import FloatArray, IntArray
from dptse_env.model import ARZModel
from dptse_env.prior import nominal_inputs
from dptse_env.privacy import BoundaryInputs
from dptse_env.sensing import Sensing


class Boundary(Protocol):
    """Inputs of the model for a batch of episodes.

    Attributes:
        n_released: Boundary segments that the mechanism releases at every step.
        tables: What depends on traffic alone; a fork of the process shares it.
    """

    n_released: int

    @property
    def tables(self) -> tuple[FloatArray, ...]:
        """See above."""

    def load(self, slot: int) -> None:
        """Prepare for the traffic of a slot, which `Sensing` has loaded."""

    def reset(self, episodes: IntArray) -> None:
        """Begin new episodes, shape (k,)."""

    def inputs(self, episodes: IntArray, slots: IntArray, times: IntArray) -> FloatArray:
        """Return the inputs at some seconds of some traffic, shape (k, n_u)."""

    def take_in(self, episodes: IntArray, released: FloatArray) -> None:
        """Take in what the boundary segments released, shape (k, n_released, 2)."""


class TrueBoundary:
    """The measured traffic of the boundary segments, without noise, as in the paper."""

    n_released = 0

    def __init__(self, sensing: Sensing, model: ARZModel) -> None:
        """Prepare a table for all traffic seeds; nothing is loaded yet."""
        self._sensing, self._model = sensing, model
        shape = len(sensing.traffic_seeds), sensing.corridor.duration + 1, model.n_inputs
        # np.empty takes address space, not memory, until traffic is loaded into its slot.
        self._table = np.empty(shape)

    @property
    def tables(self) -> tuple[FloatArray, ...]:
        """The inputs of all traffic."""
        return (self._table,)

    def load(self, slot: int) -> None:
        """Work out the inputs of a slot's whole record."""
        traffic = self._sensing.traffic(slot)[:, self._model.n_segments :]
        self._table[slot] = self._model.boundary_inputs(traffic[..., 0], traffic[..., 1])

    def reset(self, episodes: IntArray) -> None:
        """Nothing is remembered."""

    def inputs(self, episodes: IntArray, slots: IntArray, times: IntArray) -> FloatArray:
        """Return the true inputs."""
        inputs: FloatArray = self._table[slots, times]
        return inputs

    def take_in(self, episodes: IntArray, released: FloatArray) -> None:
        """Nothing is released."""


class NominalBoundary:
    """The published demand, the same for every traffic seed."""

    n_released = 0

    def __init__(self, sensing: Sensing, model: ARZModel) -> None:
        """Work out the inputs of every second."""
        self._table = nominal_inputs(sensing.corridor, model)

    @property
    def tables(self) -> tuple[FloatArray, ...]:
        """The inputs of every second."""
        return (self._table,)

    def load(self, slot: int) -> None:
        """No traffic is needed."""

    def reset(self, episodes: IntArray) -> None:
        """Nothing is remembered."""

    def inputs(self, episodes: IntArray, slots: IntArray, times: IntArray) -> FloatArray:
        """Return the inputs at the published demand."""
        inputs: FloatArray = self._table[times]
        return inputs

    def take_in(self, episodes: IntArray, released: FloatArray) -> None:
        """Nothing is released."""


class PrivateBoundary(NominalBoundary):
    """What the boundary segments released in the step before; the published demand at first.

    A released flow is a speed at the density released with it, v_0 + q / rho; what a density
    below one vehicle per segment says of a speed is noise, and the free speed is taken.
    """

    def __init__(self, sensing: Sensing, model: ARZModel, n_episodes: int) -> None:
        """Begin with nothing released."""
        super().__init__(sensing, model)
        self.n_released = model.n_boundaries
        self._model, self._least_density = model, 1.0 / sensing.corridor.segment_length
        layout = model.layout
        self._jam_density = np.empty(model.n_boundaries)
        self._jam_density[layout.entry_boundaries] = model.entry_jam_density
        self._jam_density[layout.exit_boundaries] = model.exit_jam_density
        self._heard = np.zeros(n_episodes, dtype=bool)
        self._inputs = np.empty((n_episodes, model.n_inputs))

    def reset(self, episodes: IntArray) -> None:
        """Forget what was released."""
        self._heard[episodes] = False

    def inputs(self, episodes: IntArray, slots: IntArray, times: IntArray) -> FloatArray:
        """Return the inputs of the last release."""
        inputs: FloatArray = self._inputs[episodes]
        heard = self._heard[episodes]
        if not heard.all():
            inputs[~heard] = super().inputs(episodes, slots, times)[~heard]
        return inputs

    def take_in(self, episodes: IntArray, released: FloatArray) -> None:
        """Turn releases into inputs, within what the road can hold."""
        model = self._model
        # Not np.clip, which takes several times as long on so few numbers.
        density = np.minimum(np.maximum(released[..., 0], 0.0), self._jam_density)
        speed = released[..., 1]
        if model.reference_speed is not None:
            speed = speed / np.maximum(density, self._least_density) + model.reference_speed
            speed[density < self._least_density] = model.parameters.free_flow_speed
        speed = np.minimum(np.maximum(speed, 0.0), model.largest_speed)
        self._inputs[episodes] = model.boundary_inputs(density, speed)
        self._heard[episodes] = True


def make_boundary(
    kind: BoundaryInputs, sensing: Sensing, model: ARZModel, n_episodes: int
) -> Boundary:
    """Return the inputs of a kind."""
    if kind == "private":
        return PrivateBoundary(sensing, model, n_episodes)
    return NominalBoundary(sensing, model) if kind == "nominal" else TrueBoundary(sensing, model)
