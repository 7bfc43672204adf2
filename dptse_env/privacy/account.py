"""Running privacy loss of an episode's releases."""

from functools import cached_property

import numpy as np

from dptse_env.privacy.gaussian import epsilon_of
from dptse_env.utils.arrays import FloatArray, IntArray

N_LEVELS = 256
"""Levels of mu at which epsilon is tabulated; one between them is rounded up."""


class EpsilonTable:
    """Epsilon at fixed levels of mu, so that a step takes no root finding.

    Attributes:
        mu: The largest mu, that of a complete episode.
    """

    def __init__(self, mu: float, delta: float) -> None:
        """Store the numbers of a complete episode."""
        self.mu, self._delta = mu, delta

    @cached_property
    def _epsilons(self) -> FloatArray:
        """Epsilon at the levels of mu, shape (N_LEVELS + 1,)."""
        levels = self.mu * np.arange(1, N_LEVELS + 1) / N_LEVELS
        return np.array([0.0, *(epsilon_of(mu, self._delta) for mu in levels.tolist())])

    def bounds(self, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mu, held to the largest, and epsilon, rounded up to one of 256 levels of mu."""
        mu = np.minimum(mu, self.mu)
        level = np.ceil(mu / self.mu * N_LEVELS * (1.0 - 1e-12)).astype(np.int64)
        return mu, self._epsilons[level]


class ReleaseAccount:
    """Privacy loss of a vehicle by the number of released steps that its data may have entered.

    Attributes:
        mu: Parameter of Gaussian differential privacy of a complete episode.
        delta: The delta at which epsilon is given.
        contributions: C, released steps that a vehicle's data can enter; None if not bounded.
    """

    def __init__(self, mu: float, delta: float, contributions: int | None) -> None:
        """Store the numbers of a complete episode."""
        self.mu, self.delta, self.contributions = mu, delta, contributions

    @cached_property
    def _tables(self) -> tuple[FloatArray, FloatArray]:
        """Values of mu and epsilon after 0..C steps."""
        n = self.contributions
        mu = self.mu * np.sqrt(np.arange(n + 1) / n) if n else np.array([self.mu])
        epsilon = [epsilon_of(value, self.delta) if value > 0.0 else 0.0 for value in mu]
        return mu, np.array(epsilon)

    def spent(self, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds on the privacy loss of a vehicle, if the sensitivities hold.

        Where contributions are bounded, a vehicle makes at most one per step. The paper's
        sensitivities bound a complete episode and no part of it, so a complete episode is charged
        from the start. `steps` is the number of steps released so far in each of k episodes, and
        the result mu and epsilon at `delta` of all releases together, shape (k,) each.
        """
        mu, epsilon = self._tables
        charged = np.minimum(steps, len(mu) - 1)
        return mu[charged], epsilon[charged]
