"""Readings of loops, made of a record.

A record has the segments of vehicles at whole seconds. A vehicle whose front is on one side of a
station at a second and on the other side when it is seen next has passed it in the second that ends
then. Its speed there is taken for the mean of both.

So the counts are those of SUMO's induction loops, but for one thing: a vehicle that changes its
lane on a loop is counted on two of them there and once here. Speeds differ since vehicles brake and
speed up within a second: root mean square differences of readings of 20 s are .7 to 1.5 km/h.
"""

import numpy as np

from dptse_env.traffic.loops import Loops, Stations
from dptse_env.traffic.record import Record
from dptse_env.utils.arrays import FloatArray, IntArray

LONGEST_GAP = 10
"""Seconds out of sight after which a vehicle comes anew, as between edges of a SUMO net."""


def readings(record: Record, stations: Stations, loops: Loops) -> FloatArray:
    """Return what stations report at the end of each interval of a record.

    Intervals are those of the record: from its beginning on, whole ones alone.

    Returns:
        Numbers of vehicles and their mean speeds [km/h], shape (K, F, 2). Both are NaN where fewer
        than `Loops.least_count` passed, the speed also where none did.

    Raises:
        ValueError: The record is a measured field.
    """
    second, station, speed = passages(record, stations)
    K, F = (record.n_steps - 1) // loops.interval, len(stations.beside)
    interval = (second - 1) // loops.interval
    whole = interval < K
    place = (interval * F + station)[whole]
    count = np.bincount(place, minlength=K * F).astype(np.float64)
    total = np.bincount(place, speed[whole], minlength=K * F)
    with np.errstate(invalid="ignore"):
        table = np.stack([count, total / count], axis=-1).reshape(K, F, 2)
    table[table[..., 0] < loops.least_count] = np.nan
    return table


def passages(record: Record, stations: Stations) -> tuple[IntArray, IntArray, FloatArray]:
    """Return second, station and speed [km/h] of every passage.

    A vehicle that drives to and fro, as by errors of positions, passes a station once. One that
    appears on the first segment has come over the upstream end, and one that vanishes from the last
    segment has left over the downstream end.
    """
    vehicles = record.vehicles_for("corridor.loops")
    order = np.lexsort((vehicles.step, vehicles.vehicle))
    step, vehicle = vehicles.step[order].astype(np.int64), vehicles.vehicle[order]
    cell, speed = vehicles.segment[order].astype(np.int64), vehicles.speed[order].astype(float)
    is_same = (np.diff(vehicle) == 0) & (np.diff(step) <= LONGEST_GAP)
    visit = np.concatenate([[0], np.cumsum(~is_same)])[: len(step)]
    before = np.flatnonzero(is_same & (np.diff(cell) != 0))
    passed = stations.upstream[:, cell[before]] & stations.downstream[:, cell[before + 1]]
    station, which = np.nonzero(passed)
    row = before[which]
    # Rows are in order of time, so that the first passage of a visit is kept.
    _, first = np.unique(station * len(step) + visit[row], return_index=True)
    station, row = station[first], row[first]
    found = [(step[row + 1], station, 0.5 * (speed[row] + speed[row + 1]))]
    is_first = np.concatenate([[True], ~is_same])[: len(step)] & (step > 0)
    is_last = np.concatenate([~is_same, [True]])[: len(step)] & (step < record.n_steps - 1)
    for ends, at, later in ((stations.enters, is_first, 0), (stations.leaves, is_last, 1)):
        for end in np.flatnonzero(ends >= 0):
            there = np.flatnonzero(at & (cell == ends[end]))
            found.append((step[there] + later, np.full(len(there), end), speed[there]))
    second, station, speed = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return second, station, speed
