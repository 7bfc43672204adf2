"""One file of trajectories: its points become vehicles at whole seconds, cut into windows."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.importers.branches import OFF
from dptse_env.traffic.importers.checks import Checks
from dptse_env.traffic.importers.placing import Placer, part_in_words
from dptse_env.traffic.importers.points import Format, Labels, Points, TrajectoryError
from dptse_env.traffic.importers.resampling import (
    ROW,
    SECOND,
    TIME_UNIT,
    Counts,
    resample,
)
from dptse_env.traffic.importers.source import Source
from dptse_env.traffic.importers.spill import Rows, Spill
from dptse_env.traffic.importers.tables import is_parquet
from dptse_env.traffic.record import Record
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

BUCKET_BYTES = 24e6
"""Bytes of text whose rows fit a bucket; buckets are in memory one at a time."""
MOST_BUCKETS = 512
LARGEST_NUMBER = 10_000
"""Ids of vehicles below it are kept as they are; others are numbered in each window."""
PICTURE_POINTS = 20_000


@dataclass(frozen=True)
class Options:
    """Settings by which trajectories are cut into windows.

    Attributes:
        longest_gap: Longest time without points that is filled by interpolation [s].
        skip_start: Seconds left out at the start of each file.
        skip_end: Seconds left out at its end.
        pause: Seconds left out between two windows.
    """

    longest_gap: float = 3.0
    skip_start: float = 0.0
    skip_end: float = 0.0
    pause: int = 0


@dataclass(frozen=True)
class Window:
    """A window of a file that becomes a record.

    Attributes:
        number: Number of the window in its recording.
        group: Name of its road in the file; empty if there is one.
        start: Time of its second 0, as the file counts [s].
    """

    number: int
    group: str
    start: float


@dataclass
class Recording:
    """A file of trajectories, on disk as vehicles at whole seconds.

    Attributes:
        path: The file.
        counts: What happened to its rows and vehicles.
        windows: Its windows in order of time.
        speed_ratio: Given speeds over those that positions say; NaN without speeds.
        points: Points (`ROW`) of the first window, some of them where they are many.
    """

    path: Path
    corridor: Corridor
    source: Source
    options: Options
    reader: Format
    placer: Placer
    counts: Counts = field(default_factory=Counts)
    checks: Checks = field(default_factory=Checks)
    windows: list[Window] = field(default_factory=list)
    speed_ratio: float = float("nan")
    base: float | None = None
    groups: dict[str, int] = field(default_factory=dict)
    points: Rows = field(default_factory=lambda: np.empty(0, dtype=ROW))
    _vehicles: dict[tuple[int, str], int] = field(default_factory=dict)
    _coverage: list[list[float]] = field(default_factory=list)
    _off_names: set[str] = field(default_factory=set)
    _stride: int = 1

    def read(self, folder: Path) -> None:
        """Read the file and keep its windows in `folder`.

        Raises:
            TrajectoryError: The file is damaged or does not fit the road, units or direction.
        """
        folder.mkdir()
        size = self.path.stat().st_size if self.path.is_file() else 0
        text = size * (5 if is_parquet(self.path) else 8 if self.path.suffix == ".gz" else 1)
        n_buckets = int(min(1 + text // BUCKET_BYTES, MOST_BUCKETS))
        spill = Spill(folder / "points", ROW)
        for points in self.reader.read(self.path, self.source):
            rows = self._take(points)
            spill.append(rows["vehicle"] % n_buckets, rows)
        self._require_points()
        coverage = np.array(self._coverage)
        first = np.ceil(coverage[:, 0] + self.options.skip_start)
        last = np.floor(coverage[:, 1] - self.options.skip_end)
        self._cut(first, last)
        self._seconds = Spill(folder / "seconds", SECOND)
        for bucket in range(n_buckets):
            found, rows = resample(
                spill.take(bucket), self.placer.road, self.options.longest_gap, coverage,
                self.counts, self.checks, str(self.path),
            )  # fmt: skip
            number = self._window_of(found, first)
            inside = number >= 0
            self._seconds.append(number[inside], found[inside])
            self._keep_for_picture(rows, first)
        self._ids = np.array([_whole(name) for _, name in self._vehicles], dtype=np.int64)
        self.checks.require_forward(self.path)
        self.speed_ratio = self.checks.speed_ratio(self.path, self._unit)

    def record(self, window: Window) -> Record:
        """Return the record of a window, which can be taken once."""
        rows = self._seconds.take(window.number)
        step = rows["second"] - round(window.start - (self.base or 0.0))
        order = np.lexsort((rows["position"], rows["lane"], rows["column"], step))
        corridor = self.corridor
        return Record(
            step=step[order],
            vehicle=self._numbers(rows)[order].astype(np.int32),
            segment=rows["column"][order],
            speed=rows["speed"][order].astype(np.float32),
            n_steps=corridor.duration + 1,
            n_columns=corridor.n_segments + corridor.n_boundaries,
        )

    def _take(self, points: Points) -> Rows:
        """Place the points of a chunk; return those that are on the road."""
        if self.base is None and len(points):
            self.base = float(np.floor(points.time.min()))
        time = np.round((points.time - (self.base or 0.0)) / TIME_UNIT) * TIME_UNIT
        time = np.where(np.abs(time - np.round(time)) < 0.1 * TIME_UNIT, np.round(time), time)
        group = self._group_codes(points)
        self.counts.other_group += int((group == OFF).sum())
        for code in np.unique(group[group != OFF]).tolist():
            here, known = time[group == code], self._coverage[code]
            known[:] = min(known[0], here.min()), max(known[1], here.max())
        named = _is_named(points.vehicle)
        self.counts.no_vehicle += int((~named).sum())
        self.counts.rows += int(named.sum())
        keep = named & (group != OFF)
        if not keep.any():
            return np.empty(0, dtype=ROW)
        points, time, group = points.where(keep), time[keep], group[keep]
        placed = self.placer.place(points)
        on = placed.column != OFF
        off_lanes = placed.branch == OFF
        self.counts.off_lanes += int(off_lanes.sum())
        self.counts.off_ends += int((~on & ~off_lanes).sum())
        self._remember_off(points, off_lanes)
        rows = np.empty(int(on.sum()), dtype=ROW)
        rows["time"], rows["group"], rows["row"] = time[on], group[on], points.row[on]
        rows["position"], rows["lane"] = placed.position[on], placed.lane[on]
        rows["branch"], rows["column"] = placed.branch[on], placed.column[on]
        rows["speed"] = np.nan if points.speed is None else points.speed[on]
        rows["vehicle"] = self._vehicle_codes(points.vehicle, group)[on]
        return rows

    def _group_codes(self, points: Points) -> IntArray:
        """Return the number of each point's group, or `OFF` if it is not wanted."""
        labels = points.group or Labels(np.zeros(len(points), dtype=np.int32), ("",))
        present = set(np.unique(labels.codes).tolist())
        wanted = set(map(str, self.source.groups))
        codes = []
        for place, name in enumerate(labels.names):
            if place not in present or (wanted and name not in wanted):
                codes.append(OFF)
                continue
            if name not in self.groups:
                self.groups[name] = len(self.groups)
                self._coverage.append([np.inf, -np.inf])
            codes.append(self.groups[name])
        found: IntArray = np.array(codes, dtype=np.int64)[labels.codes]
        return found

    def _vehicle_codes(self, vehicle: Labels, group: IntArray) -> IntArray:
        """Return a number for each vehicle of each group, from 0 in order of appearance."""
        keys = vehicle.codes.astype(np.int64) * (len(self.groups) + 1) + group
        distinct, place = np.unique(keys, return_inverse=True)
        codes = []
        for key in distinct.tolist():
            name, number = divmod(key, len(self.groups) + 1)
            pair = number, vehicle.names[name]
            codes.append(self._vehicles.setdefault(pair, len(self._vehicles)))
        found: IntArray = np.array(codes, dtype=np.int64)[place]
        return found

    def _remember_off(self, points: Points, off: BoolArray) -> None:
        labels = points.edge or points.lane
        if labels is not None and off.any() and len(self._off_names) < 20:
            self._off_names |= {labels.names[code] for code in np.unique(labels.codes[off])}

    @property
    def off_names(self) -> list[str]:
        """Names of lanes or edges that are not on the road, some of them."""
        return sorted(self._off_names)

    def _require_points(self) -> None:
        counts = self.counts
        if not counts.rows:
            chosen = " that source.where chooses" if self.source.where else ""
            raise TrajectoryError(f"{self.path}: it must have rows of vehicles{chosen}, got none")
        if not self.groups:
            raise TrajectoryError(
                f"{self.path}: source.groups must be in the file, got {self.source.groups}"
            )
        if counts.off_lanes + counts.off_ends + counts.other_group == counts.rows:
            names = f" (such as {', '.join(self.off_names)})" if self.off_names else ""
            raise TrajectoryError(
                f"{self.path}: rows must be on the road, got {counts.off_ends} of {counts.rows} "
                f"before its start or beyond its end, and {counts.off_lanes} on other lanes or "
                f"edges{names} than layout says: {part_in_words(self.source.layout.mainline)}"
            )

    def _cut(self, first: FloatArray, last: FloatArray) -> None:
        """Lay windows over each group, one after another."""
        stride = self.corridor.duration + 1 + self.options.pause
        found = []
        for name, code in self.groups.items():
            n = int((last[code] - first[code] + 1 + self.options.pause) // stride)
            found += [(first[code] + stride * i, code, name) for i in range(max(n, 0))]
        self._numbered: dict[tuple[int, int], int] = {}
        for number, (start, code, name) in enumerate(sorted(found)):
            self._numbered[code, int((start - first[code]) // stride)] = number
            self.windows.append(Window(number, name, float(start) + (self.base or 0.0)))
        if not found:
            raise TrajectoryError(
                f"{self.path}: it must last {self.corridor.duration + 1} s or more, the corridor's "
                f"duration and a second, got {max(last - first) + 1:.0f} s"
            )

    def _window_of(self, found: Rows, first: FloatArray) -> IntArray:
        """Return the number of each row's window, or -1 for a row in none."""
        stride = self.corridor.duration + 1 + self.options.pause
        since = found["second"] - first[found["group"]]
        place, step = np.divmod(since, stride)
        table = np.full((len(first), max(key[1] for key in self._numbered) + 2), -1)
        for place_of_window, window in self._numbered.items():
            table[place_of_window] = window
        place = np.where((place < 0) | (place >= table.shape[1]), table.shape[1] - 1, place)
        number: IntArray = table[found["group"], place.astype(np.int64)]
        return np.where(step <= self.corridor.duration, number, -1)

    def _keep_for_picture(self, rows: Rows, first: FloatArray) -> None:
        code = self.groups[self.windows[0].group]
        start = self.windows[0].start - (self.base or 0.0)
        here = (rows["group"] == code) & (rows["branch"] == 0) & (rows["time"] >= start)
        here &= (rows["time"] <= start + self.corridor.duration) & (rows["row"] % self._stride == 0)
        self.points = np.concatenate([self.points, rows[here]])
        while len(self.points) > PICTURE_POINTS:  # fewer, and evenly so
            self._stride *= 2
            self.points = self.points[self.points["row"] % self._stride == 0]

    def _unit(self, quantity: str) -> str:
        return str(self.source.units.get(quantity, self.reader.units[quantity]))

    def _numbers(self, rows: Rows) -> IntArray:
        """Return the vehicle's number in the record: its id, if ids are small whole numbers.

        Pieces of a cut trajectory are vehicles of their own; those after the first get numbers
        after all others.
        """
        keys = rows["vehicle"].astype(np.int64) << 31 | rows["piece"]
        distinct, place = np.unique(keys, return_inverse=True)
        vehicle = distinct >> 31
        ids = self._ids[vehicle]
        if not len(ids) or ids.min() < 0 or ids.max() >= LARGEST_NUMBER:
            return place
        again = np.concatenate([[False], np.diff(vehicle) == 0])
        ids[again] = ids.max() + 1 + np.arange(int(again.sum()))
        return ids[place]  # type: ignore[no-any-return]


def _whole(name: str) -> int:
    return int(name) if name.isascii() and name.isdecimal() and len(name) < 9 else -1


def _is_named(vehicle: Labels) -> BoolArray:
    named: BoolArray = np.array([name != "" for name in vehicle.names])[vehicle.codes]
    return named
