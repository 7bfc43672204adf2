"""Loop detectors: what their readings say of the segments beside them.

Readings are public before the releases and no part of any budget. A reading comes at the end of its
interval and says something of every second of it: `dptse_env.measurement.replay`.
"""

from typing import NamedTuple

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.release import Task, Traffic
from dptse_env.traffic import Stations
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.units import HOUR

LEAST_SPEED = 3.0
"""Least mean speed by which a flow is divided [km/h]."""
NOTHING_PASSED = 60.0
"""Deviation of a lane's density where nothing passed [veh/km]: the road is empty, or it stands."""
UNKNOWN = 1e5
"""Deviation of what a reading does not tell."""


def deviations(speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return deviations of a lane's density [veh/km] and of the speed [km/h] beside a station.

    They grow in a jam, where mean speeds over vehicles are above those over the road.

    Args:
        speed: Mean speed of an interval [km/h].
    """
    jam = 0.5 + 0.5 * np.tanh((60.0 - speed) / 20.0)
    return 6.0 + 24.0 * jam, 11.0 + 6.0 * jam


class Said(NamedTuple):
    """What readings say of L segments in k episodes; NaN where nothing is said."""

    density: FloatArray  # (k, L) [veh/km]
    speed: FloatArray  # (k, L) [km/h]
    density_std: FloatArray  # (k, L)
    speed_std: FloatArray  # (k, L)

    def at(self, episodes: IntArray) -> "Said":
        """Return rows of the k episodes."""
        return Said(*(array[episodes] for array in self))


class LoopReadings:
    """The readings of all traffic seeds, and what they say of the segments beside stations.

    Attributes:
        interval: Length of an interval [s].
        stations: The F stations.
    """

    def __init__(self, task: Task, traffic: Traffic) -> None:
        """Prepare for the loops of a task's corridor; nothing is loaded."""
        corridor = task.corridor
        assert corridor.loops is not None
        self._traffic, road = traffic, corridor.road
        self.interval = corridor.loops.interval
        self.stations = Stations.of(corridor.loops, corridor.geometry)
        segments = np.unique(self.stations.beside)
        self._channels = task.queries.channels_of_segments(corridor)[segments]
        self._releases_flow = task.releases_flow
        self._segments, self._lanes = segments, road.lanes[segments]
        self._least_density = 1.0 / road.lengths[segments]
        self._limit = road.limits[segments]
        beside: BoolArray = (self.stations.beside == segments[:, None, None]).any(axis=2)
        self._beside = beside.T.astype(np.float64)  # (F, L)

    def read(self, traffic: IntArray, interval: IntArray) -> FloatArray:
        """Return readings (k, F, 2) of intervals, from 0 on, of traffic seeds by index, (k,)."""
        found: FloatArray = self._traffic.readings[traffic, interval]
        return found

    def last(self, traffic: IntArray, times: IntArray) -> FloatArray:
        """Return last readings (k, F, 2) at seconds of the record (k,), NaN before the first."""
        interval = times // self.interval - 1
        found, some = np.full((len(times), len(self.stations.beside), 2), np.nan), interval >= 0
        found[some] = self.read(traffic[some], interval[some])
        return found

    def said(self, read: FloatArray) -> Said:
        """Return what readings (k, F, 2) say: density q / v and speed.

        A segment between two stations has the mean of both.
        """
        count, speed = read[..., 0], read[..., 1]
        flow = count * (HOUR / self.interval)  # [veh/h]
        density = np.where(count > 0.0, flow / np.maximum(speed, LEAST_SPEED), 0.0)
        density_std, speed_std = deviations(speed)
        density_std = np.where(count > 0.0, density_std, NOTHING_PASSED)
        known, passed = np.isfinite(count), count > 0.0
        speed, speed_std = self._mean(speed, passed), self._mean(speed_std, passed)
        return Said(
            self._mean(density, known),
            np.where(np.isfinite(speed), speed, self._limit),
            self._lanes * self._mean(density_std, known),
            np.where(np.isfinite(speed_std), speed_std, UNKNOWN),
        )

    def _mean(self, values: FloatArray, known: BoolArray) -> FloatArray:
        """Return means (k, L) of what is known at the stations beside a segment; NaN for none."""
        total, n = np.where(known, values, 0.0) @ self._beside, known @ self._beside
        means: FloatArray = np.where(n > 0.0, total, np.nan) / np.maximum(n, 1.0)
        return means

    def added(self, measured: Measurement, said: Said) -> Measurement:
        """Return the measurement of a second with what readings say of it.

        Where a segment is measured in the same second, both are weighed by their variances.
        """
        density, speed, density_std, speed_std = said
        second, second_std = speed, speed_std
        centre = measured.centre[:, self._segments]
        if self._releases_flow:
            second, slip = density * (speed - centre), speed - centre
            least = np.maximum(density, self._least_density)
            second_std = np.hypot(least * speed_std, slip * density_std)
        own = np.stack([density, second], axis=-1)
        variance = np.stack([density_std, second_std], axis=-1) ** 2
        values, sigma = measured.values.copy(), measured.sigma.copy()
        observed, known = measured.observed.copy(), np.isfinite(density)
        seen = observed[:, self._channels]
        noise = sigma[:, self._channels] ** 2
        # The weight of the reading: all where nothing else is known, none where it is silent.
        share = np.where(seen[..., None], noise / (noise + variance), 1.0)
        share[~known] = 0.0
        others = np.where(seen[..., None], values[:, self._channels], 0.0)
        values[:, self._channels] = (1.0 - share) * others + share * np.where(share > 0.0, own, 0.0)
        merged = np.where(seen[..., None], share * variance, variance)
        sigma[:, self._channels] = np.sqrt(np.where(known[..., None], merged, noise))
        observed[:, self._channels] |= known
        return measured._replace(observed=observed, values=values, sigma=sigma)
