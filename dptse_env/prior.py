"""Where an estimator starts: what the published demand alone says about the road."""

from __future__ import annotations

import numpy as np

from dptse_env.arrays import FloatArray
from dptse_env.model import ARZModel
from dptse_env.traffic import Corridor, DemandDistribution


def nominal_flows(corridor: Corridor, time: float) -> FloatArray:
    """Return the flow through each segment at the published demand [veh/h], shape (S,).

    Args:
        corridor: The road; a demand distribution counts with its base.
        time: Second of the record [s].
    """
    demand = corridor.demand
    if isinstance(demand, DemandDistribution):
        demand = demand.base
    flow = next(rate for start, rate in reversed(demand.mainline) if start <= time)
    on = dict(zip(corridor.on_ramps, demand.on_ramps, strict=True))
    off = dict(zip(corridor.off_ramps, corridor.exit_shares, strict=True))
    mainline, exits = [], []
    for segment in range(corridor.n_mainline):
        if segment in off:
            exits.append(off[segment] * flow)
            flow -= exits[-1]
        flow += on.get(segment, 0.0)
        mainline.append(flow)
    return np.array([*mainline, *demand.on_ramps, *exits])


def free_flow_density(model: ARZModel, flow: FloatArray) -> FloatArray:
    """Return the density [veh/km] at which each segment carries ``flow`` freely, both (S,).

    The smaller root of q = rho (v_f - p(rho)); a flow above the capacity gives the critical
    density.
    """
    v_f, gamma = model.parameters.free_flow_speed, model.parameters.gamma
    filling = np.linspace(0.0, (1.0 + gamma) ** (-1.0 / gamma), 4096)
    scaled_flow = filling * (1.0 - filling**gamma)
    return model.jam_density * np.interp(flow / (model.jam_density * v_f), scaled_flow, filling)


def nominal_state(corridor: Corridor, model: ARZModel, time: float) -> FloatArray:
    """Return the free-flow equilibrium of the published demand, shape (n_x,).

    It is public: it depends on the corridor's description and the clock, never on a record.
    """
    density = free_flow_density(model, nominal_flows(corridor, time))
    v_f, gamma = model.parameters.free_flow_speed, model.parameters.gamma
    speed = v_f * (1.0 - (density / model.jam_density) ** gamma)
    return model.states(density, speed)
