"""From points at any times to one row for each vehicle and whole second."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from dptse_env.traffic.importers.branches import Road
from dptse_env.traffic.importers.checks import Checks
from dptse_env.traffic.importers.points import TrajectoryError
from dptse_env.traffic.importers.spill import Rows
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

ROW = np.dtype(
    [("time", "f8"), ("position", "f8"), ("speed", "f8"), ("row", "i8"), ("vehicle", "i4"),
     ("lane", "i4"), ("branch", "i2"), ("column", "i2"), ("group", "i2")]
)  # fmt: skip
"""A placed point; without a speed it is NaN."""

SECOND = np.dtype(
    [("position", "f8"), ("speed", "f8"), ("second", "i4"), ("vehicle", "i4"), ("piece", "i4"),
     ("lane", "i4"), ("column", "i2"), ("group", "i2")]
)  # fmt: skip
"""A vehicle at a whole second; pieces number the parts that its trajectory was cut into."""

TIME_UNIT = 1e-4
"""Times are rounded to this [s]: sums of frame lengths are not whole in floating point."""
FASTEST = 300.0 / 3600.0
"""Distance a second that no vehicle exceeds [km/s]; more is a jump to another place."""
JUMP = 0.05
"""Distance that noise may add, forwards or backwards [km]."""
SAME_PLACE = 0.005
"""Largest distance between two points that count as duplicates [km]."""
HALF_WIDTH = 0.5
"""A derived speed is the mean over this time [s] on both sides."""


@dataclass
class Counts:
    """Numbers of rows and vehicles by their fate, as the report names it."""

    rows: int = 0
    no_vehicle: int = 0
    other_group: int = 0
    off_lanes: int = 0
    off_ends: int = 0
    duplicates: int = 0
    out_of_order: int = 0
    negative_speeds: int = 0
    gaps_filled: int = 0
    seconds_filled: int = 0
    gaps_cut: int = 0
    jumps_cut: int = 0
    too_short: int = 0
    seconds: int = 0
    vehicles: int = 0
    pieces: int = 0
    present_at_start: int = 0
    entered: int = 0
    appeared: int = 0
    present_at_end: int = 0
    left: int = 0
    vanished: int = 0

    def add(self, other: Counts) -> None:
        """Add other counts to these."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


def resample(
    rows: Rows, road: Road, longest_gap: float, coverage: FloatArray, counts: Counts,
    checks: Checks, where: str,
) -> tuple[Rows, Rows]:  # fmt: skip
    """Return vehicles at whole seconds, in no order.

    Args:
        rows: All points (`ROW`) of some vehicles.
        road: The road that they are on.
        longest_gap: Longest time without points that is filled by interpolation [s].
        coverage: First and last second of each group, shape (n_groups, 2).
        counts: What happens is added to it.
        checks: Samples are added to it.
        where: The file, for messages.

    Returns:
        Rows at whole seconds (`SECOND`), and the points in order without duplicates.

    Raises:
        TrajectoryError: A vehicle is in two places at once.
    """
    rows = _ordered(rows, counts, where)
    if not len(rows):
        return np.empty(0, dtype=SECOND), rows
    time, position = rows["time"], rows["position"]
    same = np.diff(rows["vehicle"]) == 0
    wait, move = np.diff(time), np.diff(position)
    paused = same & (wait > longest_gap)
    checks.sample(rows, same & ~paused)
    jumped = same & ~paused & ((move > FASTEST * wait + JUMP) | (move < -JUMP))
    joined = same & ~paused & ~jumped
    counts.gaps_cut += int(paused.sum())
    counts.jumps_cut += int(jumped.sum())
    # The usual time between the points of a vehicle; more is a gap.
    filled = joined & (wait > 1.5 * np.median(wait[same])) if same.any() else joined
    counts.gaps_filled += int(filled.sum())

    ends = np.ceil(time)
    n = np.empty(len(rows), dtype=np.int64)
    n[:-1] = np.where(joined, ends[1:] - ends[:-1], ends[:-1] == time[:-1])
    n[-1] = ends[-1] == time[-1]
    counts.seconds_filled += int(np.maximum(n[:-1] - (ends[:-1] == time[:-1]), 0)[filled].sum())
    number = _piece_numbers(rows["vehicle"], joined)
    pieces = np.concatenate([[0], np.cumsum(~joined)])
    counts.vehicles += int((~same).sum()) + 1
    _count_ends(rows, joined, road, coverage, counts)
    counts.too_short += int((np.bincount(pieces, weights=n) == 0).sum())

    left = np.repeat(np.arange(len(rows)), n)
    first = np.cumsum(n) - n
    second = ends[left] + np.arange(len(left)) - first[left]
    right = np.minimum(left + 1, len(rows) - 1)
    span = np.where(np.append(joined, False)[left], time[right] - time[left], 1.0)
    share = (second - time[left]) / span

    def between(values: FloatArray) -> FloatArray:
        at = values[left]
        return np.where(share > 0.0, at + share * (values[right] - at), at)

    found = np.empty(len(left), dtype=SECOND)
    found["position"] = between(position)
    found["second"], found["vehicle"] = second, rows["vehicle"][left]
    found["piece"], found["lane"] = number[left], rows["lane"][left]
    found["group"] = rows["group"][left]
    column = rows["column"][left]
    between_columns = (share > 0.0) & (rows["column"][right] != column)
    nearer = np.where(share < 0.5, left, right)[between_columns]
    column[between_columns] = road.column(
        rows["branch"][nearer], found["position"][between_columns]
    )
    found["column"] = column
    if np.isnan(rows["speed"]).any():
        found["speed"] = _derived(time, position, pieces, left, second)
    else:
        found["speed"] = between(rows["speed"])
    found = found[(column >= 0) & np.isfinite(found["speed"])]
    counts.negative_speeds += int((found["speed"] < 0.0).sum())
    found["speed"] = np.maximum(found["speed"], 0.0)
    counts.seconds += len(found)
    return found, rows


def _ordered(rows: Rows, counts: Counts, where: str) -> Rows:
    """Return rows by vehicle and time without duplicates."""
    rows = rows[np.argsort(rows["vehicle"], kind="stable")]
    same = np.diff(rows["vehicle"]) == 0
    late = same & (np.diff(rows["time"]) < 0.0)
    if late.any():
        counts.out_of_order += int(late.sum())
        rows = rows[np.lexsort((rows["time"], rows["vehicle"]))]
    twice = (np.diff(rows["vehicle"]) == 0) & (np.diff(rows["time"]) == 0.0)
    if twice.any():
        far = np.flatnonzero(twice & (np.abs(np.diff(rows["position"])) > SAME_PLACE))
        if len(far):
            one, other = rows[far[0]], rows[far[0] + 1]
            raise TrajectoryError(
                f"{where}, rows {one['row']} and {other['row']}: a vehicle must be in one place at "
                f"a time, got {one['position']:.3f} km and {other['position']:.3f} km; are there "
                "several recordings in the file (see source.where)?"
            )
        counts.duplicates += int(twice.sum())
        rows = rows[np.concatenate([[True], ~twice])]
    return rows


def _piece_numbers(vehicle: IntArray, joined: BoolArray) -> IntArray:
    """Return the piece of its vehicle's trajectory that each row is in, counted from 0."""
    new_vehicle = np.concatenate([[True], np.diff(vehicle) != 0])
    cut = np.concatenate([[False], ~joined]) & ~new_vehicle
    total = np.cumsum(cut)
    first = np.maximum.accumulate(np.where(new_vehicle, np.arange(len(vehicle)), 0))
    numbers: IntArray = total - total[first]
    return numbers


def _count_ends(
    rows: Rows, joined: BoolArray, road: Road, coverage: FloatArray, counts: Counts
) -> None:
    """Count where the pieces of trajectories begin and end: at an entry, or amid the road."""
    corridor = road.corridor
    n, first = corridor.n_mainline, corridor.n_segments
    n_on, n_off = corridor.n_on_ramps, corridor.n_off_ramps
    on = itertools.chain(*corridor.on_ramp_segments)
    off = itertools.chain(*corridor.off_ramp_segments)
    before, after = (
        range(first + 2, first + 2 + n_on),
        range(first + 2 + n_on, first + 2 + n_on + n_off),
    )
    begins = rows[np.concatenate([[True], ~joined])]
    ends = rows[np.concatenate([~joined, [True]])]
    counts.pieces += len(begins)
    at_start = begins["time"] < coverage[begins["group"], 0] + 1.0
    at_entry = np.isin(begins["column"], [0, first, *on, *before])
    at_end = ends["time"] > coverage[ends["group"], 1] - 1.0
    at_exit = np.isin(ends["column"], [n - 1, first + 1, *off, *after])
    counts.present_at_start += int(at_start.sum())
    counts.entered += int((at_entry & ~at_start).sum())
    counts.appeared += int((~at_entry & ~at_start).sum())
    counts.present_at_end += int(at_end.sum())
    counts.left += int((at_exit & ~at_end).sum())
    counts.vanished += int((~at_exit & ~at_end).sum())


def _derived(
    time: FloatArray, position: FloatArray, pieces: IntArray, left: IntArray, second: FloatArray
) -> FloatArray:
    """Return mean speeds [km/h] around seconds, from positions of the same piece.

    A piece of a single point has none: NaN.
    """
    first = np.searchsorted(pieces, np.arange(pieces[-1] + 1))
    last = np.append(first[1:], len(pieces)) - 1
    start = np.maximum(second - HALF_WIDTH, time[first[pieces[left]]])
    end = np.minimum(second + HALF_WIDTH, time[last[pieces[left]]])
    # Pieces one after another on a single axis, so that one interpolation serves all.
    lengths = time[last] - time[first]
    offset = np.concatenate([[0.0], np.cumsum(lengths + 1.0)[:-1]]) - time[first]
    axis = time + offset[pieces]
    shift = offset[pieces[left]]
    moved = np.interp(end + shift, axis, position) - np.interp(start + shift, axis, position)
    speed: FloatArray = np.full(len(left), np.nan)
    longer = end > start
    speed[longer] = 3600.0 * moved[longer] / (end - start)[longer]
    return speed
