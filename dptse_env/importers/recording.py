"""One file of trajectories: its points become vehicles at whole seconds, cut into windows.

Points wait on disk in buckets, each with all points of some vehicles, and are read one bucket at a
time. Memory grows with the number of vehicles and of seconds alone.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl

from dptse_env.importers import tables
from dptse_env.importers.placing import OFF, Branches, placed
from dptse_env.importers.resampling import (
    TIME_UNIT,
    check_pieces,
    count_ends,
    earlier,
    steps_back,
    steps_together,
    stretches,
    whole_seconds,
)
from dptse_env.importers.source import Source, TrajectoryError
from dptse_env.importers.units import SAMPLE, check_units, motion
from dptse_env.traffic.record import Record
from dptse_env.utils.validation import cut, inside, integer, non_negative, shown

BUCKET_ROWS = 400_000
"""Rows of a bucket; buckets are in memory one at a time."""
MOST_BUCKETS = 512
MOST_WAITING = 1_000_000
"""Points of all buckets together that wait in memory to be written."""
LONGEST_SILENCE = 600.0
"""Time without any row [s] after which a file is another recording, with windows of its own."""
LONGEST_PAUSE = 30.0
"""Time without any row [s] from which on the report says that the road counts as empty."""
MOST_WINDOWS = 100_000
"""Windows of a file at most; wrong times would otherwise ask for millions."""
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

    def __post_init__(self) -> None:
        """Check the fields."""
        inside("longest_gap", self.longest_gap, 0.0, LONGEST_SILENCE)
        non_negative("skip_start", self.skip_start)
        non_negative("skip_end", self.skip_end)
        integer("pause", self.pause, 0)


@dataclass
class Recording:
    """A file of trajectories, on disk as vehicles at whole seconds.

    Attributes:
        path: The file.
        branches: Those of the road.
        source: What the file means.
        options: How trajectories are cut.
        folder: Where its points wait.
        counts: What happened to its rows and vehicles.
        windows: Its windows in order of time: window (number), group, first (its second 0, counted
            from `base`) and start (as the file counts).
        base: A whole second, from which times are counted.
        shift: What is added to the file's times [s].
        speed_ratio: Given speeds over those that positions say; None without speeds.
        off_names: Names of lanes or edges that are not on the road, some of them.
    """

    path: Path
    branches: Branches
    source: Source
    options: Options
    folder: Path
    counts: Counter[str] = field(default_factory=Counter)
    windows: pl.DataFrame = field(default_factory=pl.DataFrame)
    base: float = 0.0
    shift: float = 0.0
    speed_ratio: float | None = None
    off_names: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Read the file and keep its windows in `folder`.

        Raises:
            TrajectoryError: The file is damaged or does not fit the road, units or direction.
        """
        self._form = tables.FORMATS[self.source.format]
        if self.source.format == "fcd" and self.source.layout.centre_line:
            self._form = tables.FCD_IN_PLANE
        self._units = {**self._form.units, **self.source.units}
        n_buckets = self._spool()
        seconds = self._seconds_of_file()
        self.shift = self._time_shift(seconds)
        coverage = self._cut(seconds)
        self._stretches: list[pl.DataFrame] = []
        self._earlier: list[pl.DataFrame] = []
        pieces = pl.concat([self._take(bucket, coverage) for bucket in range(n_buckets)])
        self._require_one_clock()
        self._require_joined()
        self.speed_ratio = check_pieces(pieces, self.source, self._units, str(self.path))

    def record(self, window: int) -> Record:
        """Return the record of a window."""
        c = pl.col
        rows = pl.scan_parquet(sorted(self.folder.glob("seconds/*.parquet")), glob=False)
        rows = rows.filter(c("window") == window).sort(
            "step", "column", "lane", "position", maintain_order=True
        )
        found = rows.collect()
        found = found.join(_numbers(found), ["id", "piece"], "left", maintain_order="left")
        corridor = self.branches.corridor
        return Record(
            step=found["step"].to_numpy(),
            vehicle=found["number"].to_numpy(),
            segment=found["column"].to_numpy(),
            speed=found["speed"].to_numpy(),
            n_steps=corridor.conditions.duration + 1,
            n_columns=corridor.geometry.n_cells,
        )

    def points(self) -> pl.DataFrame:
        """Return points of the first window on the mainline for a picture, some where many."""
        _, group, _, start = self.windows.row(0)
        time = pl.col("time") + (self.shift - start)
        duration = self.branches.corridor.conditions.duration
        here = (pl.col("branch") == 0) & (pl.col("column") != OFF) & (pl.col("group") == group)
        points = (
            self._points.filter(here, time.is_between(0.0, duration))
            .select(time, "position", "speed")
            .collect(engine="streaming")
        )
        return points.gather_every(1 + len(points) // PICTURE_POINTS)

    def _spool(self) -> int:
        """Place the points of the file and write them to buckets; return the number of these."""
        layout, c = self.source.layout, pl.col
        try:
            points, roles, n_rows = tables.scan(self.path, self._form, self.source)
            sample = points.head(SAMPLE).collect(engine="streaming")
            time_unit = self.source.factor("time", self._form.units["time"])
            if moves := motion(sample, self.source, time_unit):
                check_units(moves, self.source, self._units, str(self.path), whole=False)
            unit = self.source.factor("length", self._form.units["length"])
            n_buckets = min(1 + n_rows // BUCKET_ROWS, MOST_BUCKETS)
            points = placed(points, roles, self.branches, layout, unit).select(
                "row", "time", "vehicle", "position", "speed", "branch", "column", "lane_number",
                "bad", c("group").fill_null(""),
                off=pl.when(c("branch") == OFF).then(pl.coalesce("edge", "lane")),
            )  # fmt: skip
            key = c("vehicle").hash() % n_buckets
            points.sink_parquet(
                pl.PartitionBy(
                    self.folder / "points", key={"bucket": key}, include_key=False,
                    approximate_bytes_per_file=1 << 50,
                ),
                compression="lz4", mkdir=True, engine="streaming",
                row_group_size=min(20_000, MOST_WAITING // n_buckets),
            )  # fmt: skip
        # polars panics on some damaged Parquet files.
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as problem:
            if isinstance(problem.__cause__, TrajectoryError):
                raise problem.__cause__ from None
            parquet = self.path.suffix.lower() in tables.PARQUET
            what = "it is no complete Parquet file: " if parquet else ""
            reason = cut(str(problem).partition("\n")[0])
            what = "it must be text in UTF-8, got " if "invalid utf-8" in reason else what
            raise TrajectoryError(f"{self.path}: {what}{reason}") from problem
        if not (self.folder / "points").is_dir():
            raise TrajectoryError(f"{self.path}: it must have rows of vehicles, got none")
        files = sorted(self.folder.glob("points/*/*.parquet"))
        self._points = pl.scan_parquet(files, glob=False)
        bad = self._points.filter(c("bad").is_not_null()).bottom_k(1, by="row")
        for row, role in bad.select("row", "bad").collect(engine="streaming").rows():
            name, text_of = tables.field_text(self.path, self._form, self.source, row, role)
            point = " with a point" if re.fullmatch(r"'-?\d*,\d*'", text_of) else ""
            raise TrajectoryError(
                f"{self.path}, row {row}: {name} must be a finite number{point}, got {text_of}"
            )
        return n_buckets

    def _seconds_of_file(self) -> pl.DataFrame:
        """Count rows, and return the occupied seconds of each group."""
        c = pl.col
        named, lost, off = c("vehicle").is_not_null(), c("branch") == OFF, c("column") == OFF
        seconds = (
            self._points.filter(c("time").is_finite())
            .group_by("group", second=c("time").floor())
            .agg(
                rows=named.sum(), no_vehicle=named.not_().sum(), off_lanes=(named & lost).sum(),
                off_ends=(named & off & ~lost).sum(), begin=c("time").min(), end=c("time").max(),
                row=c("row").min(),
            )
            .collect(engine="streaming")
        )  # fmt: skip
        wanted = c("group").is_in(tables.codes(self.source.groups) or seconds["group"].implode())
        if seconds["rows"].sum() == 0:
            chosen = " that source.where chooses" if self.source.where else ""
            raise TrajectoryError(f"{self.path}: it must have rows of vehicles{chosen}, got none")
        if seconds.filter(wanted).is_empty():
            raise TrajectoryError(
                f"{self.path}: source.groups must be in the file, got {shown(self.source.groups)}"
            )
        self.counts["rows"] = int(seconds["rows"].sum())
        if not self._form.sumo:  # whose rows without a vehicle tell times
            self.counts["no_vehicle"] = int(seconds["no_vehicle"].sum())
        self.counts["other_group"] = int(seconds.filter(~wanted)["rows"].sum())
        seconds = seconds.filter(wanted)
        for name in ("off_lanes", "off_ends"):
            self.counts[name] = int(seconds[name].sum())
        names = self._points.filter(lost, c("off").is_not_null()).select("off").unique()
        names = names.bottom_k(20, by="off")
        found = names.collect(engine="streaming")["off"].sort()
        self.off_names = [cut(name) for name in found]
        self._require_on_road()
        return seconds

    def _require_on_road(self) -> None:
        counts, names = self.counts, ", ".join(self.off_names)
        if counts["off_lanes"] + counts["off_ends"] + counts["other_group"] < counts["rows"]:
            return
        raise TrajectoryError(
            f"{self.path}: rows must be on the road, got {counts['off_ends']} of {counts['rows']} "
            f"before its start or beyond its end, and {counts['off_lanes']} on other lanes or "
            f"edges{f' (such as {names})' if names else ''} than layout says: "
            f"{self.source.layout.mainline}"
        )

    def _time_shift(self, seconds: pl.DataFrame) -> float:
        """Return what is added to times [s]: SUMO's step, where a file has its beginning."""
        if self.source.time_shift is not None or not self._form.sumo:
            return self.source.time_shift or 0.0
        first = self._points.filter(
            pl.col("time") <= seconds["second"].to_numpy().min() + LONGEST_SILENCE
        )
        distinct = first.select(pl.col("time").unique()).collect(engine="streaming")
        times = distinct["time"].sort()
        if len(times) < 2:
            raise TrajectoryError(
                f"{self.path}: source.time_shift must be given, SUMO's step length [s]: the file "
                "has a single time at its start"
            )
        return float(times[1] - times[0])

    def _require_one_clock(self) -> None:
        """Refuse a file whose time steps back over other vehicles."""
        found, drives_on = pl.concat(self._stretches), pl.concat(self._earlier)
        steps, overlap = steps_back(found)
        self.counts["steps_back"] = len(steps)
        if not overlap:
            steps = steps_together(drives_on, self.options.longest_gap)
            # Else the recording that is first in time comes last in the file.
            first = found.select(pl.col("begin").min()).item()
            overlap = bool(steps) and steps[0][2] > first + self.options.longest_gap
        if overlap:
            row, *times = steps[0]
            before, at = (f"{time + self.base - self.shift:.10g} s" for time in times)
            raise TrajectoryError(
                f"{self.path}, row {row}: the time must not step back into the traffic before, got "
                f"{at} after {before}: put the rows from here on into a file of their own if the "
                "clock was set back or another recording begins, and else sort the rows by time"
            )

    def _require_joined(self) -> None:
        """Refuse a file in which points are mostly too far apart to be trajectories."""
        cut, followed = self.counts["gaps_cut"] + self.counts["jumps_cut"], self.counts["followed"]
        if followed == 0:
            raise TrajectoryError(
                f"{self.path}: an id must be that of a vehicle in several rows on the road, got "
                "none that is: is the column of the vehicle right?"
            )
        if 2 * cut > followed:
            raise TrajectoryError(
                f"{self.path}: points of a vehicle must mostly follow one another within "
                f"{self.options.longest_gap:g} s at less than 300 km/h, got {followed - cut} of "
                f"{followed} that do: are the units (time in {self._units['time']}, length in "
                f"{self._units['length']}) and layout.reversed right?"
            )

    def _cut(self, seconds: pl.DataFrame) -> dict[str, tuple[float, float]]:
        """Lay windows over each group; return its first and last time since `base`.

        A silence parts a group into recordings. Those that are shorter than a window have none.
        """
        c, stride = pl.col, self.branches.corridor.conditions.duration + 1 + self.options.pause
        wait = c("begin") - c("end").shift()
        pauses = wait.is_between(LONGEST_PAUSE, LONGEST_SILENCE).over("group")
        part = (c("second").diff() > LONGEST_SILENCE).fill_null(False).cum_sum().over("group")
        # A simulation that begins at 0 begins with an empty road.
        empty = self._form.sumo and seconds["begin"].min() == 0.0
        seconds = seconds.sort("group", "second")
        self.counts["pauses"] = seconds.select(pauses.sum()).item()
        parts = (
            seconds
            .with_columns(part=part)
            .group_by("group", "part")
            .agg(c("begin").min(), c("end").max() + self.shift, c("rows").sum(), c("row").min())
            .with_columns(begin=pl.when(empty & (c("begin") == 0)).then(0.0).otherwise(
                c("begin") + self.shift))
            .sort("rows", "begin", descending=[True, False])
        )  # fmt: skip
        self.base = float(np.floor(parts["begin"][0]))
        parts = (
            parts.with_columns(
                begin=(c("begin") - self.base).round(4), end=(c("end") - self.base).round(4)
            )
            .with_columns(
                first=(c("begin") + self.options.skip_start).ceil(),
                last=(c("end") - self.options.skip_end).floor(),
            )
            .with_columns(n=(c("last") - c("first") + 1 + self.options.pause) // stride)
        )
        kept, away = parts.filter(c("n") > 0), parts.filter(c("n") <= 0)
        self.counts["far_away"] = int(away["rows"].sum())
        if kept["n"].sum() > MOST_WINDOWS:
            raise TrajectoryError(
                f"{self.path}: its times must make at most {MOST_WINDOWS} windows of {stride} s, "
                f"got {kept['n'].sum():.0f}: is the unit right (time in {self._units['time']})?"
            )
        if kept.is_empty():
            longest = (parts["last"] - parts["first"]).to_numpy().max() + 1
            duration = self.branches.corridor.conditions.duration
            silences = f" between silences of over {LONGEST_SILENCE:g} s" if len(parts) > 1 else ""
            raise TrajectoryError(
                f"{self.path}: it must last {duration + 1} s or more, the "
                f"corridor's duration and a second, got {longest:.0f} s{silences} (time in "
                f"{self._units['time']})"
            )
        if self.counts["far_away"]:
            first = away.row(away["row"].arg_min(), named=True)
            warnings.warn(
                f"{self.path}, row {first['row']}: the time {first['begin'] + self.base:.6g} s is "
                f"over {LONGEST_SILENCE:g} s from all windows: {self.counts['far_away']} such rows "
                "are left out",
                stacklevel=2,
            )
        self.windows = (
            kept.with_columns(place=pl.int_ranges(0, c("n").cast(pl.Int64)))
            .explode("place")
            .with_columns(first=(c("first") + stride * c("place")).cast(pl.Int64))
            .sort("first", c("row").min().over("group"))
            .with_row_index("window")
            .select("window", "group", "first", start=c("first") + self.base)
        )
        ends = kept.group_by("group").agg(c("begin").min(), c("end").max())
        return {group: (low, high) for group, low, high in ends.rows()}

    def _take(self, bucket: int, coverage: dict[str, tuple[float, float]]) -> pl.DataFrame:
        """Write the seconds of a bucket that are in windows; return the pieces of trajectories."""
        c = pl.col
        files = self.folder / "points" / f"bucket={bucket}"
        points = pl.read_parquet(files) if files.is_dir() else self._points.head(0).collect()
        points = points.filter(c("vehicle").is_not_null(), c("group").is_in(list(coverage)))
        time = ((c("time") + self.shift - self.base) / TIME_UNIT).round() * TIME_UNIT
        near = (c("time") - c("time").round()).abs() < 0.1 * TIME_UNIT
        first, last = (
            c("group").replace_strict({group: ends[i] for group, ends in coverage.items()})
            for i in (0, 1)
        )
        points = (
            points.sort("row", maintain_order=True)
            .with_columns(time=time, id=c("row").min().over("group", "vehicle"))
            .with_columns(time=pl.when(near).then(c("time").round()).otherwise("time"))
            .filter(c("column") != OFF, c("time").is_between(first - 1.0, last + 1.0))
        )
        label = c("vehicle").first()
        whole = pl.when(label.str.contains(r"^\d{1,8}$")).then(label).cast(pl.Int64).fill_null(-1)
        labels = points.group_by("id").agg(name=whole)
        points = points.drop("off", "bad")
        self._stretches.append(stretches(points, self.options.longest_gap))
        self._earlier.append(earlier(points, self.options.longest_gap))
        found, pieces = whole_seconds(
            points, self.branches, self.options.longest_gap, self.counts, str(self.path)
        )
        self.counts.update(count_ends(pieces, coverage, self.branches))
        since = (c("second") - c("first")).alias("step")
        found = (
            found.sort("second", maintain_order=True)
            .join_asof(
                self.windows, left_on="second", right_on="first", by="group", check_sortedness=False
            )
            .filter(c("window").is_not_null(), since <= self.branches.corridor.conditions.duration)
            .with_columns(since)
            .join(labels, "id", maintain_order="left")
        )
        folder = self.folder / "seconds"
        folder.mkdir(exist_ok=True)
        found.drop("group", "second", "start", "first").write_parquet(
            folder / f"{bucket}.parquet", row_group_size=50_000
        )
        return pieces


def _numbers(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the number of each vehicle in a record: its id, if ids are small whole numbers.

    Pieces of a cut trajectory are vehicles of their own; those after the first get numbers after
    all others.
    """
    pieces = rows.select("id", "piece", "name").unique().sort("id", "piece")
    name, again = pl.col("name"), pl.col("name").is_first_distinct().not_()
    if len(pieces) and pieces["name"].is_between(0, LARGEST_NUMBER, closed="left").all():
        number = pl.when(again).then(name.max() + again.cum_sum()).otherwise(name)
    else:
        number = pl.int_range(pl.len())
    return pieces.select("id", "piece", number=number.cast(pl.Int32))
