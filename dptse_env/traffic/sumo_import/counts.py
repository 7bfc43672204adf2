"""Demand of a road, counted in a record of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.demand import Demand, Profile
from dptse_env.traffic.record import Record

NEVER = np.iinfo(np.int64).max
"""First step of a vehicle on a column where it never is."""

LEAST_SHARE = 0.001
"""Least exit share: a road has shares above 0 and below 1."""


def counted_demand(corridor: Corridor, record: Record, period: int) -> Demand:
    """Count who enters a road.

    Args:
        corridor: the road.
        record: one record of it.
        period: length of the steps of the rates [s].

    Returns:
        The rates of vehicles that come over the upstream boundary segment, and of those on the
        on-ramps. Vehicles that are there at second 0 have entered before.
    """
    first = _first_steps(record)
    N, S, n_on = corridor.n_mainline, corridor.n_segments, corridor.n_on_ramps
    edges = np.append(np.arange(0, corridor.duration, period), corridor.duration)
    if len(edges) > 2 and edges[-1] - edges[-2] < period:
        edges = np.delete(edges, -2)  # a last step that is shorter joins the one before
    entrances = [first[:, S]]
    entrances += [np.minimum(first[:, N + i], first[:, S + 2 + i]) for i in range(n_on)]
    mainline, *ramps = (_rates(steps, edges) for steps in entrances)
    return Demand(mainline=mainline, on_ramps=tuple(ramps))


def _rates(steps: NDArray[np.int64], edges: NDArray[np.int64]) -> Profile:
    """Return the rate of entering between times [s], of vehicles that enter at some steps."""
    counts, _ = np.histogram(steps[(steps > 0) & (steps < NEVER)], edges)
    rates = 3600.0 * counts / np.diff(edges)
    return tuple(
        (float(time), round(float(rate), 1)) for time, rate in zip(edges[:-1], rates, strict=True)
    )


def counted_shares(corridor: Corridor, record: Record) -> tuple[float, ...]:
    """Count the share of vehicles that leave, of those that pass each off-ramp."""
    first = _first_steps(record)
    N, S, n_on = corridor.n_mainline, corridor.n_segments, corridor.n_on_ramps
    shares = []
    for i, face in enumerate(corridor.off_ramps):
        after = [S + 2 + n_on + i, N + n_on + i]
        left = _reached(first, after)
        was_before = _reached(first, [S, *range(face)])
        passed = was_before & _reached(first, [*range(face, N), S + 1]) & ~left
        n_left, n_all = int(left.sum()), int((left | passed).sum())
        share = n_left / n_all if n_all else 0.0
        shares.append(round(min(max(share, LEAST_SHARE), 1.0 - LEAST_SHARE), 4))
    return tuple(shares)


def _reached(first: NDArray[np.int64], columns: list[int]) -> NDArray[np.bool_]:
    reached: NDArray[np.bool_] = np.any(first[:, columns] < NEVER, axis=1)
    return reached


def _first_steps(record: Record) -> NDArray[np.int64]:
    """Return the first step of each vehicle on each column, (n_vehicles, n_columns)."""
    first = np.full((record.n_vehicles, record.n_columns), NEVER)
    np.minimum.at(first, (record.vehicle, record.segment), record.step.astype(np.int64))
    return first
