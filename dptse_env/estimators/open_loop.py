"""The traffic model alone, without measurements: a baseline of estimators."""

from collections.abc import Sequence

import numpy as np

from dptse_env.estimators.base import Estimate
from dptse_env.estimators.batch import BatchEstimator, Measurements
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray


class OpenLoop(BatchEstimator):
    """Predictions of the model from the prior; measurements are ignored.

    Standard deviations and innovations are zero. An episode whose state has become non-finite is
    reset to its prior at the next update.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self.states = model.project(np.zeros((n_episodes, model.n_states)), settings.bounds)
        self._prior = self.states.copy()

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self.states[episodes] = self.model.project(states, self.settings.bounds)
        self._prior[episodes] = self.states[episodes]

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        after = self.model.step(self.states[episodes], inputs)
        self.states[episodes] = self.model.project(after, self.settings.bounds)

    def _update(self, measured: Measurements) -> None:
        episodes = measured.episodes
        self.diverged[episodes] = ~np.all(np.isfinite(self.states[episodes]), axis=1)
        lost = episodes[self.diverged[episodes]]
        self.states[lost] = self._prior[lost]

    def _estimate(self) -> Estimate:
        density, speed = estimated_traffic(self.model, self.states)
        return Estimate(density, speed, np.zeros_like(density), np.zeros_like(speed))


def estimated_traffic(model: ARZModel, states: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return density [veh/km] and speed [km/h] of states, the speed at most 1.1 v_f.

    In the cone it never exceeds that; in the paper's box w = psi / rho has no bound.
    """
    return model.density(states), np.minimum(model.speed(states), model.largest_speed)
