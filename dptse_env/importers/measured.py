"""Demand, exit shares and average dwell of a road, as measured on its records."""

import warnings
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.demand import Demand
from dptse_env.traffic.imported import ranges
from dptse_env.traffic.record import Record, average_dwell
from dptse_env.utils.validation import require

LEAST_SHARE = 0.001
"""Exit shares must be above 0 and below 1: nobody or everybody leaving counts as this much."""


def with_measured(
    corridor: Corridor,
    records: Iterable[Record],
    demand: Demand,
    exit_shares: Iterable[float] | None = None,
) -> Corridor:
    """Return a corridor with values that were measured, which it names.

    Args:
        corridor: The corridor.
        records: The records, for the average dwell.
        demand: What enters.
        exit_shares: Share of the vehicles that leave by each off-ramp, of those that pass it, in
            [0, 1]; None for a road that has none.

    Raises:
        ValueError: No vehicle is on the mainline.
    """
    values: dict[str, Any] = {"demand": demand}
    if exit_shares is not None:
        held = (min(max(share, LEAST_SHARE), 1.0 - LEAST_SHARE) for share in exit_shares)
        values["exit_shares"] = tuple(round(float(share), 4) for share in held)
    values["average_dwell"] = round(average_dwell(corridor, records), 3)
    return corridor.replaced(**values, measured=tuple(values))


def measure(corridor: Corridor, records: Callable[[], Iterable[Record]]) -> Corridor:
    """Return a corridor with the demand, exit shares and average dwell of records.

    The records are read twice. Flows are Edie's: the mean over time of the sum of speeds over the
    length of a segment. That of the mainline is taken in its first segment, those of ramps in the
    segment at their face.

    Raises:
        ValueError: No vehicle is on the mainline.

    Warns:
        UserWarning: No vehicle is ever on some of its segments.
    """
    sums, counts = np.mean(
        [(record.speed_sums.mean(axis=0), record.counts.mean(axis=0)) for record in records()],
        axis=0,
    )
    road = corridor.geometry
    empty = np.flatnonzero(counts[: road.n_mainline] == 0.0)
    some = "with vehicles on the mainline in the first part of the windows"
    require(len(empty) < road.n_mainline, "files", some, "none there")
    if len(empty):
        warnings.warn(
            f"no vehicle is on the mainline's segments {ranges(empty + 1)} of "
            f"{road.n_mainline}: are layout.origin and the unit of lengths right?",
            stacklevel=3,
        )
    flow = sums[: road.n_segments] / np.array(road.segment_lengths)
    demand = Demand(
        mainline=((0.0, round(float(flow[0]), 1)),),
        on_ramps=tuple(round(float(flow[each[-1]]), 1) for each in road.on_ramp_segments),
    )
    shares = [
        flow[segments[0]] / max(flow[face - 1], 1e-9)
        for face, segments in zip(road.off_ramps, road.off_ramp_segments, strict=True)
    ]
    return with_measured(corridor, records(), demand, shares)
