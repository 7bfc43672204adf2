"""Recorded traffic as an estimator meets it: what drives it, and what is released to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dptse_env.config import resolve
from dptse_env.estimators import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.parts import make_model, make_release
from dptse_env.release import ReleaseRequest
from dptse_env.release.nominal import nominal_state
from dptse_env.utils.arrays import BoolArray, FloatArray

PERIOD = 4  # [s] after which the paper's schedule moves on


@dataclass(frozen=True)
class Replay:
    """K steps of n episodes on recorded traffic; S segments.

    Attributes:
        model: Model of the estimators.
        settings: Theirs: the paper's sizes and weights, the process noise of the parameter set.
        start: `(n, 2 S)` prior means.
        inputs: `(K, n, n_u)` what drives each step.
        observed: `(K, n, S)`, as many segments in every step.
        values: `(K, n, S, 2)` releases [veh/km, km/h].
        sigma: `(2,)` standard deviations of their noise.
    """

    model: ARZModel
    settings: EstimatorSettings
    start: FloatArray
    inputs: FloatArray
    observed: BoolArray
    values: FloatArray
    sigma: FloatArray

    @property
    def n_steps(self) -> int:
        """K."""
        return len(self.inputs)

    @property
    def n_outputs(self) -> int:
        """Numbers measured in every step."""
        return 2 * int(self.observed[0, 0].sum())

    def first(self, n_episodes: int) -> Replay:
        """Return the first episodes alone."""
        n = slice(n_episodes)
        return Replay(
            self.model, self.settings, self.start[n], self.inputs[:, n], self.observed[:, n],
            self.values[:, n], self.sigma,
        )  # fmt: skip


def recorded(
    parameters: str, seeds: tuple[int, ...], n_episodes: int, n_queried: int, n_steps: int
) -> Replay:
    """Replay the paper's highway under the paper's schedule and privacy.

    The schedule runs over the mainline segments that have no sensor of their own, so that queries
    and sensors never fall together and every step has equally many outputs.

    Args:
        parameters: ARZ parameter set.
        seeds: Traffic seeds; the episodes take them in turns, each with noise of its own.
        n_episodes: n.
        n_queried: Segments queried a step.
        n_steps: K, from the empty road on.

    Raises:
        ValueError: There are more steps than a record has, or none.
    """
    config = resolve(
        "paper-highway",
        {"parameters": parameters, "bandwidth": n_queried, "traffic_seeds": seeds},
    )
    corridor, model, n = config.corridor, make_model(config), n_episodes
    if not 1 <= n_steps <= corridor.duration:
        raise ValueError(f"steps must be in 1..{corridor.duration}, got {n_steps}")
    s = corridor.n_segments
    release = make_release(config, n)
    traffic = release.setup.traffic
    traffic.load(np.arange(len(seeds)))
    indices = np.arange(n) % len(seeds)
    boundary = [traffic.complete(index)[:n_steps, s:] for index in range(len(seeds))]
    inputs = [model.boundary_inputs(ends[..., 0], ends[..., 1]) for ends in boundary]
    every = np.arange(n)
    release.reset(every, [np.random.default_rng([0, i]) for i in range(n)])
    queried = np.zeros((n, corridor.n_mainline), dtype=bool)
    values = [
        release.release(
            ReleaseRequest(every, indices, np.full(n, k + 1), release.setup.observed(queried))
        ).values
        for k in range(n_steps)
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
        start=np.tile(nominal_state(corridor, model, 0), (n, 1)),
        inputs=np.stack([inputs[index] for index in indices], axis=1),
        observed=observed,
        values=np.stack(values),
        sigma=np.array(release.sigma),
    )
