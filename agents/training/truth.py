"""`TrueErrors`: what a critic may see in training, and a policy never."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from dptse_env.config import EnvConfig
from dptse_env.parts import QueryInterface
from dptse_env.utils.arrays import FloatArray, Observation

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

    def split(self, shown: Observation) -> tuple[Observation, Observation]:
        """Return plain observations (k, size) and squared errors (k, n) of what `append` made.

        A squared error is that of the density and of the speed together, in units of the scales.
        """
        size = self._encoding.space.shape[0]
        density, speed = np.split(shown[:, size:], 2, axis=1)
        squared = (SCALES[0] * density) ** 2 + (SCALES[1] * speed) ** 2
        return shown[:, :size].copy(), squared
