"""Loops: what their readings say of the segments beside them.

Readings are public before the releases and no part of any budget. A reading comes at the end of its
interval and is told within it: `dptse_env.measurement.rewind`. It is of a mean. So each second is
told what an estimator took it for, moved by what the mean lacks. Were the mean told as the value of
each second, a jam that came within the interval would be smoothed away.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.release import Task, Traffic
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, kernel
from dptse_env.utils.units import HOUR, KMH

LEAST_SPEED = 3.0
"""Least mean speed by which a flow is divided [km/h]."""
UNKNOWN = 1e5
"""Deviation of what a reading does not tell."""
SPACING, HEADWAY = 8.0, 1.4
"""Distance of vehicles that stand [m], and what it grows by with their speed [s]."""
STANDING = 75.0
"""Density of a lane that a jam has more than its flow tells, where nobody passes [veh/km]."""
SLOWED = 0.37
"""Part of what vehicles in a jam are slower than flow and density tell."""
QUEUE, LEAST_QUEUE, EMPTIED = 130.0, 0.02, 40.0
"""Density of a lane that stands where nothing passed [veh/km]; the others are empty. Share of those
that stand in long intervals, and the time in which the rest of it falls [s]."""
QUEUES = 0.16, 0.02
"""Share of lanes that stand in a moment without a vehicle, on the mainline and on ramps."""
FLICKER, COUNTED = 0.6, 0.3
"""Parts of a Poisson process's variance that numbers on a segment have, and numbers that passed."""
DENSITY_WAVES, SPEED_WAVES = 25.0, 16.0
"""Deviations in a jam, in a minute's readings: of a lane's density [veh/km], of speeds [km/h]."""
RAMP_SPEEDS, RAMP_SPREAD = 0.4, 0.3
"""Speeds on a ramp are those at its mouth, where vehicles brake, over a + (1 - a) v / limit. Part
of a density there that waves are, in intervals of up to 30 s."""
WAVE = 40.0
"""Time in which waves pass [s]: in longer intervals little is left of them in the mean."""
DENSITY_FAR, SPEED_FAR = 3.0, 10.0
"""Growth of deviations with the length of a segment, far from jams [lane^-1 km^-2, h^-1]."""
STRETCH = 10
"""Seconds of an interval that a reading is told once in, at least [s]."""
OWN_SPEED = 13.0
"""Deviation of a vehicle's speed [km/h]."""


class Said(NamedTuple):
    """Traffic in any second of an interval, by its readings; NaN where nothing is said."""

    density: FloatArray  # [veh/km]
    speed: FloatArray  # [km/h]
    density_std: FloatArray
    speed_std: FloatArray
    density_shared: FloatArray  # deviations of the interval's mean, which all seconds share
    speed_shared: FloatArray


def seconds_told(interval: int) -> IntArray:
    """Return the seconds of an interval, from 0 on, in which an estimator is told its reading."""
    n = max(interval // STRETCH, 1)
    return ((np.arange(n) + 0.5) * interval / n).astype(np.int64)


def interpreted(
    flow: FloatArray,
    speed: FloatArray,
    interval: IntArray | int,
    lanes: FloatArray | float,
    length: FloatArray | float,
    limit: FloatArray | float,
    is_ramp: BoolArray | bool = False,
) -> Said:
    """Return what a station says of a segment beside it, by fits to training traffic.

    In free traffic the density is q / v, with the flow q and the arithmetic mean speed v. In a jam
    vehicles that stand are not counted. There a lane whose density k = q / v is below k_v, that of
    vehicles at this speed, has more of it, by 75 (1 - k / k_v) J. J is the share of a jam, which
    follows from v and the speed limit. The vehicles then are slower than v. Vehicles brake where a
    ramp meets the road, so a ramp is faster than its station says, and less dense than q / v.

    Where nothing passed, a lane is empty or stands; the longer the interval, the likelier it is
    empty. The density is the mean of both.

    Variances are those of the number on a segment, of the number that passed, and of waves in a
    jam; of speeds those of the vehicles' own ones and of waves. All seconds of an interval share
    errors of the number that passed, and of waves the part 40 / (40 + T) in an interval of T s.

    Fitted to readings at all borders in training traffic of the built-in roads (seeds 0 to 7), in
    intervals of 10 to 300 s. Mean squared errors over variances by class of speed:
    ``tests/measurement/test_loops.py``.

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
    longer, spread = np.log(interval / 60.0), (interval / 60.0) ** 0.2

    def jam(middle: float, width: float, shift: float) -> FloatArray:
        share: FloatArray = 0.5 + 0.5 * np.tanh((middle + shift * longer - v / limit) / width)
        return share

    moving = 1000.0 / (SPACING + HEADWAY * v / KMH)
    braked = RAMP_SPEEDS + (1.0 - RAMP_SPEEDS) * np.minimum(v / limit, 1.0)
    standing = STANDING * np.maximum(1.0 - told / moving, 0.0) * jam(0.6, 0.11, 0.02)
    density = np.where(is_ramp, told * braked, told + standing)
    slower = SLOWED * v * (1.0 - told / np.maximum(density, 1e-9))
    mean = np.where(is_ramp, np.minimum(v / braked, limit), v - slower)
    single = FLICKER * (density + 1.0) / lanes
    seen = v * interval / HOUR  # [km] that passes in an interval
    ramp_waves = RAMP_SPREAD * told * np.maximum(interval / 30.0, 1.0) ** 0.5
    waves = np.where(is_ramp, ramp_waves, spread * DENSITY_WAVES * jam(0.6, 0.2, 0.06))
    density_waves = waves**2 * (1.0 + length)
    counts = single * COUNTED / seen + (DENSITY_FAR * length) ** 2
    apart = (SPEED_FAR * length) ** 2
    speed_waves = (spread * SPEED_WAVES * jam(0.85, 0.2, 0.06)) ** 2
    queue = LEAST_QUEUE + np.where(is_ramp, QUEUES[1], QUEUES[0]) * np.exp(-interval / EMPTIED)
    density = np.where(passed, density, QUEUE * queue)
    counts = np.where(passed, counts, 0.0)
    density_waves = np.where(passed, density_waves, QUEUE**2 * queue * (1.0 - queue))
    # How many vehicles are on the segment, and which ones, is of each second alone.
    number = np.where(passed, single / length, 0.0)
    own = OWN_SPEED**2 / (1.0 + density * lanes * length)
    lasting = WAVE / (WAVE + interval)
    heard, seen_moving = np.where(silent, np.nan, lanes), np.where(passed, 1.0, np.nan)
    return Said(
        density=heard * density,
        speed=seen_moving * mean,
        density_std=heard * np.sqrt(counts + density_waves + number),
        speed_std=seen_moving * np.sqrt(apart + speed_waves + own),
        density_shared=heard * np.sqrt(counts + lasting * density_waves),
        speed_shared=seen_moving * np.sqrt(apart + lasting * speed_waves),
    )


class LoopReadings:
    """The readings of all traffic seeds, and what they say of the L segments beside stations.

    Attributes:
        interval: Length of an interval [s].
        seconds: The N of its seconds in which an estimator is told, from 0 on.
        segments: The L segments.
    """

    def __init__(self, task: Task, traffic: Traffic) -> None:
        """Prepare for the loops of a task's corridor; nothing is loaded."""
        corridor = task.corridor
        assert corridor.loops is not None
        self._traffic, road = traffic, corridor.road
        self.interval = corridor.loops.interval
        beside = corridor.stations.beside
        segments, place = np.unique(beside, return_inverse=True)
        channels = task.queries.channels_of_segments(corridor)[segments]
        least_density = 1.0 / road.lengths[segments]
        self._places = Bundle(Places(channels, segments, least_density, task.releases_flow))
        self.segments, self._limit = segments, road.limits[segments]
        self.seconds = seconds_told(self.interval)
        # Index into them of each second of an interval, -1 where nothing is told.
        self._telling = np.full(self.interval, -1)
        self._telling[self.seconds] = np.arange(len(self.seconds))
        # Pairs of a station and a segment beside it.
        pairs = np.arange(len(beside)).repeat(2), place.reshape(-1)
        self._station, place = np.unique(np.array(pairs), axis=1)
        beside = segments[place]
        on_ramp = beside >= road.n_mainline
        self._pairs = road.lanes[beside], road.lengths[beside], road.limits[beside], on_ramp
        self._mean = np.eye(segments.size)[place]  # (pairs, L)
        shape = traffic.readings.shape[1], segments.size, len(Said._fields)
        self._said = traffic.derived(shape, self._said_of)

    def last(self, traffic: IntArray, times: IntArray) -> FloatArray:
        """Return last readings at seconds of the record (k,), NaN before the first.

        Returns:
            Flows [veh/h] and mean speeds [km/h], shape (k, F, 2).
        """
        interval = times // self.interval - 1
        n_stations, some = self._traffic.readings.shape[2], interval >= 0
        found = np.full((len(times), n_stations, 2), np.nan)
        found[some] = self._traffic.readings[traffic[some], interval[some]]
        found[..., 0] *= HOUR / self.interval
        return found

    def said(self, read: FloatArray) -> Said:
        """Return what readings (k, F, 2) say of segments, arrays (k, L).

        A segment between two stations has the mean of both, and of their deviations.
        """
        flow, speed = read[:, self._station, 0] * (HOUR / self.interval), read[:, self._station, 1]
        told = interpreted(flow, speed, self.interval, *self._pairs)
        means = Said(*map(self._averaged, told))
        untold = np.isnan(means.speed)
        return means._replace(
            speed=np.where(untold, self._limit, means.speed),
            speed_std=np.where(untold, UNKNOWN, means.speed_std),
            speed_shared=np.where(untold, 0.0, means.speed_shared),
        )

    def _averaged(self, values: FloatArray) -> FloatArray:
        """Return means (k, L) of what is known at the stations beside a segment; NaN for none."""
        known = np.isfinite(values)
        total, n = np.where(known, values, 0.0) @ self._mean, known @ self._mean
        means: FloatArray = np.where(n > 0.0, total, np.nan) / np.maximum(n, 1.0)
        return means

    def _said_of(self, index: int) -> FloatArray:
        """Return what is said in all intervals of a record, (K, L, 6)."""
        said: FloatArray = np.stack(self.said(self._traffic.readings[index]), axis=-1)
        return said

    def said_until(self, traffic: IntArray, times: IntArray) -> FloatArray:
        """Return what is said of the intervals that end at seconds (k,).

        Returns:
            The fields of `Said`, shape (k, L, 6); NaN where nothing is said.
        """
        found: FloatArray = self._said[traffic, times // self.interval - 1]
        return found

    def told(self, said: FloatArray, estimated: FloatArray) -> FloatArray:
        """Return what the N seconds are told, by what an estimator took them for before.

        z_i = s + min(s / m, 1) (x_i - m), with estimates x_i, their mean m and the mean s that is
        said: their course is kept, and where it is scaled down, nothing falls below 0.

        Args:
            said: What `said_until` returns of k episodes.
            estimated: Densities and speeds x, shape (N, k, L, 2); NaN before an episode began.

        Returns:
            Densities, speeds and their deviations, shape (N, k, L, 4).
        """
        known = np.isfinite(estimated)
        total, n = np.where(known, estimated, 0.0).sum(axis=0), known.sum(axis=0)
        mean = total / np.maximum(n, 1)
        share = np.minimum(said[..., :2] / np.maximum(mean, 1e-9), 1.0)
        values = said[..., :2] + np.where(known, share * (estimated - mean), 0.0)
        more = (len(estimated) - 1) ** 0.5  # so that shared errors count once
        std = np.hypot(said[..., 2:4], more * said[..., 4:])
        return np.concatenate([values, np.broadcast_to(std, values.shape)], axis=-1)

    def added(self, measured: Measurement, told: FloatArray, seconds: IntArray) -> Measurement:
        """Return the measurement of some seconds with what readings say, where they are told.

        Where a segment is measured in the same second, both are weighed by their variances.

        Args:
            measured: Of m seconds of k episodes, one after the other, m k rows.
            told: What `told` returns of them.
            seconds: Seconds of the interval, from 0 on, shape (m,).
        """
        observed, values, sigma = merge(self._places, measured, told, self._telling[seconds])
        return measured._replace(observed=observed, values=values, sigma=sigma)


class Places(NamedTuple):
    """The L segments that readings say something of."""

    channel: IntArray  # (L,)
    segment: IntArray  # (L,)
    least_density: FloatArray  # (L,) one vehicle [veh/km]
    releases_flow: bool


@kernel
def merge(
    bundle: Any, measured: Measurement, told: FloatArray, telling: IntArray
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return the first fields of a `Measurement`, see `LoopReadings.added`."""
    (places,) = bundle.parts
    observed, values = measured.observed.copy(), measured.values.copy()
    sigma, n = measured.sigma.copy(), told.shape[1]
    for row in range(len(observed)):
        time = telling[row // n]
        if time < 0:
            continue
        for i in range(places.channel.size):
            density, speed, density_std, speed_std = told[time, row % n, i]
            if np.isnan(density):
                continue
            second, second_std, c = speed, speed_std, places.channel[i]
            if places.releases_flow:
                slip = speed - measured.centre[row, places.segment[i]]
                second, carrier = density * slip, max(density, places.least_density[i])
                second_std = math.hypot(carrier * speed_std, slip * density_std)
            for j, value, std in ((0, density, density_std), (1, second, second_std)):
                if observed[row, c]:
                    noise = sigma[row, c, j] ** 2
                    share = noise / (noise + std**2)  # of the reading
                    values[row, c, j] = (1.0 - share) * values[row, c, j] + share * value
                    sigma[row, c, j] = math.sqrt(share) * std
                else:
                    values[row, c, j], sigma[row, c, j] = value, std
            observed[row, c] = True
    return observed, values, sigma
