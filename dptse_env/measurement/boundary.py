"""Inputs of the traffic model at the road's ends and ramps: true, nominal or private.

Nominal flows, inputs and states follow from the published demand alone.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from dptse_env.estimators import Measurement
from dptse_env.model import ARZModel
from dptse_env.release import BoundaryInputs, Task, Traffic
from dptse_env.traffic import Corridor
from dptse_env.traffic.demand import value_at
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class BoundaryModel(ABC):
    """Inputs of the traffic model for a batch of episodes.

    Attributes:
        void_reasons: Reasons for which these inputs void a guarantee.
    """

    void_reasons: ClassVar[tuple[str, ...]] = ()

    def __init__(self, task: Task, traffic: Traffic, model: ARZModel) -> None:
        """Store the configuration; nothing is loaded."""
        self.task, self.traffic, self.model = task, traffic, model

    @property
    def shared(self) -> tuple[FloatArray, ...]:
        """Arrays that no episode changes, so that forks of the process share them."""
        return ()

    @abstractmethod
    def inputs(self, episodes: IntArray, traffic: IntArray, times: IntArray) -> FloatArray:
        """Return inputs (k, n_u) of episodes (k,), by index of the traffic seed and second (k,)."""

    def reset(self, episodes: IntArray) -> None:  # noqa: B027 (nothing by default)
        """Begin new episodes, shape (k,)."""

    def update(self, episodes: IntArray, measured: Measurement) -> None:  # noqa: B027 (nothing)
        """Take the release of a second, whose last R channels are the boundary segments."""


class TrueBoundary(BoundaryModel):
    """The measured traffic of the boundary segments, without noise, as in the paper."""

    void_reasons: ClassVar[tuple[str, ...]] = ("boundary_inputs",)

    def __init__(self, task: Task, traffic: Traffic, model: ARZModel) -> None:
        """Prepare a table for all traffic seeds."""
        super().__init__(task, traffic, model)
        shape = task.corridor.conditions.duration + 1, model.n_inputs
        self._table = traffic.derived(shape, self._inputs_of)

    @property
    def shared(self) -> tuple[FloatArray, ...]:
        """The inputs of all traffic."""
        return (self._table,)

    def _inputs_of(self, index: int) -> FloatArray:
        """Return the inputs of a complete record."""
        traffic = self.traffic.complete(index)[:, self.model.n_segments :]
        return self.model.boundary_inputs(traffic[..., 0], traffic[..., 1])

    def inputs(self, episodes: IntArray, traffic: IntArray, times: IntArray) -> FloatArray:
        """Return the true inputs."""
        inputs: FloatArray = self._table[traffic, times]
        return inputs


class NominalBoundary(BoundaryModel):
    """The published demand, the same for every traffic seed."""

    def __init__(self, task: Task, traffic: Traffic, model: ARZModel) -> None:
        """Compute the inputs of every second."""
        super().__init__(task, traffic, model)
        self._table = nominal_inputs(task.corridor, model)

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

    A released flow gives a speed by the density released with it, c + q / rho, around the centre c
    of the release; below a density of one vehicle per segment that is mostly noise, and the free
    speed is used.
    """

    def __init__(self, task: Task, traffic: Traffic, model: ARZModel) -> None:
        """Prepare for episodes without any release yet."""
        super().__init__(task, traffic, model)
        self._least_density = 1.0 / task.channels.length[task.n_on_road :]
        self._jam_density = model.arz.jam[model.n_segments :]
        self._has_release: BoolArray = np.zeros(task.n_episodes, dtype=bool)
        self._inputs = np.empty((task.n_episodes, model.n_inputs))

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
        model, released = self.model, measured.values[:, self.task.n_on_road :]
        # Not np.clip, which takes several times as long on so few numbers.
        density = np.minimum(np.maximum(released[..., 0], 0.0), self._jam_density)
        speed = released[..., 1]
        if model.releases_flow:
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


def nominal_flows(corridor: Corridor, times: npt.ArrayLike) -> FloatArray:
    """Return the flows [veh/h] at the published demand, (..., S), at times [s] of shape (...)."""
    demand = corridor.conditions.published_demand
    flow = value_at(demand.mainline, times)
    entering = [value_at(steps, times) for steps in demand.ramp_profiles]
    on = dict(zip(corridor.geometry.on_ramps, entering, strict=True))
    shares: list[FloatArray] = (
        [np.full_like(flow, share) for share in corridor.geometry.exit_shares]
        if demand.exit_shares is None
        else [value_at(steps, times) for steps in demand.exit_shares]
    )
    off = dict(zip(corridor.geometry.off_ramps, shares, strict=True))
    mainline, leaving = [], []
    for segment in range(corridor.geometry.n_mainline):
        if segment in off:
            leaving.append(off[segment] * flow)
            flow = flow - leaving[-1]
        flow = flow + on.get(segment, 0.0)
        mainline.append(flow)
    ramps = zip(
        (*corridor.geometry.on_ramp_segments, *corridor.geometry.off_ramp_segments),
        (*entering, *leaving),
        strict=True,
    )
    of_ramps = [of_ramp for segments, of_ramp in ramps for _ in segments]
    return np.stack([*mainline, *of_ramps], axis=-1)


def free_flow_density(
    model: ARZModel, flow: FloatArray, jam: FloatArray | None = None
) -> FloatArray:
    """Return the density [veh/km] at which each segment carries ``flow`` freely, both (..., S).

    The smaller root of q = rho (v_f - p(rho)); a flow above the capacity gives the critical
    density. Jam densities are by default those of the segments.
    """
    jam = model.jam_density if jam is None else jam
    v_f, gamma = model.parameters.free_flow_speed, model.parameters.gamma
    filling = np.linspace(0.0, (1.0 + gamma) ** (-1.0 / gamma), 4096)
    scaled_flow = filling * (1.0 - filling**gamma)
    density: FloatArray = jam * np.interp(flow / (jam * v_f), scaled_flow, filling)
    return density


def nominal_inputs(corridor: Corridor, model: ARZModel) -> FloatArray:
    """Return the model's inputs at the published demand for every second, shape (T + 1, n_u).

    Vehicles enter at free speed; behind the exits traffic flows freely, at the density of the flow
    that reaches them. Incidents are not considered.
    """
    road, v_f = model.road, model.parameters.free_flow_speed
    flows = nominal_flows(corridor, np.arange(corridor.conditions.duration + 1))
    inputs = np.empty((len(flows), model.n_inputs))
    inputs[:, road.entry_inputs] = flows[:, road.entries]  # no ramp lies ahead of the first segment
    inputs[:, road.entry_inputs + 1] = v_f
    jam = model.arz.jam[road.exit_cells]
    inputs[:, road.exit_inputs] = free_flow_density(model, flows[:, road.exits], jam)
    return inputs


def nominal_state(corridor: Corridor, model: ARZModel, times: npt.ArrayLike) -> FloatArray:
    """Return the free-flow equilibrium of the published demand, shape (..., n_x).

    It is public: it depends on the corridor's description and on the times [s] of shape (...),
    never on a record.
    """
    density = free_flow_density(model, nominal_flows(corridor, times))
    v_f, gamma = model.parameters.free_flow_speed, model.parameters.gamma
    speed = v_f * (1.0 - (density / model.jam_density) ** gamma)
    return model.states(density, speed)
