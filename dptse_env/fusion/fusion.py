"""Fusion of two kinds of sensors, ahead of the estimator and alike for every estimator.

It reads public numbers alone, the releases and the estimator's prediction, so that no guarantee
depends on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dptse_env.estimators import Estimate
from dptse_env.fusion.settings import FusionSettings
from dptse_env.fusion.share_filter import ShareFilter
from dptse_env.model import MeasurementRows
from dptse_env.model.parameters import SECONDS_PER_HOUR
from dptse_env.release import MeasuredRows
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

LEAST_SPEED = 5.0
"""Speed from which on the time on a segment does not grow any more [km/h]."""


@dataclass(frozen=True)
class FusionSetup:
    """Configuration that a fusion is made for.

    Attributes:
        settings: Its settings.
        rows: The M rows of a measurement.
        n_options: How many of them are queries, which come first.
        lengths: Length of each row [km], shape (M,).
        share: Published share p of connected vehicles.
        limits: Speed limit of each row [km/h], shape (M,).
        releases_flow: Whether flows are released, else mean speeds.
        n_episodes: Size n of the batch.
    """

    settings: FusionSettings
    rows: MeasurementRows
    n_options: int
    lengths: FloatArray
    share: float
    limits: FloatArray
    releases_flow: bool
    n_episodes: int


class Fusion:
    """Turns answers of connected vehicles into measurements of all vehicles, with their errors.

    A query counts n_c connected vehicles of n, of which every one is connected with probability p:
    ``n_c / p`` estimates n with a variance of ``n (1 - p) / p`` beside the mechanism's. So it is
    with the sum of ``v - c`` over them, whose variance is ``n (1 - p) / p`` times the mean of
    ``(v - c)^2``. The mean speed of n_c of n vehicles has the variance ``s^2 (1/n_c - 1/n)``, with
    s the spread of speeds. For n and the mean speed the estimator's prediction is taken, of one
    vehicle at least.

    Attributes:
        share: Estimated share of each episode; None where the published one is taken.
    """

    def __init__(self, setup: FusionSetup) -> None:
        """Prepare for episodes; each needs a `reset` before its first second."""
        self.setup, settings = setup, setup.settings
        self._weights = setup.rows.weights.T
        self.share = (
            ShareFilter(settings, setup.share, setup.n_episodes)
            if settings.share == "estimated"
            else None
        )

    def reset(self, episodes: IntArray) -> None:
        """Begin new episodes, shape (k,)."""
        if self.share is not None:
            self.share.reset(episodes)

    def scaled(self, sigma: FloatArray) -> FloatArray:
        """Return deviations (2,) of a query's noise, scaled by the published share."""
        setup, p = self.setup, self.setup.share
        scaled: FloatArray = sigma * np.array([1.0 / p, 1.0 / p if setup.releases_flow else 1.0])
        return scaled

    def read(
        self,
        episodes: IntArray,
        observed: BoolArray,
        measured: MeasuredRows,
        prediction: Estimate,
    ) -> MeasuredRows:
        """Return the measurements of a second that the estimator is given.

        Args:
            episodes: Distinct rows of the batch, shape (k,).
            observed: Rows that answered, shape (k, M).
            measured: The released rows.
            prediction: The estimator's prediction for this second, rows of shape (k, S).
        """
        centre = measured.centre if self.setup.releases_flow else None
        expected = _Expected(prediction, self._weights, centre)
        values, sigma = measured.values.copy(), measured.sigma.copy()
        self._scale_queries(episodes, observed, values, sigma, expected)
        return MeasuredRows(values, sigma, measured.centre)

    def _scale_queries(
        self,
        episodes: IntArray,
        observed: BoolArray,
        values: FloatArray,
        sigma: FloatArray,
        expected: _Expected,
    ) -> None:
        """Write what the answers of connected vehicles say of all vehicles, and its error."""
        setup, queries = self.setup, slice(0, self.setup.n_options)
        length, density = setup.lengths[queries], expected.density[:, queries]
        count = np.maximum(density * length, 1.0)
        p, p_variance = np.array([[setup.share]]), np.zeros((1, 1))
        if self.share is not None:
            p, p_variance = self.share.update(
                episodes, observed[:, queries], values[:, queries, 0], sigma[:, queries, 0],
                density, expected.density_std[:, queries], length,
            )  # fmt: skip
        alike = self._seconds_alike(expected.speed[:, queries], length)
        sampling = alike * count * (1.0 - p) / p / length**2
        spread = setup.settings.speed_spread
        doubt = p_variance / p**2
        values[:, queries, 0] /= p
        sigma[:, queries, 0] = np.sqrt(
            (sigma[:, queries, 0] / p) ** 2 + sampling + density**2 * doubt
        )
        if setup.releases_flow:
            square = expected.offset[:, queries] ** 2 + spread**2
            values[:, queries, 1] /= p
            flow = density * expected.offset[:, queries]
            sigma[:, queries, 1] = np.sqrt(
                (sigma[:, queries, 1] / p) ** 2 + sampling * square + flow**2 * doubt
            )
        else:
            answering = p * count
            # Without a connected vehicle the speed limit is released.
            none = np.exp(-answering) * (setup.limits[queries] - expected.speed[:, queries]) ** 2
            sigma[:, queries, 1] = np.sqrt(
                sigma[:, queries, 1] ** 2 + alike * (spread**2 * (1.0 - p) / answering + none)
            )

    def _seconds_alike(self, speed: FloatArray, length: FloatArray) -> FloatArray | float:
        """Return the seconds for which answers count as one, shape (k, G), 1 at least."""
        factor = self.setup.settings.dwell_factor
        if factor == 0.0:
            return 1.0
        dwell = SECONDS_PER_HOUR * length / np.maximum(speed, LEAST_SPEED)
        return np.maximum(factor * dwell, 1.0)


class _Expected:
    """A prediction of M rows.

    Attributes:
        density: Densities [veh/km], at least 0, shape (k, M).
        speed: Speeds [km/h], shape (k, M).
    """

    def __init__(
        self, prediction: Estimate, weights: FloatArray, centre: FloatArray | None
    ) -> None:
        """Average a prediction over the rows.

        Args:
            prediction: Rows of shape (k, S).
            weights: Weights of the segments in each row, shape (S, M).
            centre: Speeds that flows are centred on [km/h], (k, S); None for mean speeds.
        """
        self._prediction, self._weights, self._centre = prediction, weights, centre
        self.density: FloatArray = np.maximum(prediction.density @ weights, 0.0)
        self.speed: FloatArray = prediction.speed @ weights

    @cached_property
    def offset(self) -> FloatArray:
        """Speeds less the centres of flows [km/h], shape (k, M)."""
        assert self._centre is not None
        offset: FloatArray = self.speed - self._centre @ self._weights
        return offset

    @cached_property
    def density_std(self) -> FloatArray:
        """Standard deviations of the densities [veh/km], shape (k, M)."""
        deviation: FloatArray = self._prediction.density_std @ self._weights
        return deviation
