"""Floating-car data of SUMO (``--fcd-output``): XML, CSV or Parquet.

SUMO writes the state after a step under the time of its beginning, so times are shifted by a step:
a record counts from the empty road. The step is told from the first two times of a file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.parsers import expat

import numpy as np

from dptse_env.traffic.importers.formats import TableFormat
from dptse_env.traffic.importers.points import (
    KMH,
    Labels,
    Points,
    TrajectoryError,
    open_bytes,
    open_error,
    require_numbers,
)
from dptse_env.traffic.importers.source import LENGTHS, Source
from dptse_env.utils.arrays import FloatArray

BLOCK_BYTES = 1 << 20
"""Bytes of XML that are parsed at a time."""

_ON_EDGES = TableFormat(
    columns={
        "time": ("timestep_time",), "vehicle": ("vehicle_id",), "x": ("vehicle_pos",),
        "speed": ("vehicle_speed",), "lane": ("vehicle_lane",),
    },
    units={"time": "s", "length": "m", "speed": "m/s"},
    required=("time", "vehicle", "x", "speed", "lane"),
)  # fmt: skip
_IN_PLANE = replace(
    _ON_EDGES,
    columns={**_ON_EDGES.columns, "x": ("vehicle_x",), "y": ("vehicle_y",)},
    required=("time", "vehicle", "x", "y", "speed"),
)


class FCD:
    """Reads floating-car data; with a centre line by coordinates, else by edges."""

    units = _ON_EDGES.units

    def read(self, path: Path, source: Source) -> Iterator[Points]:
        """Read a file in chunks; errors are those of `TableFormat.read`."""
        in_plane = len(source.layout.centre_line) > 0
        if path.name.lower().removesuffix(".gz").endswith(".xml"):
            chunks = _read_xml(path, ("x", "y") if in_plane else ("pos",))
        else:
            chunks = (_IN_PLANE if in_plane else _ON_EDGES).read(path, source)
        shift = source.time_shift
        for points in chunks:
            if shift is None:
                shift = _step(path, points.time)
                if points.time.min() == 0.0:  # SUMO began here, with an empty road
                    yield _nobody(0.0)
            yield _by_edge(replace(points, time=points.time + shift), in_plane)


def _step(path: Path, times: FloatArray) -> float:
    distinct = np.unique(times)
    if len(distinct) < 2:
        raise TrajectoryError(
            f"{path}: source.time_shift must be given, SUMO's step length [s]: the file has "
            "a single time at its start"
        )
    return float(distinct[1] - distinct[0])


def _by_edge(points: Points, in_plane: bool) -> Points:
    """Part names of lanes, ``edge_lane``, into edge and number of the lane."""
    if points.lane is None:
        return points
    lane = points.lane.mapped(lambda name: name.rpartition("_")[2])
    edge = None if in_plane else points.lane.mapped(lambda name: name.rpartition("_")[0])
    return replace(points, lane=lane, edge=edge)


def _nobody(time: float) -> Points:
    one = np.zeros(1)
    return Points(
        np.zeros(1, dtype=np.int64), one + time, Labels(np.zeros(1, np.int32), ("",)), one
    )


@dataclass
class _Collected:
    """Points that a parser has met, as lists; vehicle "" marks a time step."""

    places: tuple[str, ...]
    time: float = 0.0
    columns: list[list[object]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        self.columns = [[] for _ in range(5 + len(self.places))]

    def take(self, row: int, attributes: dict[str, str]) -> None:
        values = (attributes[name] for name in ("id", "lane", "speed", *self.places))
        for column, value in zip(self.columns, (row, self.time, *values), strict=True):
            column.append(value)

    def take_time(self, row: int, attributes: dict[str, str]) -> None:
        self.time = float(attributes["time"])
        empty = ("", "", "nan", *("nan" for _ in self.places))
        for column, value in zip(self.columns, (row, self.time, *empty), strict=True):
            column.append(value)


def _read_xml(path: Path, places: tuple[str, ...]) -> Iterator[Points]:
    problem = open_error(path)
    if problem is not None:
        raise problem
    parser, collected = expat.ParserCreate(), _Collected(places)

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "vehicle":
            collected.take(parser.CurrentLineNumber, attributes)
        elif tag == "timestep":
            collected.take_time(parser.CurrentLineNumber, attributes)

    parser.StartElementHandler = start
    try:
        with open_bytes(path) as file:
            while block := file.read(BLOCK_BYTES):
                parser.Parse(block, False)
                if collected.columns[0]:
                    yield _points(path, collected)
            parser.Parse(b"", True)
    except KeyError as missing:
        raise TrajectoryError(
            f"{path}, row {parser.CurrentLineNumber}: a vehicle must have the attributes id, lane, "
            f"speed, {', '.join(places)}; {missing} is missing"
        ) from missing
    except (expat.ExpatError, EOFError, OSError, ValueError) as broken:
        if isinstance(broken, TrajectoryError):
            raise
        raise TrajectoryError(
            f"{path}, row {parser.CurrentLineNumber}: it is no complete XML file: {broken}"
        ) from broken


def _points(path: Path, collected: _Collected) -> Points:
    """Return the collected points, and forget them."""
    row, time, vehicle, lane, speed, *places = collected.columns
    names = collected.places
    collected.clear()
    rows = np.array(row, dtype=np.int64)
    vehicles, lanes = _labels(vehicle), _labels(lane)
    filled = np.array([name != "" for name in vehicles.names])[vehicles.codes]
    numbers = {}
    for name, texts in zip(("speed", *names), (speed, *places), strict=True):
        try:
            numbers[name] = np.array(texts, dtype=np.float64)
        except ValueError as problem:
            raise TrajectoryError(
                f"{path}, row {rows[0]} and after: {name}: {problem}"
            ) from problem
        require_numbers(path, rows[filled], name, numbers[name][filled])
    return Points(
        row=rows,
        time=np.array(time, dtype=np.float64),
        vehicle=vehicles,
        x=LENGTHS["m"] * numbers[names[0]],
        y=LENGTHS["m"] * numbers["y"] if "y" in names else None,
        speed=KMH * numbers["speed"],
        lane=lanes,
    )


def _labels(names: list[object]) -> Labels:
    numbers: dict[str, int] = {}
    codes = [numbers.setdefault(str(name), len(numbers)) for name in names]
    return Labels(np.array(codes, dtype=np.int32), tuple(numbers))
