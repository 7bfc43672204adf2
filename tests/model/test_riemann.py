"""Convergence to exact solutions of the Riemann problem without relaxation (Aw-Rascle 2000)."""

import numpy as np
import pytest

from dptse_env.model import ARZModel
from tests.helpers import Road

from .oracle import Oracle
from .roads import NO_RELAXATION

V_F, JAM, GAMMA = 102.0, 333.0, 2.0
ROAD_LENGTH, MINUTES = 4.0, 1.2

# (density [veh/km], speed [km/h]) left and right of the middle of the road.
CASES = {
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
    head = v_l - GAMMA * pressure(rho_l)
    tail = v_m - GAMMA * (w - v_m)
    if v_m <= v_l:  # shock, or nothing
        head = tail = (
            (rho_m * v_m - rho_l * v_l) / (rho_m - rho_l) if rho_m > rho_l + 1e-9 else head
        )
    v_fan = (xi + GAMMA * w) / (1.0 + GAMMA)
    rho_fan = JAM * (np.clip(w - v_fan, 0.0, None) / V_F) ** (1.0 / GAMMA)
    regions = [xi < head, xi < tail, xi < v_m, xi < v_r]
    rho = np.select(regions, [rho_l, rho_fan, rho_m, 0.0], rho_r)
    v = np.select(regions, [v_l, v_fan, v_m, v_m], v_r)
    return rho, rho * v


def errors(left, right, n):
    """Mean errors of density and flow, as shares of the jam density and of v_f rho_m / 4."""
    length = ROAD_LENGTH / n
    model = ARZModel(
        Road(n_mainline=n, segment_length=length), NO_RELAXATION, 0.5 * 1.76 * length / 0.1
    )
    x = (np.arange(n) + 0.5) * length - ROAD_LENGTH / 2.0
    rho = np.where(x < 0.0, left[0], right[0])[None]
    v = np.where(x < 0.0, left[1], right[1])[None]
    states = model.states(rho, v)
    w_in = left[1] + pressure(left[0])
    demand = Oracle(model.network, NO_RELAXATION).demand(np.array(left[0]), w_in, JAM)
    inputs = np.array([[float(demand), w_in, right[0]]])
    steps = round(MINUTES * 60.0 / model.time_step)
    for _ in range(steps):
        states = model.step(states, inputs)
    rho, flow = exact(left, right, x / (steps * model.time_step / 3600.0))
    got = model.density(states)[0]
    return (
        np.abs(got - rho).mean() / JAM,
        np.abs(got * model.speed(states)[0] - flow).mean() / (V_F * JAM / 4.0),
    )


@pytest.mark.parametrize(("left", "right"), CASES.values(), ids=CASES.keys())
def test_converges_to_the_exact_solution(left, right):
    coarse, fine = errors(left, right, 100), errors(left, right, 800)
    for a, b in zip(coarse, fine, strict=True):
        # Shocks converge like l, contacts at best like its root.
        assert b < max(0.65 * a, 1e-6)
        assert b < 0.015
