"""Consequences of the equations: exact solutions, balances, bounds, and the limits of each face."""

import numpy as np
import pytest

from dptse_env.model import ARZModel
from tests.helpers import stretch

from .oracle import (
    NO_RELAXATION,
    PUBLISHED,
    Oracle,
)

# Exact solutions ----------------------------------------------------------------------------------


V_F, JAM, GAMMA = PUBLISHED.free_flow_speed, PUBLISHED.jam_density, PUBLISHED.gamma
# (density [veh/km], speed [km/h]) left and right of the middle of a road of 4 km.
RIEMANN = {
    "shock and contact": ((60.0, 80.0), (150.0, 20.0)),
    "rarefaction and contact": ((200.0, 25.0), (90.0, 40.0)),
    "vacuum": ((150.0, 10.0), (50.0, 90.0)),
    "contact": ((60.0, 50.0), (180.0, 50.0)),
    "transonic": ((220.0, 10.0), (60.0, 45.0)),
    "queue": ((100.0, 60.0), (300.0, 0.0)),
}


def pressure(density):
    return V_F * (density / JAM) ** GAMMA


def exact(left, right, xi):
    """Density and flow at x / t = xi [km/h]."""
    (rho_l, v_l), (rho_r, v_r) = left, right
    w = v_l + pressure(rho_l)
    v_m = min(v_r, w)
    rho_m = JAM * ((w - v_m) / V_F) ** (1.0 / GAMMA)
    head, tail = v_l - GAMMA * pressure(rho_l), v_m - GAMMA * (w - v_m)
    if v_m < v_l:  # a shock
        head = tail = (rho_m * v_m - rho_l * v_l) / (rho_m - rho_l)
    v_fan = (xi + GAMMA * w) / (1.0 + GAMMA)
    rho_fan = JAM * (np.clip(w - v_fan, 0.0, None) / V_F) ** (1.0 / GAMMA)
    regions = [xi < head, xi < tail, xi < v_m, xi < v_r]
    rho = np.select(regions, [rho_l, rho_fan, rho_m, 0.0], rho_r)
    return rho, rho * np.select(regions, [v_l, v_fan, v_m, v_m], v_r)


def errors(left, right, n):
    """Mean errors of density and flow, as shares of the jam density and of v_f rho_m / 4."""
    length = 4.0 / n
    road = stretch(n_mainline=n, segment_length=length)
    model = ARZModel(road.road, NO_RELAXATION, 0.5 * 1.76 * length / 0.1)
    x = (np.arange(n) + 0.5) * length - 2.0
    rho, speed = np.where(x[:, None] < 0.0, left, right).T[:, None]
    states = model.states(rho, speed)
    w_in = left[1] + pressure(left[0])
    demand = Oracle(road, NO_RELAXATION).demand(np.array(left[0]), w_in, JAM)
    inputs, steps = np.array([[float(demand), w_in, right[0]]]), round(72.0 / model.time_step)
    for _ in range(steps):
        states = model.step(states, inputs)
    rho, flow = exact(left, right, x / (steps * model.time_step / 3600.0))
    got, speed = model.density(states)[0], model.speed(states)[0]
    flow_error = np.abs(got * speed - flow).mean() / (V_F * JAM / 4.0)
    return np.abs(got - rho).mean() / JAM, flow_error


@pytest.mark.parametrize(("left", "right"), RIEMANN.values(), ids=RIEMANN.keys())
def test_converges_to_the_exact_solution_of_the_riemann_problem(left, right):
    """Without relaxation (Aw and Rascle, 2000)."""
    for a, b in zip(errors(left, right, 100), errors(left, right, 800), strict=True):
        # Shocks converge like the length of a segment, contacts at best like its root.
        assert b < max(0.65 * a, 1e-6)
        assert b < 0.015


# Balances, bounds and limits ---------------------------------------------------------------------
