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
from dptse_env.utils.units import HOUR, KMH

LEAST_SPEED = 3.0
"""Least mean speed by which a flow is divided [km/h]."""
UNKNOWN = 1e5
"""Deviation of what a reading does not tell."""
SPACING, HEADWAY = 8.0, 1.4
"""Distance of vehicles that stand [m], and what it grows by with their speed [s]."""
STANDING = 75.0
"""Density of a lane that a jam has more than its flow tells, where nobody passes [veh/km]."""
SLOWED = 0.2
"""Part of what vehicles in a jam are slower than flow and density tell."""
NOTHING_PASSED = 45.0
"""Deviation of a lane's density where nothing passed [veh/km]: it is empty, or stands."""
FLICKER, COUNTED = 0.6, 0.3
"""Parts of a Poisson process's variance that numbers on a segment have, and numbers that passed."""
DENSITY_WAVES, SPEED_WAVES = 25.0, 16.0
"""Deviations in a jam, in a minute's readings: of a lane's density [veh/km], of speeds [km/h]."""
RAMP_WAVES = 3.0
"""Factor of their variances beside stations of ramps, where vehicles brake or speed up."""
DENSITY_FAR, SPEED_FAR = 3.0, 10.0
"""What deviations grow by with the length of a segment, far from jams [lane^-1 km^-2, h^-1]."""
OWN_SPEED = 13.0
"""Deviation of a vehicle's speed [km/h]."""


class Said(NamedTuple):
    """What readings say of every second of their interval; NaN where nothing is said.

    Errors of speeds are the same in all seconds, and those of densities but for what the number on
    a segment varies by. Where the seconds count as independent ones, their variance is therefore
    larger by the number of seconds that are alike.
    """

    density: FloatArray  # [veh/km]
    speed: FloatArray  # [km/h]
    density_std: FloatArray  # of one second
    speed_std: FloatArray
    density_alike: FloatArray  # seconds that are alike, from 1 to all

    def at(self, episodes: IntArray) -> "Said":
        """Return rows of the k episodes."""
        return Said(*(array[episodes] for array in self))


def interpreted(
    flow: FloatArray,
    speed: FloatArray,
    interval: int,
    lanes: FloatArray | float,
    length: FloatArray | float,
    limit: FloatArray | float,
    is_ramp: BoolArray | bool = False,
) -> Said:
    """Return what a station says of a segment beside it, by fits to training traffic.

    In free traffic the density is q / v, with the flow q and the arithmetic mean speed v. In a jam
    vehicles that stand are not counted. There a lane whose density k = q / v is below k_v, that of
    vehicles at this speed, has more of it, by 75 (1 - k / k_v) J. J is the share of a jam, which
    follows from v and the speed limit. The vehicles then are slower than v.

    Variances are those of the number on a segment, of the number that passed, and of waves in a
    jam; of speeds those of the vehicles' own ones and of waves.

    Fitted to readings at all borders in training traffic, of the built-in roads (seeds 0 to 7) and
    14 of the random highways that networks are trained on, in intervals of 20, 60 and 300 s. On
    test seeds of the built-in roads, mean squared errors over variances by class of speed are .6 to
    1.7, and .4 to 2 in intervals of 300 s (``tests/measurement/test_loops.py``).

    Args:
        flow: Of all lanes [veh/h]; NaN where there is no reading.
        speed: Arithmetic mean [km/h]; any where nothing passed.
        interval: Its length [s].
        lanes: Lanes of the segment.
        length: Its length [km].
        limit: Its speed limit [km/h].
        is_ramp: Whether it is on a ramp.
    """
    passed, silent = flow > 0.0, np.isnan(flow)
    v = np.where(passed, np.maximum(speed, LEAST_SPEED), limit)
    told = flow / lanes / v
    shift, spread = 0.06 * np.log(interval / 60.0), (interval / 60.0) ** 0.2

    def jam(middle: float) -> FloatArray:
        share: FloatArray = 0.5 + 0.5 * np.tanh((middle + shift - v / limit) / 0.2)
        return share

    moving = 1000.0 / (SPACING + HEADWAY * v / KMH)
    density = told + STANDING * np.maximum(1.0 - told / moving, 0.0) * jam(0.53)
    slower = SLOWED * v * (1.0 - told / np.maximum(density, 1e-9))
    single = FLICKER * (density + 1.0) / lanes
    seen = v * interval / HOUR  # [km] that passes in an interval
    waves = np.where(is_ramp, RAMP_WAVES, 1.0) * spread**2
    density_waves = waves * (DENSITY_WAVES * jam(0.6)) ** 2 * (1.0 + length)
    common = single * COUNTED / seen + (DENSITY_FAR * length) ** 2 + density_waves
    own = OWN_SPEED**2 / (1.0 + density * lanes * length) + (SPEED_FAR * length) ** 2
    common = np.where(passed, common, NOTHING_PASSED**2)
    each = np.where(passed, single / length, 0.0)
    density = np.where(silent, np.nan, np.where(passed, lanes * density, 0.0))
    return Said(
        density,
        np.where(passed, v - slower, np.nan),
        lanes * np.sqrt(common + each) + 0.0 * density,
        np.where(passed, np.sqrt(own + waves * (SPEED_WAVES * jam(0.85)) ** 2), np.nan),
        (interval * common + each) / (common + each),
    )


class LoopReadings:
    """The readings of all traffic seeds, and what they say of the L segments beside stations.

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
        segments, place = np.unique(self.stations.beside, return_inverse=True)
        self._channels = task.queries.channels_of_segments(corridor)[segments]
        self._releases_flow = task.releases_flow
        self._segments, self._limit = segments, road.limits[segments]
        self._least_density = 1.0 / road.lengths[segments]
        # Pairs of a station and a segment beside it.
        pairs = np.arange(len(self.stations.beside)).repeat(2), place.reshape(-1)
        self._station, self._place = np.unique(np.array(pairs), axis=1)
        beside = segments[self._place]
        on_ramp = beside >= road.n_mainline
        self._pairs = road.lanes[beside], road.lengths[beside], road.limits[beside], on_ramp
        self._mean = np.eye(segments.size)[self._place]  # (pairs, L)

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
        """Return what readings (k, F, 2) say of segments, arrays (k, L).

        A segment between two stations has the mean of both, and of their deviations.
        """
        flow, speed = read[:, self._station, 0] * (HOUR / self.interval), read[:, self._station, 1]
        found = interpreted(flow, speed, self.interval, *self._pairs)
        known, passed = np.isfinite(found.density), np.isfinite(found.speed)
        by_name = zip(Said._fields, found, strict=True)
        means = {
            name: self._averaged(values, passed if name.startswith("speed") else known)
            for name, values in by_name
        }
        untold = np.isnan(means["speed"])
        means["speed"] = np.where(untold, self._limit, means["speed"])
        means["speed_std"] = np.where(untold, UNKNOWN, means["speed_std"])
        return Said(**means)

    def _averaged(self, values: FloatArray, known: BoolArray) -> FloatArray:
        """Return means (k, L) of what is known at the stations beside a segment; NaN for none."""
        total, n = np.where(known, values, 0.0) @ self._mean, known @ self._mean
        means: FloatArray = np.where(n > 0.0, total, np.nan) / np.maximum(n, 1.0)
        return means

    def added(self, measured: Measurement, said: Said) -> Measurement:
        """Return the measurement of a second with what readings say of it.

        Where a segment is measured in the same second, both are weighed by their variances.
        """
        density, speed = said.density, said.speed
        density_std = said.density_std * np.sqrt(said.density_alike)
        speed_std = said.speed_std * self.interval**0.5
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
