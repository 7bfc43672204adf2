"""An EKF with honest deviations, which tells what of a gain is repair.

A policy may win with an EKF because it queries where the filter is wrong and does not know it. The
deviations of this one say so: a policy that still wins has won by its choice.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from dptse_env.estimators import Estimate, EstimatorSettings, Measurement, with_demand
from dptse_env.estimators.ekf import EKF
from dptse_env.estimators.recurrent import Recurrent
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray, IntArray


class RepairedEKF(EKF):
    """The EKF, whose deviations are its distances to the network's estimate.

    A network reads the same releases. A variance is the square of the distance between both
    estimates and the variance of the network's; densities and speeds are the EKF's own.
    """

    settings_type = EstimatorSettings

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        plain = dataclasses.replace(settings, demand=None)
        self._network = Recurrent(with_demand(model, plain), n_episodes, plain)

    def _reset(
        self,
        episodes: IntArray,
        states: FloatArray,
        generators: Sequence[np.random.Generator],
    ) -> None:
        super()._reset(episodes, states, generators)
        traffic = np.ascontiguousarray(states[:, : 2 * self.model.n_segments])
        self._network.reset(episodes, traffic, generators)

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        super()._predict(episodes, inputs)
        self._network.predict(episodes, inputs)

    def _update(self, episodes: IntArray, measured: Measurement) -> None:
        super()._update(episodes, measured)
        self._network.update(episodes, measured)

    def _estimate(self) -> Estimate:
        own, other = super()._estimate(), self._network.estimate()
        return own._replace(
            density_std=np.hypot(own.density - other.density, other.density_std),
            speed_std=np.hypot(own.speed - other.speed, other.speed_std),
        )
