"""Fusion: what an estimator is told of answers of connected vehicles beside fixed sensors.

It comes ahead of the estimator and is alike for every estimator. It reads public numbers alone, the
releases and the estimator's prediction, so that no guarantee depends on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dptse_env.estimators import Estimate, Measurement
from dptse_env.release import Task
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import Interval, checked_fields

LEAST_SPEED = 5.0
"""Speed from which on the time on a segment does not grow any more [km/h]."""


@dataclass(frozen=True)
class FusionSettings:
    """Settings by which answers of both kinds of sensors become measurements of all vehicles.

    Attributes:
        speed_spread: Standard deviation of the vehicles' speeds on a segment [km/h], for the
            sampling error of speeds.
        dwell_factor: Allowance for answers of a segment that have the same sampling error, since
            the same vehicles are there: the variance of sampling is multiplied by this factor times
            the seconds that a vehicle spends on the segment, where the product is more than one. It
            lowers the error of `recurrent` where few vehicles are connected and noise is small;
            elsewhere estimators err more where answers weigh less.

    Raises:
        ValueError: A value is out of range.
    """

    speed_spread: Annotated[float, Interval(0, 100)] = 12.0
    dwell_factor: Annotated[float, Interval(0, 100)] = 0.0

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "fusion")


class Fusion:
    """Turns answers of connected vehicles into measurements of all vehicles, with their errors.

    A query counts n_c connected vehicles of n, of which every one is connected with probability p:
    ``n_c / p`` estimates n with a variance of ``n (1 - p) / p`` beside the release's. So it is with
    the sum of ``v - c`` over them, whose variance is ``n (1 - p) / p`` times the mean of
    ``(v - c)^2``. The mean speed of n_c of n vehicles has the variance ``s^2 (1/n_c - 1/n)``, with
    s the spread of speeds. For n and the mean speed the estimator's prediction is taken, of one
    vehicle at least.
    """

    def __init__(self, task: Task, settings: FusionSettings, share: float) -> None:
        """Prepare for the queries of a task, with the published share p of connected vehicles."""
        self.settings, self.share = settings, share
        self.releases_flow = task.releases_flow
        road, queries = task.corridor.road, task.channels.head(task.queries.n_queries)
        self._queries = slice(0, queries.size)
        self._length, self._limit = queries.length, road.limits[queries.first]
        self._weights = queries.averaging(road.n_segments).T  # (S, G)

    def scaled(self, sigma: FloatArray) -> FloatArray:
        """Return deviations (2,) of a query's noise, scaled to all vehicles."""
        p = self.share
        scaled: FloatArray = sigma * np.array([1.0 / p, 1.0 / p if self.releases_flow else 1.0])
        return scaled

    def read(self, measured: Measurement, prediction: Estimate) -> Measurement:
        """Return the measurements of a second that the estimator is given.

        Args:
            measured: The release of k episodes.
            prediction: The estimator's prediction for this second, rows of shape (k, S).
        """
        queries, weights, p = self._queries, self._weights, self.share
        length, spread = self._length, self.settings.speed_spread
        speed = prediction.speed @ weights
        count = np.maximum((prediction.density @ weights) * length, 1.0)
        alike = self._seconds_alike(speed, length)
        sampling = alike * count * (1.0 - p) / p / length**2
        values, sigma = measured.values.copy(), measured.sigma.copy()
        values[:, queries, 0] /= p
        sigma[:, queries, 0] = np.sqrt((sigma[:, queries, 0] / p) ** 2 + sampling)
        if self.releases_flow:
            offset = speed - measured.centre[:, : len(weights)] @ weights
            square = offset**2 + spread**2
            values[:, queries, 1] /= p
            sigma[:, queries, 1] = np.sqrt((sigma[:, queries, 1] / p) ** 2 + sampling * square)
        else:
            answering = p * count
            # Without a connected vehicle the speed limit is released.
            none = np.exp(-answering) * (self._limit - speed) ** 2
            sigma[:, queries, 1] = np.sqrt(
                sigma[:, queries, 1] ** 2 + alike * (spread**2 * (1.0 - p) / answering + none)
            )
        return measured._replace(values=values, sigma=sigma)

    def _seconds_alike(self, speed: FloatArray, length: FloatArray) -> FloatArray | float:
        """Return the seconds for which answers count as one, shape (k, G), 1 at least."""
        factor = self.settings.dwell_factor
        if factor == 0.0:
            return 1.0
        dwell = HOUR * length / np.maximum(speed, LEAST_SPEED)
        return np.maximum(factor * dwell, 1.0)
