"""The traffic model alone: what an estimator is worth without measurements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dptse_env.estimators.base import (
    Estimate,
    EstimatorSettings,
    checked_episodes,
    checked_measurements,
    checked_rows,
)
from dptse_env.model import ARZModel
from dptse_env.model.network import BoolArray, FloatArray, IntArray


class OpenLoop:
    """Follows the model from the prior and takes in no measurement.

    It claims no uncertainty: standard deviations and innovations are zero. An episode whose state
    has become non-finite goes back to its prior at the next update.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        self.model = model
        self.settings = settings
        self.n_episodes = n_episodes
        self.states = model.project(np.zeros((n_episodes, model.n_states)), settings.bounds)
        self.innovations = np.zeros((n_episodes, model.n_segments, 2))
        self.diverged = np.zeros(n_episodes, dtype=np.bool_)
        self._prior = self.states.copy()

    def reset(
        self,
        episodes: IntArray,
        states: FloatArray,
        generators: Sequence[np.random.Generator],
    ) -> None:
        """Start episodes over from states `(k, 2 S)`."""
        indices = checked_episodes(episodes, self.n_episodes)
        states = checked_rows("states", states, (indices.size, self.model.n_states))
        self.states[indices] = self.model.project(states, self.settings.bounds)
        self._prior[indices] = self.states[indices]
        self.diverged[indices] = False

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """Move episodes one step ahead under inputs `(k, n_u)`."""
        indices = checked_episodes(episodes, self.n_episodes)
        inputs = checked_rows("inputs", inputs, (indices.size, self.model.n_inputs))
        after = self.model.step(self.states[indices], inputs)
        self.states[indices] = self.model.project(after, self.settings.bounds)

    def update(
        self, episodes: IntArray, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        """Ignore the measurements."""
        given = checked_measurements(
            self.n_episodes, self.model.n_segments, episodes, observed, values, sigma
        )
        indices = given.episodes
        self.diverged[indices] = ~np.all(np.isfinite(self.states[indices]), axis=1)
        lost = indices[self.diverged[indices]]
        self.states[lost] = self._prior[lost]

    def estimate(self) -> Estimate:
        """Current estimate of all episodes."""
        density, speed = estimated_traffic(self.model, self.states)
        return Estimate(density, speed, np.zeros_like(density), np.zeros_like(speed))


def estimated_traffic(model: ARZModel, states: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Density [veh/km] and speed [km/h] of states, the speed held to what drivers can reach.

    The cone holds it there anyway; in the paper's box w = psi / rho has no bound.
    """
    return model.density(states), np.minimum(model.speed(states), model.largest_speed)
