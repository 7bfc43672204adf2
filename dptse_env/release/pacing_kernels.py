"""Compiled kernels of pacing, episode by episode; all their arguments are public."""

from typing import Any, NamedTuple

import numpy as np

from dptse_env.model.parameters import SECONDS_PER_HOUR
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import copy_vector, kernel, kernel_part

Packed = tuple[Any, ...]

SLOWEST, FASTEST = 8.0, 102.0
"""Range that predicted speeds [km/h] are held to where they give the time of a trip."""

MARGIN = 2.0
"""Queried seconds added to those that are expected for the rest of a trip [s]."""

MEMORY = 60.0
"""Time constant of the average by which rates of querying follow the queries [s]."""


class PacedRoad(NamedTuple):
    """A road, by the columns of its records: mainline, ramps, boundary segments."""

    n_mainline: int  # n
    n_segments: int  # S
    length: FloatArray  # (S,) l of the segments [km]
    edges: IntArray  # (E, 2) segments (from, to) between which vehicles pass
    edge_share: FloatArray  # (E,) share of the outflow that passes
    entries: IntArray  # (1 + I,) segments with inflow from outside: the first, then the on-ramps
    entry_places: IntArray  # (1 + I,) boundary segments before them; negative if not released
    exits: IntArray  # (1 + O,) segments with outflow: the last of the mainline, the off-ramps
    exit_places: IntArray  # (1 + O,) boundary segments after them; negative if not released
    next_segment: IntArray  # (S,) segment that each leads to, ahead on the mainline; -1 at exits


class PacedColumns(NamedTuple):
    """Columns of a release."""

    first: IntArray  # (C,) first record column that each covers
    span: IntArray  # (C,) number of record columns that each covers
    level: FloatArray  # (C,) price level


@kernel
def pace(
    road_: Packed,
    columns_: Packed,
    episodes: IntArray,
    observed: BoolArray,
    density: FloatArray,
    speed: FloatArray,
    offered: float,
    least: float,
    charge: float,
    rates: FloatArray,
    tracer: FloatArray,
    prices: FloatArray,
) -> None:
    """Move the tracer along, set prices, and charge the tracer for the queries.

    Args:
        road_: The `PacedRoad`.
        columns_: The `PacedColumns`.
        episodes: Shape (k,).
        observed: Columns that are observed, shape (k, C).
        density: Predicted densities [veh/km], shape (k, S).
        speed: Predicted speeds [km/h], shape (k, S).
        offered: Part of the budget that a trip should spend.
        least: Least that is offered for the rest of a trip.
        charge: Expected payment over the price.
        rates: Rates of querying, shape (n, places), updated.
        tracer: Expected payments so far, shape (n, places), updated.
        prices: Output, shape (k, C).
    """
    road, columns = PacedRoad(*road_), PacedColumns(*columns_)
    places = tracer.shape[1]
    rest, before, charged = np.empty(places), np.empty(places), np.empty(places)
    inflow = np.empty((2, road.n_segments))
    for k in range(episodes.size):
        paid, rate = tracer[episodes[k]], rates[episodes[k]]
        copy_vector(paid, before)
        _carry(road, density[k], speed[k], before, paid, inflow)
        _remaining(road, speed[k], rate, rest)
        charged[:] = 0.0
        for c in range(columns.first.size):
            first, last = columns.first[c], columns.first[c] + columns.span[c]
            price = 0.0
            for s in range(first, last):
                price += max(offered - paid[s], least) / rest[s]
            price *= columns.level[c] / columns.span[c]
            prices[k, c] = price
            if observed[k, c]:
                for s in range(first, last):
                    charged[s] += price
        for s in range(places):
            paid[s] += charge * charged[s]
            seen = 1.0 if charged[s] > 0.0 else 0.0
            rate[s] += (seen - rate[s]) / MEMORY


@kernel_part
def _carry(
    road: PacedRoad,
    density: FloatArray,
    speed: FloatArray,
    before: FloatArray,
    after: FloatArray,
    inflow: FloatArray,
) -> None:
    """Mix the tracer on each segment with that of the vehicles that arrived in a second."""
    flow, mass = inflow[0], inflow[1]
    flow[:], mass[:] = 0.0, 0.0
    for e in range(road.edges.shape[0]):
        start, end = road.edges[e, 0], road.edges[e, 1]
        arriving = road.edge_share[e] * density[start] * speed[start]
        flow[end] += arriving
        mass[end] += arriving * before[start]
    for e in range(road.entries.size):
        s, place = road.entries[e], road.entry_places[e]
        arriving = density[s] * speed[s]
        flow[s] += arriving
        if place >= 0:
            mass[s] += arriving * before[place]
            after[place] *= 1.0 - _moved(road.length[s], speed[s])
    for s in range(road.n_segments):
        if flow[s] > 0.0:
            arrived = flow[s] / (SECONDS_PER_HOUR * road.length[s] * max(density[s], 1e-9))
            share = min(arrived, 1.0)
            after[s] = (1.0 - share) * before[s] + share * mass[s] / flow[s]
    for e in range(road.exits.size):
        s, place = road.exits[e], road.exit_places[e]
        if place >= 0:
            share = _moved(road.length[s], speed[s])
            after[place] = (1.0 - share) * before[place] + share * before[s]


@kernel_part
def _moved(length: float, speed: float) -> float:
    """Return the share of the vehicles on a length [km] that leave it in a second."""
    return float(min(speed / (SECONDS_PER_HOUR * length), 1.0))


@kernel_part
def _remaining(road: PacedRoad, speed: FloatArray, rate: FloatArray, rest: FloatArray) -> None:
    """Write the queried seconds that a vehicle on each record column has still to come."""
    n, S = road.n_mainline, road.n_segments
    rest[:S] = 0.0
    for e in range(road.exits.size):
        s, place = road.exits[e], road.exit_places[e]
        rest[s] = MARGIN
        if place >= 0:
            rest[s] += _seconds(road.length[s], speed[s]) * rate[place]
            rest[place] = rest[s]
    # Against the traffic: the segment that each one leads to comes first.
    for first, last in ((n, -1), (S, n - 1)):
        for s in range(first - 1, last, -1):
            ahead = rest[road.next_segment[s]] if road.next_segment[s] >= 0 else rest[s]
            rest[s] = ahead + _seconds(road.length[s], speed[s]) * rate[s]
    for e in range(road.entries.size):
        s, place = road.entries[e], road.entry_places[e]
        if place >= 0:
            rest[place] = rest[s] + _seconds(road.length[s], speed[s]) * rate[place]


@kernel_part
def _seconds(length: float, speed: float) -> float:
    """Return the time [s] on a length [km] at a speed [km/h]."""
    return float(SECONDS_PER_HOUR * length / min(max(speed, SLOWEST), FASTEST))


@kernel
def divide(
    columns_: Packed, n_places: int, observed: BoolArray, whole: float, prices: FloatArray
) -> None:
    """Divide a second's budget among the queries that cover a place, by their levels."""
    columns = PacedColumns(*columns_)
    total = np.empty(n_places)
    for k in range(observed.shape[0]):
        total[:] = 0.0
        for c in range(columns.first.size):
            if observed[k, c]:
                for s in range(columns.first[c], columns.first[c] + columns.span[c]):
                    total[s] += columns.level[c]
        for c in range(columns.first.size):
            most = columns.level[c]
            for s in range(columns.first[c], columns.first[c] + columns.span[c]):
                own = 0.0 if observed[k, c] else columns.level[c]
                most = max(most, total[s] + own)
            prices[k, c] = whole * columns.level[c] / most
