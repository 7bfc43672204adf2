"""Inputs of the traffic model at the road's ends and ramps: true, nominal or private."""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.model import ARZModel
from dptse_env.release.nominal import nominal_inputs
from dptse_env.release.settings import BoundaryInputs
from dptse_env.release.traffic_table import TrafficTable
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class BoundaryModel(ABC):
    """Inputs of the traffic model for a batch of episodes.

    Attributes:
        void_reasons: Reasons for which these inputs void a guarantee.
    """

    void_reasons: ClassVar[tuple[str, ...]] = ()

    @property
    @abstractmethod
    def shared(self) -> tuple[FloatArray, ...]:
        """Arrays that depend on the traffic alone, so that forks of the process share them."""

    @abstractmethod
    def inputs(self, episodes: IntArray, traffic: IntArray, times: IntArray) -> FloatArray:
        """Return inputs (k, n_u) of episodes (k,), by index of the traffic seed and second (k,)."""

    def load(self, index: int) -> None:  # noqa: B027 (nothing by default)
        """Prepare for the traffic of an index, which the traffic table has loaded."""

    def reset(self, episodes: IntArray) -> None:  # noqa: B027 (nothing by default)
        """Begin new episodes, shape (k,)."""

    def update(self, episodes: IntArray, measured: Measurement) -> None:  # noqa: B027 (nothing)
        """Take the releases of the boundary segments of k episodes, shape (k,)."""


class TrueBoundary(BoundaryModel):
    """The measured traffic of the boundary segments, without noise, as in the paper."""

    void_reasons: ClassVar[tuple[str, ...]] = ("boundary_inputs",)

    def __init__(self, traffic: TrafficTable, model: ARZModel, n_episodes: int) -> None:
        """Prepare a table for all traffic seeds; nothing is loaded yet."""
        self._traffic, self._model = traffic, model
        shape = len(traffic.traffic_seeds), traffic.corridor.duration + 1, model.n_inputs
        # np.empty takes address space, not memory, until traffic is loaded.
        self._table = np.empty(shape)

    @property
    def shared(self) -> tuple[FloatArray, ...]:
        """The inputs of all traffic."""
        return (self._table,)

    def load(self, index: int) -> None:
        """Compute the inputs of a complete record."""
        traffic = self._traffic.complete(index)[:, self._model.n_segments :]
        self._table[index] = self._model.boundary_inputs(traffic[..., 0], traffic[..., 1])

    def inputs(self, episodes: IntArray, traffic: IntArray, times: IntArray) -> FloatArray:
        """Return the true inputs."""
        inputs: FloatArray = self._table[traffic, times]
        return inputs


class NominalBoundary(BoundaryModel):
    """The published demand, the same for every traffic seed."""

    def __init__(self, traffic: TrafficTable, model: ARZModel, n_episodes: int) -> None:
        """Compute the inputs of every second."""
        self._table = nominal_inputs(traffic.corridor, model)

    @property
    def shared(self) -> tuple[FloatArray, ...]:
        """The inputs of every second."""
        return (self._table,)

    def inputs(self, episodes: IntArray, traffic: IntArray, times: IntArray) -> FloatArray:
        """Return the inputs at the published demand."""
        inputs: FloatArray = self._table[times]
        return inputs


class PrivateBoundary(NominalBoundary):
    """Inputs from the boundary segments' releases a step ago; the published demand at first.

    A released flow gives a speed by the density released with it, v_0 + q / rho; below a density
    of one vehicle per segment that is mostly noise, and the free speed is used.
    """

    def __init__(self, traffic: TrafficTable, model: ARZModel, n_episodes: int) -> None:
        """Prepare for episodes without any release yet."""
        super().__init__(traffic, model, n_episodes)
        self._model, corridor = model, traffic.corridor
        lengths = [corridor.segment_lengths[s] for s in corridor.boundary_neighbours]
        self._least_density = 1.0 / np.array(lengths)
        layout = model.layout
        self._jam_density = np.empty(model.n_boundaries)
        self._jam_density[layout.entry_boundaries] = model.entry_jam_density
        self._jam_density[layout.exit_boundaries] = model.exit_jam_density
        self._has_release: BoolArray = np.zeros(n_episodes, dtype=bool)
        self._inputs = np.empty((n_episodes, model.n_inputs))

    def reset(self, episodes: IntArray) -> None:
        """Forget earlier releases."""
        self._has_release[episodes] = False

    def inputs(self, episodes: IntArray, traffic: IntArray, times: IntArray) -> FloatArray:
        """Return the inputs of the last release."""
        inputs: FloatArray = self._inputs[episodes]
        has_release = self._has_release[episodes]
        if not has_release.all():
            inputs[~has_release] = super().inputs(episodes, traffic, times)[~has_release]
        return inputs

    def update(self, episodes: IntArray, measured: Measurement) -> None:
        """Turn releases into inputs, within what the road can hold."""
        model = self._model
        released = measured.values[:, model.rows.n_rows :]
        # Not np.clip, which takes several times as long on so few numbers.
        density = np.minimum(np.maximum(released[..., 0], 0.0), self._jam_density)
        speed = released[..., 1]
        if model.reference_speed is not None:
            centre = measured.centre[:, model.n_segments :]
            speed = speed / np.maximum(density, self._least_density) + centre
            speed[density < self._least_density] = model.parameters.free_flow_speed
        speed = np.minimum(np.maximum(speed, 0.0), model.largest_speed)
        self._inputs[episodes] = model.boundary_inputs(density, speed)
        self._has_release[episodes] = True


BOUNDARIES: dict[BoundaryInputs, type[TrueBoundary | NominalBoundary]] = {
    "true": TrueBoundary,
    "nominal": NominalBoundary,
    "private": PrivateBoundary,
}
"""Boundary models by the value of ``privacy.boundary_inputs``."""
