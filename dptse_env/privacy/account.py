"""Account of what the releases of an episode have cost so far."""

from functools import cached_property

import numpy as np

from dptse_env.privacy.gaussian import epsilon_of
from dptse_env.utils.arrays import FloatArray, IntArray

__all__ = ["ReleaseAccount"]


class ReleaseAccount:
    """Privacy loss of a vehicle by the number of released steps that it can have entered.

    Attributes:
        mu: Of a whole episode, the parameter of Gaussian differential privacy.
        delta: At which epsilon is given.
        contributions: C, released steps that a vehicle's data can enter; None if not bounded.
    """

    def __init__(self, mu: float, delta: float, contributions: int | None) -> None:
        """Keep the numbers of a whole episode."""
        self.mu, self.delta, self.contributions = mu, delta, contributions

    @cached_property
    def _tables(self) -> tuple[FloatArray, FloatArray]:
        """Values of mu and epsilon after 0..C steps."""
        n = self.contributions
        mu = self.mu * np.sqrt(np.arange(n + 1) / n) if n else np.array([self.mu])
        epsilon = [epsilon_of(value, self.delta) if value > 0.0 else 0.0 for value in mu]
        return mu, np.array(epsilon)

    def spent(self, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return what releases have revealed of a vehicle at most, if the sensitivities hold.

        Where contributions are bounded, a vehicle has made at most one a step. The paper's
        sensitivities bound a whole episode and say nothing of a part of it: the whole is charged
        from the start.

        Args:
            steps: Steps released so far in each of k episodes, shape (k,).

        Returns:
            mu and epsilon at `delta`, shape (k,) each, of all releases together.
        """
        mu, epsilon = self._tables
        charged = np.minimum(steps, len(mu) - 1)
        return mu[charged], epsilon[charged]
