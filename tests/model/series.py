"""Runs of traffic made by a known model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dptse_env.model.compiled import CompiledARZModel
from dptse_env.model.prediction import TrafficSeries

from .roads import HIGHWAY, PAPER

TRUTH = replace(PAPER, name="truth", free_flow_speed=110.0, gamma=1.2, relaxation_time=30.0)


def simulated(seed: int, n_steps: int = 240) -> TrafficSeries:
    """Waves of demand and a passing queue at the exit, by the model itself."""
    model = CompiledARZModel(HIGHWAY, TRUTH)
    rng = np.random.default_rng(seed)
    t = np.arange(n_steps)[:, None]
    phase, slow = rng.uniform(0.0, 2 * np.pi, 6), rng.uniform(40.0, 80.0, 6)
    share = 0.25 + 0.2 * np.sin(2 * np.pi * t / slow + phase)
    share[n_steps // 3 : n_steps // 2, 1] = 0.9
    jam = TRUTH.jam_density * np.array([3, 3, 1, 1, 1, 1]) / 3.0
    density = share * jam
    speed = TRUTH.free_flow_speed * (1.0 - share**TRUTH.gamma)
    inputs = model.boundary_inputs(density, speed)
    states = model.states(np.full((1, 19), 30.0), np.full((1, 19), 80.0))
    rows = [states]
    for k in range(n_steps - 1):
        rows.append(model.step(rows[-1], inputs[k : k + 1]))
    history = np.concatenate(rows)
    return TrafficSeries(model.density(history), model.speed(history), density, speed)
