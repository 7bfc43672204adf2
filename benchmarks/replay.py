"""Recorded traffic as an estimator meets it: its inputs, and the releases it is given."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from dptse_env.config import EnvConfig, resolve
from dptse_env.estimators import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.parts import make_model, make_release
from dptse_env.release import Request, nominal_state
from dptse_env.utils.arrays import BoolArray, FloatArray

PERIOD = 4  # [s] after which the paper's schedule moves on


@dataclass(frozen=True)
class Replay:
    """K steps of n episodes on recorded traffic; S segments.

    Attributes:
        model: Model of the estimators.
        settings: The paper's sizes and weights, the process noise of the parameter set.
        start: Prior means, shape (n, 2 S).
        inputs: Inputs of the model in each step, shape (K, n, n_u).
        observed: Flags of observed segments, as many in every step, shape (K, n, S).
        values: Releases [veh/km, km/h], shape (K, n, S, 2).
        sigma: Standard deviations of their noise, shape (2,).
    """

    model: ARZModel
    settings: EstimatorSettings
    start: FloatArray
    inputs: FloatArray
    observed: BoolArray
    values: FloatArray
    sigma: FloatArray

    @property
    def n_outputs(self) -> int:
        """Number of values that are measured in every step."""
        return 2 * int(self.observed[0, 0].sum())

    def first(self, n_episodes: int) -> Replay:
        """Return the first episodes alone."""
        tables = {
            name: getattr(self, name)[:, :n_episodes] for name in ("inputs", "observed", "values")
        }
        return dataclasses.replace(self, start=self.start[:n_episodes], **tables)


def recorded(
    parameters: str, seeds: tuple[int, ...], n_episodes: int, n_queried: int, n_steps: int
) -> Replay:
    """Replay the paper's highway under the paper's schedule and privacy, from the empty road on.

    Args:
        parameters: ARZ parameter set.
        seeds: Traffic seeds; the episodes take them in turns, each with separate noise.
        n_episodes: n.
        n_queried: Segments queried a step.
        n_steps: K.

    Raises:
        ValueError: There are more steps than a record has, or none.
    """
    keywords = {"parameters": parameters, "bandwidth": n_queried, "traffic_seeds": seeds}
    return replay_of(resolve("paper-highway", keywords), n_episodes, n_steps)


def replay_of(config: EnvConfig, n_episodes: int, n_steps: int, first: int = 0) -> Replay:
    """Replay a road under the paper's schedule, each query one segment, as many as it may.

    The schedule runs over the mainline segments without a fixed sensor, so that queries and sensors
    never fall together and every step has equally many outputs.

    Args:
        config: Road, release model and ARZ parameters; the episodes take its traffic seeds in
            turns, each with separate noise.
        n_episodes: n.
        n_steps: K.
        first: Second of the record at which the episodes begin; their priors are nominal.

    Raises:
        ValueError: There are more steps than the record has from there on, or none.
    """
    corridor, model, n = config.corridor, make_model(config), n_episodes
    n_queried, seeds = config.bandwidth, config.traffic_seeds
    if not 1 <= n_steps <= corridor.duration - first:
        raise ValueError(f"steps must be in 1..{corridor.duration - first}, got {n_steps}")
    s, release = corridor.n_segments, make_release(config, n)
    traffic = release.traffic
    traffic.load(np.arange(len(seeds)))
    episodes, indices = np.arange(n), np.arange(n) % len(seeds)
    boundary = [traffic.complete(index)[first:, s:] for index in range(len(seeds))]
    inputs = [
        model.boundary_inputs(ends[:n_steps, :, 0], ends[:n_steps, :, 1]) for ends in boundary
    ]
    release.reset(episodes, [np.random.default_rng([0, i]) for i in range(n)])
    sensors = release.task.observed(np.zeros((n, corridor.n_mainline), dtype=bool))
    values = [
        release.release(Request(episodes, indices, np.full(n, k + 1), sensors)).values
        for k in range(first, first + n_steps)
    ]
    roaming = np.setdiff1d(np.arange(corridor.n_mainline), corridor.fixed_sensors)
    observed = np.zeros((n_steps, n, s), dtype=bool)
    observed[..., list(corridor.fixed_sensors)] = True
    spread = np.arange(n_queried) * roaming.size // n_queried
    for k in range(n_steps):
        observed[k][:, roaming[(spread + k // PERIOD) % roaming.size]] = True
    return Replay(
        model=model,
        settings=EstimatorSettings(process_noise=config.settings().process_noise),
        start=np.tile(nominal_state(corridor, model, first), (n, 1)),
        inputs=np.stack([inputs[index] for index in indices], axis=1),
        observed=observed,
        values=np.stack(values),
        sigma=np.array(release.sigma),
    )
