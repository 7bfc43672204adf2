"""Nominal flows, inputs and states, derived from the published demand alone."""

import numpy as np
import numpy.typing as npt

from dptse_env.model import ARZModel
from dptse_env.traffic import Corridor
from dptse_env.traffic.demand import value_at
from dptse_env.utils.arrays import FloatArray


def nominal_flows(corridor: Corridor, times: npt.ArrayLike) -> FloatArray:
    """Return the flows [veh/h] at the published demand, (..., S), at times [s] of shape (...)."""
    demand = corridor.published_demand
    flow = value_at(demand.mainline, times)
    entering = [value_at(steps, times) for steps in demand.ramp_profiles]
    on = dict(zip(corridor.on_ramps, entering, strict=True))
    shares: list[FloatArray] = (
        [np.full_like(flow, share) for share in corridor.exit_shares]
        if demand.exit_shares is None
        else [value_at(steps, times) for steps in demand.exit_shares]
    )
    off = dict(zip(corridor.off_ramps, shares, strict=True))
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
    flows = nominal_flows(corridor, np.arange(corridor.duration + 1))
    inputs = np.empty((len(flows), model.n_inputs))
    inputs[:, layout.entry_inputs[0]] = flows[:, 0]  # no ramp lies ahead of the first segment
    inputs[:, layout.entry_inputs[1:]] = flows[:, layout.entries[1:]]
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
