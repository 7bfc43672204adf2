"""Episodes of synthetic traffic for the tests of estimators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dptse_env.model.arz import ARZModel
from dptse_env.model.compiled import CompiledARZModel
from dptse_env.model.network import BoolArray, FloatArray
from dptse_env.model.parameters import load_parameters
from dptse_env.traffic import PAPER_HIGHWAY

SIGMA = np.array([15.0, 6.0])  # [veh/km, km/h]
FIXED_SENSORS = (14, 17, 18)


@dataclass(frozen=True)
class Episodes:
    """n episodes of K steps: what drives a filter and what it should find."""

    model: ARZModel
    start: FloatArray  # (n, 2 S) prior means
    inputs: FloatArray  # (K, n, n_u)
    observed: BoolArray  # (K, n, S)
    values: FloatArray  # (K, n, S, 2)
    truth: FloatArray  # (K, n, 2 S)

    @property
    def everyone(self) -> np.ndarray:
        return np.arange(len(self.start))


def simulate(
    parameters: str = "w99-3lane", n: int = 1, n_steps: int = 700, seed: int = 0, noise: float = 1.0
) -> Episodes:
    """Demand that swells and a queue from the exit, disturbed, five roaming sensors, noise."""
    model = CompiledARZModel(PAPER_HIGHWAY, load_parameters(parameters))
    rng = np.random.default_rng(seed)
    s, jam, v_f = model.n_segments, model.jam_density, model.parameters.free_flow_speed
    boundary_jam = model.density_scale * np.array([1.0, 1.0, *[1.0 / 3.0] * 4])

    t = np.arange(n_steps)[:, None, None]
    phase = rng.uniform(0.0, 2.0 * np.pi, (n, 6))
    filling = 0.06 + 0.04 * np.sin(2.0 * np.pi * t / 90.0 + phase)
    crowded = (t >= 200) & (t < 400)
    filling = filling + np.where(crowded, [0.06, 0.25, 0.0, 0.0, 0.0, 0.0], 0.0)
    rho = filling * boundary_jam
    v = v_f * (1.0 - filling**model.parameters.gamma)
    inputs = np.stack([model.boundary_inputs(a, b) for a, b in zip(rho, v, strict=True)])

    truth = np.empty((n_steps, n, model.n_states))
    state = model.states(np.full((n, s), 0.06) * jam, np.full((n, s), 0.6 * v_f))
    for k in range(n_steps):
        state = model.step(state, inputs[k])
        swerve = 1.0 + 0.01 * rng.normal(size=state.shape)
        truth[k] = state = model.project(state * swerve)

    observed = rng.random((n_steps, n, s)).argsort(axis=-1) < 5
    observed[..., list(FIXED_SENSORS)] = True
    values = np.stack([model.measure(x) for x in truth])
    values += noise * SIGMA * rng.normal(size=values.shape)
    start = model.states(np.full((n, s), 0.1) * jam, np.full((n, s), 0.5 * v_f))
    return Episodes(model, start, inputs, observed, values, truth)


def random_streams(n: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, i]) for i in range(n)]
