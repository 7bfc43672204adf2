"""Nominal flows, inputs and states, derived from the published demand alone."""

import numpy as np
import numpy.typing as npt

from dptse_env.model import ARZModel
from dptse_env.traffic import Corridor, Demand, DemandDistribution
from dptse_env.utils.arrays import FloatArray


def _published(corridor: Corridor) -> Demand:
    demand = corridor.demand
    return demand.base if isinstance(demand, DemandDistribution) else demand


def nominal_flows(corridor: Corridor, times: npt.ArrayLike) -> FloatArray:
    """Return the flows [veh/h] at the published demand, (..., S), at times [s] of shape (...)."""
    demand = _published(corridor)
    starts, rates = np.array(demand.mainline).T
    flow = rates[np.searchsorted(starts, times, side="right") - 1]
    on = dict(zip(corridor.on_ramps, demand.on_ramps, strict=True))
    off = dict(zip(corridor.off_ramps, corridor.exit_shares, strict=True))
    entering = [np.full_like(flow, rate) for rate in demand.on_ramps]
    mainline, leaving = [], []
    for segment in range(corridor.n_mainline):
        if segment in off:
            leaving.append(off[segment] * flow)
            flow = flow - leaving[-1]
        flow = flow + on.get(segment, 0.0)
        mainline.append(flow)
    ramps = zip(
        (*corridor.on_ramp_segments, *corridor.off_ramp_segments),
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
    layout, v_f = model.layout, model.parameters.free_flow_speed
    demand = _published(corridor)
    flows = nominal_flows(corridor, np.arange(corridor.duration + 1))
    inputs = np.empty((len(flows), model.n_inputs))
    inputs[:, layout.entry_inputs[0]] = flows[:, 0]  # no ramp lies ahead of the first segment
    inputs[:, layout.entry_inputs[1:]] = demand.on_ramps
    inputs[:, layout.entry_inputs + 1] = v_f
    leaving = flows[:, layout.exits]
    inputs[:, layout.exit_inputs] = free_flow_density(model, leaving, model.exit_jam_density)
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
