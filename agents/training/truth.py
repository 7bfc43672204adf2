"""`TrueErrors`: what a critic may see in training, and a policy never."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from dptse_env.arrays import FloatArray, Observation
from dptse_env.config import EnvConfig
from dptse_env.interface import QueryInterface
from dptse_env.process import QueryProcess

SCALES = (0.1, 0.2)
"""What errors of density and of speed, in units of the corridor's scales, are divided by."""


class TrueErrors:
    """Appends to observations the errors of the estimates that they show, segment by segment."""

    def __init__(self, config: EnvConfig, interface: QueryInterface) -> None:
        """Take the sizes and scales of an environment."""
        corridor = config.corridor
        self._n = corridor.n_mainline
        self._scales = corridor.density_scale, corridor.speed_scale
        self._encoding = interface.observations

    def space(self) -> spaces.Box:
        """Return the space of observations with errors behind them."""
        plain = self._encoding.space
        free = np.full(2 * self._n, np.inf, dtype=np.float32)
        low, high = np.concatenate([plain.low, -free]), np.concatenate([plain.high, free])
        return spaces.Box(low, high, dtype=np.float32)

    def append(
        self, observation: Observation, density: FloatArray, speed: FloatArray
    ) -> Observation:
        """Return observations (k, size + 2 n).

        Args:
            observation: Shape (k, size).
            density: True densities [veh/km], shape (k, S).
            speed: True speeds [km/h], shape (k, S); those of empty segments do not count.
        """
        n, (density_scale, speed_scale) = self._n, self._scales
        estimated = [self._encoding.block(observation, name) for name in ("density", "speed")]
        occupied = density[:, :n] > 0
        errors = (
            (estimated[0][:, :n] - density[:, :n] / density_scale) / SCALES[0],
            (estimated[1][:, :n] - speed[:, :n] / speed_scale) / SCALES[1] * occupied,
        )
        return np.concatenate([observation, *errors], axis=1).astype(np.float32)


def squared_errors(process: QueryProcess) -> Observation:
    """Return the squared error of the estimate in every mainline segment, shape (n, n_mainline).

    Density and speed count together, in units of the corridor's scales. The speed of an empty
    segment does not count.
    """
    corridor, n = process.config.corridor, process.interface.n_mainline
    truth, estimate = process.truth(np.arange(process.n_episodes))[:, :n], process.estimate
    density = (estimate.density[:, :n] - truth[..., 0]) / corridor.density_scale
    speed = (estimate.speed[:, :n] - truth[..., 1]) / corridor.speed_scale
    squared = density**2 + np.where(truth[..., 0] > 0, speed, 0.0) ** 2
    return squared.astype(np.float32)
