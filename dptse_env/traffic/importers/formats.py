"""Formats of tables: which column is what, in which unit, and what a format needs beside that."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from dptse_env.traffic.importers.points import (
    Labels,
    Points,
    TrajectoryError,
    require_numbers,
)
from dptse_env.traffic.importers.source import Source
from dptse_env.traffic.importers.tables import Chunk, column_names, normalised, read_table
from dptse_env.utils.arrays import BoolArray

NUMBERS = ("time", "x", "y", "speed", "extent")
LABELS = ("vehicle", "lane", "edge", "group")


@dataclass(frozen=True)
class TableFormat:
    """A table of trajectories.

    Attributes:
        columns: names that a column may have, by role; compared without regard to case and ``-``.
        units: unit by quantity.
        required: roles that must be there; others are read where they are.
        text_columns: columns of the same table as a text without header.
        adjust: changes the points of a chunk, given the file, the source and the chunk.
    """

    columns: Mapping[str, tuple[str, ...]]
    units: Mapping[str, str]
    required: tuple[str, ...] = ("time", "vehicle", "x")
    text_columns: tuple[str, ...] = ()
    adjust: Callable[[Path, Source, Chunk, Points], Points] | None = field(default=None)

    def read(self, path: Path, source: Source) -> Iterator[Points]:
        """Read a file in chunks.

        Raises:
            TrajectoryError: The file is damaged, columns are missing, or a field is no number.
        """
        found = column_names(path, self.text_columns)
        by_name = {normalised(name): name for name in found}
        roles = self._roles(path, source, by_name)
        conditions = {
            f"where {name}": _required(path, by_name, name, "source.where") for name in source.where
        }
        numbers = {role: name for role, name in roles.items() if role in NUMBERS}
        labels = {role: name for role, name in roles.items() if role in LABELS}
        for chunk in read_table(path, numbers, {**labels, **conditions}, self.text_columns):
            keep = np.ones(len(chunk.row), dtype=bool)
            # Rows without a vehicle tell times alone, see below.
            nobody = ~_filled(chunk.labels["vehicle"])
            for name, value in source.where.items():
                keep &= nobody | _equals(chunk.labels[f"where {name}"], value)
            points = self._points(path, source, roles, chunk, keep)
            yield points if self.adjust is None else self.adjust(path, source, chunk, points)

    def _roles(self, path: Path, source: Source, by_name: Mapping[str, str]) -> dict[str, str]:
        """Return the file's column of each role that it has."""
        roles = {
            role: _required(path, by_name, name, f"source.columns.{role}")
            for role, name in source.columns.items()
        }
        missing = []
        for role, names in self.columns.items():
            present = [by_name[name] for name in map(normalised, names) if name in by_name]
            if present:
                roles.setdefault(role, present[0])
            elif role in self.required and role not in roles:
                missing.append(" or ".join(names))
        missing += [f"one for {r}" for r in self.required if r not in (*roles, *self.columns)]
        if missing:
            raise TrajectoryError(
                f"{path}: columns must be {', '.join(missing)} among others, found "
                f"{', '.join(by_name.values())}"
            )
        return roles

    def _points(
        self, path: Path, source: Source, roles: Mapping[str, str], chunk: Chunk, keep: BoolArray
    ) -> Points:
        length = source.factor("length", self.units["length"])
        factors = {
            "time": source.factor("time", self.units["time"]),
            "speed": source.factor("speed", self.units["speed"]),
        }
        row = chunk.row[keep]
        columns = {}
        for role, values in chunk.numbers.items():
            kept = values[keep]
            # What has no vehicle is no point: FCD has such rows for seconds without vehicles.
            of_vehicles = _filled(chunk.labels["vehicle"])[keep]
            require_numbers(path, row[of_vehicles], roles[role], kept[of_vehicles])
            columns[role] = kept * factors.get(role, length)
        labels = {
            role: Labels(values.codes[keep], values.names)
            for role, values in chunk.labels.items()
            if role in LABELS
        }
        extent = columns.pop("extent", None)
        points = Points(row=row, **columns, **labels)  # type: ignore[arg-type]
        if extent is not None:
            points = replace(points, x=points.x + extent)
        return points


def _required(path: Path, by_name: Mapping[str, str], name: str, option: str) -> str:
    if normalised(name) not in by_name:
        raise TrajectoryError(
            f"{path}: {option} must be a column of the file, got {name!r}; found "
            f"{', '.join(by_name.values())}"
        )
    return by_name[normalised(name)]


def _equals(labels: Labels, value: object) -> BoolArray:
    """Return flags of the rows that have a value, or one of several, as text or as a number."""

    def same(name: str, value: object) -> bool:
        try:
            return name == str(value) or float(name) == float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            return False

    values = value if isinstance(value, list | tuple) else [value]
    chosen = np.array([any(same(name, each) for each in values) for name in labels.names])
    kept: BoolArray = chosen[labels.codes]
    return kept


def _filled(labels: Labels) -> BoolArray:
    filled: BoolArray = np.array([name != "" for name in labels.names])[labels.codes]
    return filled


# -- formats ---------------------------------------------------------------------------------------

NGSIM_COLUMNS = (
    "Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time", "Local_X", "Local_Y", "Global_X",
    "Global_Y", "v_Length", "v_Width", "v_Class", "v_Vel", "v_Acc", "Lane_ID", "Preceding",
    "Following", "Space_Headway", "Time_Headway",
)  # fmt: skip
"""The 18 columns of the text files; the portal's CSV has these names in a header, and some more."""

NGSIM = TableFormat(
    columns={
        "time": ("Global_Time",), "vehicle": ("Vehicle_ID",), "x": ("Local_Y",), "y": ("Local_X",),
        "speed": ("v_Vel",), "lane": ("Lane_ID",),
    },
    units={"time": "ms", "length": "ft", "speed": "ft/s"},
    required=("time", "vehicle", "x", "y", "speed", "lane"),
    text_columns=NGSIM_COLUMNS,
)  # fmt: skip

TABLE = TableFormat(columns={}, units={"time": "s", "length": "m", "speed": "m/s"})

TGSIM = TableFormat(
    columns={
        "time": ("time",), "vehicle": ("id",), "x": ("xloc-kf",), "y": ("yloc-kf",),
        "speed": ("speed-kf",), "lane": ("lane-kf",), "group": ("run-index",),
    },
    units={"time": "s", "length": "m", "speed": "m/s"},
    required=("time", "vehicle", "x", "y", "speed"),
)  # fmt: skip


def _first_lanelet(_path: Path, _source: Source, _chunk: Chunk, points: Points) -> Points:
    """Take the first of the lanelets that overlap where a vehicle is, separated by semicolons."""
    if points.lane is None:
        return points
    return replace(points, lane=points.lane.mapped(lambda name: name.partition(";")[0]))


EXID = TableFormat(
    columns={
        "time": ("frame",), "vehicle": ("trackId",), "x": ("xCenter",), "y": ("yCenter",),
        "speed": ("lonVelocity",), "lane": ("laneletId",), "group": ("recordingId",),
    },
    units={"time": "frame", "length": "m", "speed": "m/s"},
    required=("time", "vehicle", "x", "y", "speed", "lane"),
    adjust=_first_lanelet,
)  # fmt: skip


def _by_direction(path: Path, source: Source, chunk: Chunk, points: Points) -> Points:
    """Turn the front of each vehicle into a position in its direction of travel."""
    directions = _highd_directions(path)
    unknown = [name for name in points.vehicle.names if name and name not in directions]
    if unknown:
        raise TrajectoryError(
            f"{path}: vehicle {unknown[0]} is not in {_meta_path(path)}, which has its direction"
        )
    upper = np.array([directions.get(name) == "1" for name in points.vehicle.names])
    against = upper[points.vehicle.codes]
    length = source.factor("length", "m")
    wanted = not source.groups or "upper" in source.groups
    if wanted and against.any() and source.layout.extent is None:
        raise TrajectoryError(
            f"{path}: layout.extent must be given, the length of the picture in the file's unit, "
            "for the vehicles that move to the left (drivingDirection 1), or source.groups be "
            "['lower']"
        )
    # x is the left corner of the box: the rear of those that move to the right.
    corner = chunk.numbers["x"][np.isin(chunk.row, points.row)] * length
    extent = (source.layout.extent or 0.0) * length
    names = ("upper", "lower")
    group = Labels(np.where(against, 0, 1).astype(np.int32), names)
    speed = None if points.speed is None else np.abs(points.speed)
    return replace(points, x=np.where(against, extent - corner, points.x), speed=speed, group=group)


def _meta_path(path: Path) -> Path:
    return path.with_name(path.name.replace("_tracks.", "_tracksMeta."))


@lru_cache(maxsize=4)
def _highd_directions(path: Path) -> dict[str, str]:
    """Return the driving direction of each vehicle, from the file beside the tracks."""
    meta = _meta_path(path)
    try:
        with meta.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file))
        return {row["id"]: row["drivingDirection"] for row in rows}
    except (OSError, KeyError, UnicodeDecodeError) as problem:
        raise TrajectoryError(
            f"{path}: the driving directions must be in {meta} (columns id, drivingDirection), "
            f"got {problem!r}"
        ) from problem


HIGHD = TableFormat(
    columns={
        "time": ("frame",), "vehicle": ("id",), "x": ("x",), "y": ("y",), "extent": ("width",),
        "speed": ("xVelocity",), "lane": ("laneId",),
    },
    units={"time": "frame", "length": "m", "speed": "m/s"},
    required=("time", "vehicle", "x", "extent", "speed", "lane"),
    adjust=_by_direction,
)  # fmt: skip
