"""Straight lines between stations of loops, as an estimator: what others have to beat."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dptse_env.estimators import Estimate, Estimator, EstimatorSettings, Measurement
from dptse_env.estimators.base import estimated_traffic
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import AnyArray, FloatArray, IntArray


class StraightLines(Estimator):
    """Densities and speeds by straight lines between the segments that were measured last.

    They stay until the next measurement. It suits measurements of single segments, without
    queries; ramps stay at the prior unless they are measured. Its deviations are constants.
    """

    has_demand = False
    steps_model = False

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `dptse_env.estimators.make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self._means = np.zeros((n_episodes, model.n_segments, 2))

    def _reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        self._means[episodes] = np.stack(estimated_traffic(self.model, states), axis=-1)

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        pass

    def _update(self, episodes: IntArray, measured: Measurement) -> None:
        road, first = self.model.road, self.model.channels.first
        for k, episode in enumerate(episodes.tolist()):
            seen = np.flatnonzero(measured.observed[k])
            if not seen.size:
                continue
            segments, values = first[seen], measured.values[k, seen]
            if self.model.releases_flow:  # density times (speed - centre)
                slip = values[:, 1] / np.maximum(values[:, 0], 1e-6)
                known = values[:, 0] > 0.0
                speed = np.where(known, measured.centre[k, segments] + slip, road.limits[segments])
                values = np.stack([values[:, 0], speed], axis=-1)
            self._means[episode, segments] = values
            on_mainline = segments < road.n_mainline
            places, order = np.unique(segments[on_mainline], return_index=True)
            for i in range(2 if places.size else 0):
                own = values[on_mainline][order, i]
                at, x = road.position[: road.n_mainline], road.position[places]
                self._means[episode, : road.n_mainline, i] = np.interp(at, x, own)

    def _estimate(self) -> Estimate:
        density, speed = self._means[..., 0].copy(), self._means[..., 1].copy()
        scales = self.model.density_scale, self.model.speed_scale
        return Estimate(density, speed, *(np.full_like(density, 0.1 * each) for each in scales))

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        return (self._means,)
