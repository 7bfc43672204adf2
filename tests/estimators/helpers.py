"""Simulated episodes for the tests of estimators, what runs them, and weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from dptse_env.estimators import (
    ESTIMATORS,
    REFERENCES,
    DemandSettings,
    EstimatorSettings,
    Measurement,
    RecurrentSettings,
    make_estimator,
)
from dptse_env.estimators.base import Estimator
from dptse_env.estimators.recurrent import FORMAT, write_weights
from dptse_env.estimators.recurrent_kernels import FEATURES, Weights, shapes
from dptse_env.model import ARZModel, Channels, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY, Corridor
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from tests.helpers import make_channels

EVERY = [(name, "compiled") for name in ESTIMATORS] + [(name, "reference") for name in REFERENCES]
RELEASES = ("speed", "flow", "rows")
"""Release of sensors beside the density: the mean speed, or the flow rho (v - v_0); or flows and
densities of rows of several segments, each with noise and speeds v_0 of its own."""
FIELDS = ("density", "speed", "density_std", "speed_std")
REFERENCE_SPEED = 51.0
# The noise of a flow is v_0 times the density's where both get the same share of the privacy.
SPEEDS, FLOWS = np.array([15.0, 6.0]), np.array([15.0, 15.0 * REFERENCE_SPEED])
PLAIN = EstimatorSettings()
RICH = EstimatorSettings(vehicle_noise=(0.04, 0.02), flicker=True, demand=DemandSettings())


@dataclass(frozen=True)
class Episodes:
    """n episodes of K steps: what drives a filter and what it should find."""

    model: ARZModel
    start: FloatArray  # (n, 2 S) prior means
    inputs: FloatArray  # (K, n, n_u)
    truth: FloatArray  # (K, n, 2 S)
    observed: BoolArray  # (K, n, M)
    values: FloatArray  # (K, n, M, 2)
    sigma: FloatArray  # (K, n, M, 2)
    centre: FloatArray | None = None  # (K, n, S) speeds that flows are centred on [km/h]

    @property
    def everyone(self) -> IntArray:
        return np.arange(len(self.start))

    def released(self, k: int, which: Any) -> dict[str, Any]:
        """The release of a step of episodes, as arguments of `Measurement.of`."""
        names = ("observed", "values", "sigma", *(() if self.centre is None else ("centre",)))
        return {name: getattr(self, name)[k, which] for name in names}


def model_of(parameters: str, release: str, road: Corridor = PAPER_HIGHWAY) -> ARZModel:
    """A road as its sensors release it."""
    speed = None if release == "speed" else REFERENCE_SPEED
    channels = None
    if release == "rows":
        channels = every_channel(road.road.n_segments, road.road.n_mainline)
    return ARZModel(road.road, load_parameters(parameters), centre=speed, channels=channels)


def every_channel(n_segments: int, n_mainline: int) -> Channels:
    """All segments singly, then all pairs and triples of the mainline, which overlap."""
    pairs = [(first, 1) for first in range(n_segments)]
    pairs += [(first, span) for span in (2, 3) for first in range(n_mainline + 1 - span)]
    first, span = np.array(pairs, dtype=np.int64).T
    return make_channels(first, span)


def simulate(
    parameters: str = "w99-3lane",
    n: int = 1,
    n_steps: int = 700,
    noise: float = 1.0,
    release: str = "speed",
    road: Corridor = PAPER_HIGHWAY,
) -> Episodes:
    """Demand that swells and a queue from the exit, disturbed, roaming sensors, noise."""
    model, rng = model_of(parameters, release, road), np.random.default_rng(0)
    s, jam, v_f = model.n_segments, model.jam_density, model.parameters.free_flow_speed
    per_lane = model.parameters.jam_density / model.parameters.lanes

    t = np.arange(n_steps)[:, None, None]
    phase = rng.uniform(0.0, 2.0 * np.pi, (n, model.n_boundaries))
    filling = 0.06 + 0.04 * np.sin(2.0 * np.pi * t / 90.0 + phase)
    filling[200:400, :, 0] += 0.06
    filling[200:400, :, 1] += 0.25
    rho = filling * per_lane * road.road.lanes[s:]
    v = v_f * (1.0 - filling**model.parameters.gamma)
    inputs = np.stack([model.boundary_inputs(a, b) for a, b in zip(rho, v, strict=True)])

    truth = np.empty((n_steps, n, model.n_states))
    state = model.states(np.full((n, s), 0.06) * jam, np.full((n, s), 0.6 * v_f))
    for k in range(n_steps):
        state = model.step(state, inputs[k])
        swerve = 1.0 + 0.01 * rng.normal(size=state.shape)
        truth[k] = state = model.project(state * swerve)

    shape, centre = (n_steps, n, model.channels.size), None
    sigma = np.broadcast_to(SPEEDS if release == "speed" else FLOWS, (*shape, 2))
    if release == "rows":
        observed = rng.random(shape) < 0.3
        observed[::10] = True
        sigma = sigma * rng.uniform(0.2, 2.0, sigma.shape)
        centre = rng.uniform(20.0, 90.0, (n_steps, n, s))
    else:
        observed = rng.random(shape).argsort(axis=-1) < 5
        observed[..., model.road.exits] = True
    start = model.states(np.full((n, s), 0.1) * jam, np.full((n, s), 0.5 * v_f))
    values = _measured(model, truth, centre) + noise * sigma * rng.normal(size=sigma.shape)
    return Episodes(model, start, inputs, truth, observed, values, sigma, centre)


def _measured(model: ARZModel, truth: FloatArray, centre: FloatArray | None) -> FloatArray:
    around = [None] * len(truth) if centre is None else centre
    return np.stack([model.measure(x, v_0) for x, v_0 in zip(truth, around, strict=True)])


# Running ------------------------------------------------------------------------------------------


def random_streams(n: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, i]) for i in range(n)]


def started(
    name: str,
    backend: str,
    episodes: Episodes,
    settings: EstimatorSettings = PLAIN,
    start: FloatArray | None = None,
    seed: int = 0,
) -> Estimator:
    """An estimator that is reset to the episodes' prior, or to another one."""
    n = len(episodes.start)
    estimator = make_estimator(name, backend, episodes.model, n, settings)
    start = episodes.start if start is None else start
    estimator.reset(episodes.everyone, start, random_streams(n, seed))
    return estimator


def update(
    estimator: Estimator, episodes: Episodes, k: int, which: Any = None, **changes: Any
) -> None:
    """Update an estimator by what is released in a step, of all episodes or of some."""
    which = episodes.everyone if which is None else np.asarray(which)
    given = episodes.released(k, which) | changes
    estimator.update(which, Measurement.of(estimator.model, **given))


def step(
    estimator: Estimator, episodes: Episodes, k: int, which: Any = None, **changes: Any
) -> None:
    """Predict an estimator one step ahead, and update it."""
    which = episodes.everyone if which is None else np.asarray(which)
    inputs = changes.pop("inputs", episodes.inputs[k, which])
    estimator.predict(which, inputs)
    update(estimator, episodes, k, which, **changes)


def run(
    estimator: Estimator,
    episodes: Episodes,
    steps: Iterable[int],
    watch: Callable[[int], None] = lambda _: None,
    **changes: Any,
) -> None:
    """Take the steps k of all episodes."""
    for k in steps:
        step(estimator, episodes, k, **changes)
        watch(k)


class Snapshot(NamedTuple):
    """Everything that an estimator exposes."""

    density: np.ndarray
    speed: np.ndarray
    density_std: np.ndarray
    speed_std: np.ndarray
    innovations: np.ndarray
    diverged: np.ndarray
    fallback: np.ndarray
    states: np.ndarray


def show(estimator: Estimator) -> Snapshot:
    inner = estimator.means if hasattr(estimator, "means") else estimator.states
    others = estimator.innovations, estimator.diverged, estimator.fallback, inner
    return Snapshot(*estimator.estimate(), *(array.copy() for array in others))


def assert_same(one: Snapshot, other: Snapshot, episodes=slice(None), of=slice(None)) -> None:
    for field in Snapshot._fields:
        a, b = getattr(one, field)[episodes], getattr(other, field)[of]
        np.testing.assert_array_equal(a, b, err_msg=field)


# Weights ------------------------------------------------------------------------------------------

RANGES = {
    "n_mainline": [2, 30],
    "segment_length": [0.05, 0.2],
    "speed_limit": [80.0, 130.0],
    "lanes": [1, 4],
    "span": [1, 3],
    "flows": [0, 1],
}


def random_weights(width=8):
    """Weights of the size that training gives, so that gates work and outputs move."""
    rng, size = np.random.default_rng(0), 0.4 * (8 / width) ** 0.5
    arrays = {name: rng.normal(0.0, size, shape) for name, shape in shapes(width).items()}
    return Weights(**{name: array.astype(np.float32) for name, array in arrays.items()})


def card(**ranges):
    return {
        "name": "random",
        "format": FORMAT,
        "channels": list(FEATURES),
        "ranges": {**RANGES, **ranges},
        "training": {"seed": 0},
    }


def weights_settings(folder, weights=None, **ranges):
    """Settings of weights that are written into a folder."""
    path = folder / "weights.safetensors"
    weights = weights or random_weights()
    write_weights(path, weights, card(**ranges))
    return EstimatorSettings(recurrent=RecurrentSettings(weights=str(path)))
