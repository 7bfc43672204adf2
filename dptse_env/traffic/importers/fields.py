"""Import of measured fields: density and speed, or flow, on a grid of space and time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.corridor import Corridor, Recordings
from dptse_env.traffic.demand import Demand
from dptse_env.traffic.imported import save_record, write_manifest
from dptse_env.traffic.importers.folder import ROAD, Split, assign_seeds
from dptse_env.traffic.importers.new_folder import new_folder
from dptse_env.traffic.record import Record, average_dwell
from dptse_env.traffic.road_files import DENSITY_SCALE, write_corridor
from dptse_env.utils.fields import integer, positive, require

FloatTable = NDArray[np.float64]

FEET, MILES = 0.0003048, 1.609344
"""Kilometres."""
DENSITY_UNITS = {"veh/km": 1.0, "veh/mi": 1.0 / MILES, "veh/ft": 1.0 / FEET, "veh/m": 1000.0}
SPEED_UNITS = {"km/h": 1.0, "mi/h": MILES, "m/s": 3.6, "ft/s": 3600.0 * FEET}
FLOW_UNITS = {"veh/h": 1.0, "veh/s": 3600.0, "veh/min": 60.0}
"""Factors to veh/km, km/h and veh/h."""

LEAST_DENSITY = 1e-9
"""Density [veh/km] below which a cell is empty and has no speed of its own."""

FASTEST = 300.0
"""Speed [km/h] above which a field has another unit than stated."""


@dataclass(frozen=True)
class FieldSource:
    """A field in text files with a row for each cell and a column for each interval.

    Attributes:
        density: File of densities.
        speed: File of speeds; or else `flow`.
        flow: File of flows, from which speeds are derived.
        cell: Length of a cell [km].
        interval: Length of an interval [s].
        density_unit: One of `DENSITY_UNITS`; all lanes together.
        speed_unit: One of `SPEED_UNITS`.
        flow_unit: One of `FLOW_UNITS`; all lanes together.
        transposed: Whether rows are intervals.
        reversed: Whether the first cell is the last downstream.
        delimiter: What separates the numbers of a line; None for blanks.
    """

    density: Path
    cell: float
    interval: float
    speed: Path | None = None
    flow: Path | None = None
    density_unit: str = "veh/km"
    speed_unit: str = "km/h"
    flow_unit: str = "veh/h"
    transposed: bool = False
    reversed: bool = False
    delimiter: str | None = None

    def read(self) -> tuple[FloatTable, FloatTable]:
        """Return density [veh/km] and flow [veh/h], of shape (cells, intervals), from upstream on.

        Raises:
            ValueError: A file is no table of numbers, the files do not fit one another, or a unit
                is unknown or not that of the data; the message has the file.
            OSError: A file cannot be read.
        """
        positive("cell", self.cell)
        positive("interval", self.interval)
        require((self.speed is None) != (self.flow is None), "speed", "given, or else flow", None)
        density = self._table(self.density) * _factor(
            "density_unit", self.density_unit, DENSITY_UNITS
        )
        if self.flow is not None:
            path, flow = self.flow, self._table(self.flow)
            flow = flow * _factor("flow_unit", self.flow_unit, FLOW_UNITS)
        else:
            assert self.speed is not None
            path, speed = self.speed, self._table(self.speed)
            speed = speed * _factor("speed_unit", self.speed_unit, SPEED_UNITS)
            flow = density * speed if density.shape == speed.shape else speed
        allowed = f"a table of {self.density}'s shape {density.shape}"
        require(flow.shape == density.shape, str(path), allowed, flow.shape)
        fastest = float((flow / np.maximum(density, LEAST_DENSITY)).max(initial=0.0))
        allowed = f"speeds of at most {FASTEST:g} km/h: check cell, interval and units"
        require(fastest <= FASTEST, str(path), allowed, f"{fastest:.0f} km/h")
        return density, flow

    def _table(self, path: Path) -> FloatTable:
        if path.is_dir():
            raise ValueError(f"{path} must be a file, got a directory")
        try:
            with path.open(encoding="utf-8-sig") as file:
                table = np.loadtxt(file, ndmin=2, delimiter=self.delimiter)
        except (ValueError, UnicodeDecodeError) as problem:
            raise ValueError(f"{path} must be a table of numbers: {problem}") from problem
        require(table.size > 0, str(path), "a table of at least one number", table.shape)
        for row, column in np.argwhere(~(np.isfinite(table) & (table >= 0.0)))[:1]:
            raise ValueError(
                f"{path}: row {row + 1}, column {column + 1} must be finite and >= 0, got "
                f"{table[row, column]}"
            )
        table = table.T if self.transposed else table
        return table[::-1] if self.reversed else table


def _factor(path: str, unit: str, units: dict[str, float]) -> float:
    require(unit in units, path, f"one of {', '.join(units)}", unit)
    return units[unit]


@dataclass(frozen=True)
class FieldRoad:
    """The road of a field, which has no ramps.

    Attributes:
        name: Lower-case letters, digits and hyphens.
        segments: Segments N that are estimated, each of equally many cells; one more at either end
            of the road is the boundary.
        lanes: Lanes.
        speed_limit: Speed limit [km/h].
    """

    name: str
    segments: int
    lanes: int
    speed_limit: float


def import_field(
    source: FieldSource,
    road: FieldRoad,
    output: Path,
    splits: Sequence[Split],
    duration: int = 450,
) -> tuple[Corridor, dict[str, tuple[int, ...]]]:
    """Import a field as records without vehicles, and return its road and its traffic seeds.

    Cells are averaged over segments, density and flow alike, and intervals are interpolated to
    seconds. The field is cut into windows of `duration` seconds, that many and the second 0, which
    do not overlap: each is the record of a traffic seed, the first windows those of the first
    split. The demand of the written road is the mean flow of the first split.

    Args:
        source: The files.
        road: The road.
        output: Folder to create; it appears when it is complete.
        splits: Parts of the windows, in order of time.
        duration: Length of a window [s].

    Raises:
        ValueError: The field or an argument is malformed, there are fewer cells than segments or
            fewer seconds than a window, or the folder exists.
        OSError: A file cannot be read, or the folder not be written.
    """
    integer("duration", duration, 1)
    integer("segments", road.segments, 2)
    density, flow = source.read()
    each = len(density) // (road.segments + 2)
    require(each >= 1, "segments", f"at most {len(density) - 2}", road.segments)
    field = by_second(density, flow, road.segments + 2, source.interval)
    starts = range(0, len(field[0]) - duration, duration + 1)
    allowed = f"below the field's {len(field[0])} s"
    require(len(starts) > 0, "duration", allowed, duration)
    seeds = assign_seeds(splits, len(starts))
    flat = [seed for split in splits for seed in seeds[split.name]]
    bare = _bare(road, each * source.cell, duration)
    # The boundary segments, at both ends, come last in a record.
    order = [*range(1, road.segments + 1), 0, road.segments + 1]
    with new_folder(output) as folder:
        training, flows, sources, digests = [], [], [], {}
        for seed, start in zip(flat, starts, strict=True):
            window = slice(start, start + duration + 1)
            cut = np.stack([table[window][:, order] for table in field], axis=-1)
            record = Record(n_steps=duration + 1, n_columns=len(order), field=cut)
            save_record(folder, seed, bare.record_layout, record)
            digests[seed] = record.digest
            sources.append({"seed": seed, "file": source.density.name, "start": start})
            if seed in seeds[splits[0].name]:
                training.append(record)
                flows.append(cut[:, 0].prod(axis=-1).mean())
        entering = np.mean(flows)
        measured = dataclasses.replace(
            bare,
            demand=Demand(mainline=((0.0, round(float(entering), 1)),)),
            average_dwell=round(average_dwell(bare, training), 3),
        )
        digest = write_manifest(folder, bare.record_layout, digests, sources, "fields")
        written = dataclasses.replace(measured, recordings=Recordings(str(folder), digest))
        comment = "A measured field. Demand and average dwell are those of its training windows."
        write_corridor(folder / ROAD, written, comment=comment)
    final = Recordings(str(output.absolute()), digest)
    return dataclasses.replace(written, recordings=final), seeds


def by_second(
    density: FloatTable, flow: FloatTable, n: int, interval: float
) -> tuple[FloatTable, FloatTable]:
    """Return density and speed of every second of n segments, (seconds, n) each."""
    each = len(density) // n
    tables = (table[: n * each].reshape(n, each, -1).mean(axis=1) for table in (density, flow))
    middles = (np.arange(density.shape[1]) + 0.5) * interval
    seconds = np.arange(0.0, density.shape[1] * interval)
    rho, q = (
        np.column_stack([np.interp(seconds, middles, row) for row in table]) for table in tables
    )
    return rho, q / np.maximum(rho, LEAST_DENSITY)


def _bare(road: FieldRoad, segment_length: float, duration: int) -> Corridor:
    return Corridor(
        name=road.name,
        n_mainline=road.segments,
        on_ramps=(),
        off_ramps=(),
        exit_shares=(),
        demand=Demand(mainline=((0.0, 0.0),)),
        incident=None,
        fixed_sensors=(),
        duration=duration,
        lanes=road.lanes,
        segment_length=segment_length,
        speed_limit=road.speed_limit,
        density_scale=DENSITY_SCALE * road.lanes,
        speed_scale=road.speed_limit,
    )
