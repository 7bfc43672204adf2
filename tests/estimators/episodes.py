"""Episodes for the tests of estimators, synthetic and recorded, and what runs them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dptse_env.estimators import (
    ESTIMATORS,
    REFERENCES,
    EstimatorSettings,
    Measurement,
    make_estimator,
)
from dptse_env.estimators.base import Estimator
from dptse_env.model import ARZModel
from dptse_env.model.parameters import load_parameters
from dptse_env.traffic import PAPER_HIGHWAY
from dptse_env.traffic.record import Record
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

SIGMA = np.array([15.0, 6.0])  # [veh/km, km/h]
# What sensors release beside the density: the mean speed, or the flow rho (v - v_0), whose noise is
# v_0 times the density's where both get the same share of the privacy.
REFERENCE_SPEED = 51.0
REFERENCE_SPEEDS = {"speed": None, "flow": REFERENCE_SPEED}
SIGMAS = {"speed": SIGMA, "flow": SIGMA[0] * np.array([1.0, REFERENCE_SPEED])}  # [.., veh/h]
RELEASES = tuple(SIGMAS)
EVERY = [(name, "compiled") for name in ESTIMATORS] + [(name, "reference") for name in REFERENCES]
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
    sigma: FloatArray  # (2,) deviations of the noise in `values`

    @property
    def everyone(self) -> np.ndarray:
        return np.arange(len(self.start))


def simulate(
    parameters: str = "w99-3lane",
    n: int = 1,
    n_steps: int = 700,
    seed: int = 0,
    noise: float = 1.0,
    release: str = "speed",
) -> Episodes:
    """Demand that swells and a queue from the exit, disturbed, five roaming sensors, noise."""
    model, sigma = model_of(parameters, release), SIGMAS[release]
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
    values += noise * sigma * rng.normal(size=values.shape)
    start = model.states(np.full((n, s), 0.1) * jam, np.full((n, s), 0.5 * v_f))
    return Episodes(model, start, inputs, observed, values, truth, sigma)


def model_of(parameters: str, release: str) -> ARZModel:
    """The paper's highway, as its sensors release speeds or flows."""
    speed = REFERENCE_SPEEDS[release]
    return ARZModel(PAPER_HIGHWAY, load_parameters(parameters), reference_speed=speed)


def replay(record: Record, release: str = "speed") -> Episodes:
    """Recorded traffic of the paper's highway, five sensors going round."""
    model, sigma = model_of("w99-3lane", release), SIGMAS[release]
    s, v_f = model.n_segments, model.parameters.free_flow_speed
    density = record.counts / PAPER_HIGHWAY.segment_length
    sums, counts = record.speed_sums, record.counts
    speed = np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0)
    inputs = model.boundary_inputs(density[:-1, s:], speed[:-1, s:])
    traffic = np.stack([density[1:, :s], np.nan_to_num(speed[1:, :s], nan=102.0)], axis=-1)
    values = traffic.copy()
    if release == "flow":
        values[..., 1] = traffic[..., 0] * (traffic[..., 1] - REFERENCE_SPEED)
    values += sigma * np.random.default_rng(0).normal(size=traffic.shape)
    observed = np.zeros((len(traffic), s), bool)
    for k, row in enumerate(observed):
        row[[*((3 * np.arange(5) + k) % 15), *FIXED_SENSORS]] = True
    start = model.states(0.05 * model.jam_density[None], np.full((1, s), 0.64 * v_f))
    truth = model.states(traffic[..., 0], traffic[..., 1])
    return Episodes(
        model, start, inputs[:, None], observed[:, None], values[:, None], truth[:, None], sigma
    )


def random_streams(n: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, i]) for i in range(n)]


def started(
    name: str,
    backend: str,
    episodes: Episodes,
    settings: EstimatorSettings | None = None,
    start: FloatArray | None = None,
    seed: int = 0,
) -> Estimator:
    """An estimator that is reset to the episodes' prior, or to another one."""
    n = len(episodes.start)
    estimator = make_estimator(name, backend, episodes.model, n, settings)
    start = episodes.start if start is None else start
    estimator.reset(episodes.everyone, start, random_streams(n, seed))
    return estimator


def run(
    estimator: Estimator,
    episodes: Episodes,
    steps: Iterable[int],
    sigma: FloatArray | None = None,
    watch: Callable[[int], None] = lambda _: None,
) -> None:
    """Take the steps k of all episodes, with the noise that they have or with another one."""
    sigma = episodes.sigma if sigma is None else sigma
    for k in steps:
        estimator.predict(episodes.everyone, episodes.inputs[k])
        tell(estimator, episodes.everyone, episodes.observed[k], episodes.values[k], sigma)
        watch(k)


def tell(
    estimator: Estimator,
    episodes: IntArray,
    observed: BoolArray,
    values: FloatArray,
    sigma: FloatArray,
    centre: FloatArray | None = None,
) -> None:
    """Update an estimator by a measurement of its rows."""
    measured = Measurement.of(estimator.model, observed, values, sigma, centre)
    estimator.update(episodes, measured)


def scale_of(model: ARZModel) -> FloatArray:
    """Units `(2 S,)` of the normalised state."""
    rho_m, v_f = model.density_scale, model.speed_scale
    return np.tile([rho_m, rho_m * v_f], model.n_segments)


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
    shown = estimator.estimate()
    inner = estimator.means if hasattr(estimator, "means") else estimator.states
    flags = estimator.diverged.copy(), estimator.fallback.copy()
    four = shown.density, shown.speed, shown.density_std, shown.speed_std
    return Snapshot(*four, estimator.innovations.copy(), *flags, inner.copy())


def assert_same(one: Snapshot, other: Snapshot, episodes=slice(None), of=slice(None)) -> None:
    for field in Snapshot._fields:
        a, b = getattr(one, field)[episodes], getattr(other, field)[of]
        np.testing.assert_array_equal(a, b, err_msg=field)
