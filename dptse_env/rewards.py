"""The error of an estimate, and the rewards made of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dptse_env.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class EstimationError:
    """The error over the mainline of k episodes at one step.

    Attributes:
        density: Root mean squared density error over all mainline segments [veh/km], shape (k,).
        speed: Root mean squared speed error over the occupied ones [km/h], shape (k,); 0 where
            the mainline is empty.
        n_occupied: Number of mainline segments with a vehicle, shape (k,).
    """

    density: FloatArray
    speed: FloatArray
    n_occupied: IntArray


def estimation_error(
    true_density: FloatArray,
    true_speed: FloatArray,
    density: FloatArray,
    speed: FloatArray,
) -> EstimationError:
    """Compare estimates with the truth; all arrays (k, n_mainline), in [veh/km] and [km/h].

    A segment without a vehicle has no speed, so it counts for the density only.
    """
    occupied = true_density > 0
    n_occupied = occupied.sum(axis=1)
    density_error = density - true_density
    speed_error = np.where(occupied, speed - true_speed, 0.0)
    return EstimationError(
        np.sqrt(np.einsum("ki,ki->k", density_error, density_error) / density.shape[1]),
        np.sqrt(np.einsum("ki,ki->k", speed_error, speed_error) / np.maximum(n_occupied, 1)),
        n_occupied,
    )


class Reward:
    """Minus the scaled root mean squared error over the mainline.

    ``joint`` pools density and speed errors, each in units of its scale; ``density`` and
    ``speed`` take one of them. The scales are constants of the corridor, so that rewards compare
    across estimators and model parameters.
    """

    def __init__(
        self, term: str, n_mainline: int, *, density_scale: float, speed_scale: float
    ) -> None:
        """Choose the term (a name in `REWARD_TERMS`) and its scales [veh/km], [km/h]."""
        self.term = term
        self._n_mainline = n_mainline
        self._density_scale, self._speed_scale = density_scale, speed_scale

    def value(self, error: EstimationError) -> FloatArray:
        """Return the rewards of k episodes, shape (k,)."""
        density = error.density / self._density_scale
        speed = error.speed / self._speed_scale
        if self.term == "density":
            return -density
        if self.term == "speed":
            return -speed
        n, m = self._n_mainline, error.n_occupied
        return -np.sqrt((n * density**2 + m * speed**2) / (n + m))


REWARD_TERMS = ("joint", "density", "speed")
