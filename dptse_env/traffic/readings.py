"""Readings of loop detectors, made of a record."""

import numpy as np

from dptse_env.traffic.loops import Loops, Stations
from dptse_env.traffic.record import Record
from dptse_env.utils.arrays import FloatArray


def readings(record: Record, stations: Stations, loops: Loops) -> FloatArray:
    """Return what stations report at the end of each interval of a record.

    Returns:
        Numbers of vehicles and their mean speeds [km/h], shape (K, F, 2). Both are NaN where fewer
        than `Loops.least_count` passed, the speed also where none did.

    Raises:
        ValueError: The record is a measured field.
    """
    vehicles = record.vehicles_for("corridor.loops")
    order = np.lexsort((vehicles.step, vehicles.vehicle))
    step, vehicle = vehicles.step[order].astype(np.int64), vehicles.vehicle[order]
    cell, speed = vehicles.segment[order].astype(np.int64), vehicles.speed[order].astype(float)
    moved = (np.diff(vehicle) == 0) & (np.diff(step) == 1) & (np.diff(cell) != 0)
    before = np.flatnonzero(moved)
    passed = stations.upstream[:, cell[before]] & stations.downstream[:, cell[before + 1]]
    station, which = np.nonzero(passed)
    row = before[which]
    # A vehicle that passes between two steps does so in the second that the later one ends.
    interval, K = step[row] // loops.interval, (record.n_steps - 1) // loops.interval
    whole, F = interval < K, len(stations.beside)
    place = (interval * F + station)[whole]
    mean = (0.5 * (speed[row] + speed[row + 1]))[whole]
    count = np.bincount(place, minlength=K * F).astype(np.float64)
    total = np.bincount(place, mean, minlength=K * F)
    with np.errstate(invalid="ignore"):
        table = np.stack([count, total / count], axis=-1).reshape(K, F, 2)
    table[table[..., 0] < loops.least_count] = np.nan
    return table
