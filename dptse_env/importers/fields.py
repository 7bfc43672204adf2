"""Import of measured fields: density and speed, or flow, on a grid of space and time."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dptse_env.geometry import SHORTEST_SEGMENT, Geometry
from dptse_env.importers.folder import (
    ROAD,
    Split,
    assign_seeds,
    moved,
    named_after,
    new_folder,
    require_new,
)
from dptse_env.importers.measured import with_measured
from dptse_env.importers.source import LENGTHS, SPEEDS, TIMES
from dptse_env.importers.units import odd_unit
from dptse_env.traffic.corridor import Conditions, Corridor, Scales
from dptse_env.traffic.demand import Demand
from dptse_env.traffic.imported import ranges, save_records
from dptse_env.traffic.record import Record
from dptse_env.traffic.roads import write_corridor
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import (
    Interval,
    cut,
    integer,
    non_negative,
    number,
    positive,
    require,
    require_name,
)

UNITS = {
    "density": {f"veh/{name}": 1.0 / LENGTHS[name] for name in ("km", "mi", "ft", "m")},
    "speed": SPEEDS,
    "flow": {f"veh/{name}": HOUR / factor for name, factor in TIMES.items() if factor >= 1.0},
}
"""Factors to veh/km, km/h and veh/h."""
USUAL = {"density": "veh/km", "speed": "km/h", "flow": "veh/h"}
"""Units where none is given."""
VACANT = 1e-9
"""Density [veh/km] below which a cell is empty and has no speed of its own."""
FULL, LIGHT, EMPTY = 200.0, 10.0, 0.1
"""Densities of a lane [veh/km]: bumper to bumper, so light that vehicles drive freely, and so
light that a speed says nothing."""
BUSIEST = 4000.0
"""Flow of a lane [veh/h] that none exceeds."""
FEW_ABOVE, SOME_ABOVE = 200.0, 5.0
"""Speeds [km/h] that few exceed, and that some do."""
FEW = 0.01
"""Share of the cells that noise may put beyond these limits; more are a sign of another unit."""
SLOW = 0.4
"""Share of the limit that vehicles exceed where they drive freely."""
BLOCK_TIME = 10.0
"""Time [s] over which vehicles that enter must stay or leave."""
SURE, SURER = 0.65, 0.15
"""Least conservation of vehicles in a field, and least lead over that with rows and columns
swapped: 0.75 to 0.9 and 0.0 to 0.55 were seen in measured and simulated traffic."""
FEWEST_BLOCKS = 30
"""Blocks that this takes at least."""
MOST_MISSED, MOST_UNSEEN, NEAR = 20.0, 8.0, 0.2
"""Least number of vehicles that passed an empty cell if its sensor was off, and least sum of
those that were in it in each interval, since a few may pass between two looks; and the length of
road [km] on a side, of one cell at least, whose traffic shows that."""
USUAL_SHARE = 0.5
"""Share of the flow at other times that they must have where they are on one side alone."""
LARGEST_NUMBER = 1e6
"""Largest number in a file, in its unit."""
LONGEST_FIELD = 31 * 86_400
"""Longest time that a field covers [s]."""


@dataclass(frozen=True)
class FieldSource:
    """A field in text files with a row for each cell and a column for each interval.

    A missing value is ``nan``, or nothing between two delimiters. An empty cell needs no speed;
    zeros in both files are missing values where they are in all cells of an interval or in all
    intervals of a cell, and so are densities of 0 where vehicles must have passed: sensors were
    off.

    Attributes:
        density: File of densities.
        speed: File of speeds; or else `flow`.
        flow: File of flows, from which speeds are derived.
        cell: Length of a cell [km].
        interval: Length of an interval [s].
        density_unit: Unit of densities, all lanes together; veh/km if not given.
        speed_unit: Unit of speeds; km/h if not given.
        flow_unit: Unit of flows, all lanes together; veh/h if not given.
        transposed: Whether rows are intervals.
        reversed: Whether the first cell is the last downstream.
        delimiter: What separates the numbers of a line; None for blanks.
        longest_gap: Longest time without a value that is filled by interpolation [s].
    """

    density: Path
    cell: float
    interval: float
    speed: Path | None = None
    flow: Path | None = None
    density_unit: str | None = None
    speed_unit: str | None = None
    flow_unit: str | None = None
    transposed: bool = False
    reversed: bool = False
    delimiter: str | None = None
    longest_gap: float = 60.0

    def read(self, lanes: int, speed_limit: float) -> tuple[FloatArray, FloatArray]:
        """Return density [veh/km] and flow [veh/h], of shape (cells, intervals), from upstream on.

        Args:
            lanes: Lanes of the road.
            speed_limit: Its speed limit [km/h].

        Raises:
            ValueError: A file is no table of numbers alone or has a long gap, the files do not fit
                one another, or a unit is unknown, or not given and not that of the data; the
                message has the file, and the units that the data may have.
            OSError: A file cannot be read.

        Warns:
            UserWarning: Gaps were filled; the road is empty at times, or stands where vehicles must
                have passed; vehicles are conserved only if rows are intervals or cells in the other
                order; data are odd in the unit that is given, or all speeds are low, which
                congestion may explain, or another unit.
        """
        number(float, self.cell, "cell", Interval(0.001, 10))
        number(float, self.interval, "interval", Interval(0.01, 3600))
        integer("lanes", lanes, 1)
        positive("speed_limit", speed_limit)
        require((self.speed is None) != (self.flow is None), "speed", "given, or else flow", None)
        non_negative("longest_gap", self.longest_gap)
        density = self._table("density")
        kind = "speed" if self.flow is None else "flow"
        path, other = getattr(self, kind), self._table(kind)
        is_same = density.shape == other.shape and (density == other).all()
        require(not is_same, str(path), f"of other values than {self.density}", "the same")
        allowed = f"a table of {self.density}'s shape {density.shape}"
        require(other.shape == density.shape, str(path), allowed, other.shape)
        for words, line, same in (
            ("row 1", density[0, 1:], other[0, 1:]), ("column 1", density[1:, 0], other[1:, 0]),
        ):  # fmt: skip
            steps = np.sign(np.diff(line))
            if len(steps) > 1 and abs(steps.sum()) == len(steps) and (line == same).all():
                first = ", ".join(f"{each:g}" for each in line[:3])
                raise ValueError(
                    f"{self.density}: {words} must be values, got a header or an index, {first}, "
                    f"..., as in {path}: leave it out"
                )
        density, other = self._turned("density", density), self._turned(kind, other)
        flow = density * other if kind == "speed" else other
        off = self._off(density, other, flow)
        stand = self._passed((other == 0.0) & (density > 0.0), density, flow, sides=2)
        empty = ((density == 0.0) & ~np.isnan(other) & ~off).all(axis=0)
        other = np.where(np.isnan(other) & (density == 0.0), 0.0, other)
        density[off] = other[off] = np.nan
        density, other = (
            self._filled(*each, off) for each in (("density", density), (kind, other))
        )
        for columns, told in (
            (off.any(axis=0), f"sensors were off: {off.sum()} zeros are gaps"),
            (
                stand.any(axis=0),
                f"{path} is 0 where vehicles are and must have passed: is it right?",
            ),
            (empty, "the road is empty, as all densities are 0"),
        ):
            if columns.any():
                warnings.warn(
                    f"{self.density}: in {self._names[1]}(s) "
                    f"{ranges(np.flatnonzero(columns) + 1)}, {told}",
                    stacklevel=3,
                )
        lasts = density.shape[1] * self.interval
        allowed = f"a field of at most {LONGEST_FIELD} s, at {self.interval:g} s a column"
        require(lasts <= LONGEST_FIELD, str(self.density), allowed, f"{lasts:g} s")
        self._check_unit("density", lambda factor: _odd_density(factor * density, lanes))
        occupied = density > EMPTY * lanes
        speed = (other if kind == "speed" else other / np.maximum(density, VACANT))[occupied]
        light = speed[density[occupied] < LIGHT * lanes]
        self._check_unit(kind, lambda f: _odd_speed(f * speed, f * light, speed_limit))
        self._check_values(density, other, lanes)
        flow = density * other if kind == "speed" else other
        most = BUSIEST * lanes
        if (flow > most).mean() > FEW:
            raise ValueError(
                f"{path}: flow must be at most {most:g} veh/h on {lanes} lanes: check the units "
                f"and lanes, got {flow.max():.4g} veh/h"
            )
        if speed.size and speed.max() < SLOW * speed_limit:
            warnings.warn(
                f"no speed of the field is above {speed.max():.0f} km/h, at a limit of "
                f"{speed_limit:g} km/h: is speed_unit or flow_unit right?",
                stacklevel=3,
            )
        kept, turned = (
            _conservation(*each, self.cell, self.interval)
            for each in ((density, flow), (density.T, flow.T))
        )
        turn = "reversed" if kept < -SURE else ""
        if abs(turned) > SURE and not abs(kept) > abs(turned) - SURER:
            turn = "transposed"
        if turn:
            warnings.warn(
                f"{self.density}: vehicles that flow into a cell must stay or flow out, and do not "
                f"in this field: should {turn} be turned round?",
                stacklevel=3,
            )
        return density, flow

    def cells_of(self, segments: int, cells: int) -> int:
        """Return how many of the cells make one of `segments` + 2 segments.

        Raises:
            ValueError: There are too few cells, or segments would be too short.
        """
        each = cells // (segments + 2)
        fewest = max(1, math.ceil(round(SHORTEST_SEGMENT / self.cell, 9)))
        enough = f"a table of at least {4 * fewest} cells, for segments and both ends of a road"
        require(cells >= 4 * fewest, str(self.density), enough, cells)
        allowed = (
            f"at most {cells // fewest - 2}, on {cells} cells of {self.cell:g} km, for segments of "
            f"{SHORTEST_SEGMENT:g} km or more"
        )
        require(each >= fewest, "segments", allowed, segments)
        return each

    def _check_unit(self, kind: str, odd: Callable[[float], str | None]) -> None:
        """Refuse data that are odd in a unit that nobody gave; see `odd_unit`.

        Args:
            kind: Of the data.
            odd: What is odd about the data times a factor, or None.
        """
        problem, given = odd(1.0), getattr(self, f"{kind}_unit")
        if problem is not None:
            likely = [name for name, factor in UNITS[kind].items() if odd(factor) is None]
            unit, where = given or USUAL[kind], str(getattr(self, kind))
            odd_unit(where, f"{kind}_unit", unit, given is not None, likely, problem)

    def _check_values(self, density: FloatArray, other: FloatArray, lanes: int) -> None:
        """Refuse a few values that no road can have, and tell of a number that may be a sign.

        Tables are of shape (cells, intervals). A speed where nobody is counts for nothing.
        """
        fastest = self.speed, 2.0 * FEW_ABOVE, "km/h", other * (density > 0.0)
        busiest = self.flow, 2.0 * lanes * max(BUSIEST, HOUR / self.interval), "veh/h", other
        fullest = self.density, 2.0 * lanes * max(FULL, 1.0 / self.cell), "veh/km", density
        for path, most, unit, table in (fullest, fastest if self.speed else busiest):
            beyond = table > most
            if 0.0 < beyond.mean() <= FEW:
                cell, interval = np.argwhere(beyond)[0]
                raise ValueError(
                    f"{path}: {self._line(cell, table)}, {self._names[1]} {interval + 1} must be "
                    f"at most {most:g} {unit}, or nan where it is missing, got "
                    f"{table[cell, interval]:.6g}"
                )
            values, counts = np.unique(table, return_counts=True)
            if len(values) > 2 and counts[-1] > 2 and values[-1] > 2.0 * values[-2]:
                warnings.warn(
                    f"{path}: {counts[-1]} values are {values[-1]:.6g} {unit}, and no other is "
                    f"above {values[-2]:.6g}: let them be nan if they are missing",
                    stacklevel=4,
                )

    def _off(self, density: FloatArray, other: FloatArray, flow: FloatArray) -> BoolArray:
        """Return where sensors were off, shape (cells, intervals): zeros that cannot be."""
        zero = (density == 0.0) & (other == 0.0)
        off: BoolArray = zero & (zero.all(axis=0) | zero.all(axis=1, keepdims=True))
        return off | self._passed((density == 0.0) & ~np.isnan(other) & ~off, density, flow)

    def _passed(
        self, still: BoolArray, density: FloatArray, flow: FloatArray, sides: int = 1
    ) -> BoolArray:
        """Return which runs of `still`, shape (cells, intervals), vehicles must have passed.

        They passed cells upstream or downstream, those with traffic at that time, and were not held
        between: more did than the vehicles there changed by, on both sides. Where one side has no
        such cell, and `sides` is 1, the other must have its usual flow, and not that of a ramp.
        """
        found = np.zeros_like(still)
        density, flow = np.nan_to_num(density), np.nan_to_num(flow) * self.interval / HOUR
        moving = (density > 0.0) & (flow > 0.0)
        at_most = np.append(0.0, flow.max(axis=0).cumsum())
        for cell in np.flatnonzero(still.any(axis=1)):
            moves = ~still[cell]
            for start, stop in _runs(still[cell]):
                if at_most[stop] - at_most[start] <= MOST_MISSED:
                    continue
                missed, usual = [], True
                for side in (np.arange(cell)[::-1], np.arange(cell + 1, len(flow))):
                    near = side[moving[side, start:stop].any(axis=1)]
                    near = near[self.cell * abs(near - near[:1]) < NEAR]
                    if not len(near):
                        continue
                    past, there = flow[near, start:stop], self.cell * density[near]
                    held = np.ptp(there[:, max(start - 1, 0) : stop + 1].cumsum(axis=0), axis=1)
                    seen = there[:, start:stop].sum(axis=1).mean()
                    missed.append(
                        (past.sum(axis=1) - held).mean() > MOST_MISSED and seen > MOST_UNSEEN
                    )
                    at_other_times = flow[near].sum(where=moves) / max(moves.sum(), 1)
                    usual = past.sum() / (stop - start) > USUAL_SHARE * at_other_times
                told = len(missed) >= sides and all(missed)
                found[cell, start:stop] = told and (usual or len(missed) == 2)
        return found

    def _filled(self, kind: str, table: FloatArray, off: BoolArray) -> FloatArray:
        """Return a table (cells, intervals) whose gaps in time are filled, or refuse long ones."""
        missing = np.isnan(table)
        if not missing.any():
            return table
        path, most = getattr(self, kind), max(1, int(self.longest_gap // self.interval))
        table = table.copy()
        columns = np.arange(table.shape[1])
        for cell in np.flatnonzero(missing.any(axis=1)):
            for start, stop in _runs(missing[cell]):
                if stop - start > min(most, table.shape[1] - 1):
                    raise ValueError(self._gap(path, int(cell), start, stop, off))
            known = ~missing[cell]
            table[cell] = np.interp(columns, columns[known], table[cell, known])
        if given := int((missing & ~off).sum()):
            warnings.warn(
                f"{path}: {given} of {missing.size} values are missing, and interpolated in time; "
                f"no gap is longer than {most} interval(s)",
                stacklevel=4,
            )
        return table

    def _gap(self, path: Path, cell: int, start: int, stop: int, off: BoolArray) -> str:
        """Return what is wrong with a gap, in rows and columns of the file."""
        line = self._line(cell, off)
        told = " but zeros, as of sensors that are off (an empty cell has a speed or flow of nan)"
        told = told if off[cell, start:stop].any() else ""
        if stop - start == off.shape[1]:
            return (
                f"{path}: {line} must have values, got none{told}: leave out cells without a "
                "sensor, in all files, or fill them"
            )
        return (
            f"{path}: {line} must have a value every {self.longest_gap:g} s, got none from "
            f"{self._names[1]} {start + 1} to {stop}{told}: fill them, leave this time out in all "
            f"files, or let longest_gap be {self.interval * (stop - start):g} s or more"
        )

    @property
    def _names(self) -> tuple[str, str]:
        """Names of a cell and of an interval in the files."""
        return ("column", "row") if self.transposed else ("row", "column")

    def _line(self, cell: int, table: AnyArray) -> str:
        """Return the place of a cell in the files, given a table of them from upstream on."""
        return f"{self._names[0]} {len(table) - cell if self.reversed else cell + 1}"

    def _table(self, kind: str) -> FloatArray:
        path, unit = getattr(self, kind), getattr(self, f"{kind}_unit")
        require_name(f"{kind}_unit", USUAL[kind] if unit is None else unit, UNITS[kind])
        is_one = self.delimiter is None or len(self.delimiter) == 1
        require(is_one, "delimiter", "a character, or left out for blanks and tabs", self.delimiter)
        if path.is_dir():
            raise ValueError(f"{path} must be a file, got a directory")
        try:
            with path.open(encoding="utf-8-sig") as file:
                table = np.loadtxt(
                    file, ndmin=2, delimiter=self.delimiter, converters=_number_or_nan
                )
        except (ValueError, TypeError) as problem:
            by = "blanks" if self.delimiter is None else repr(self.delimiter)
            allowed = f"a table of numbers, with {by} between them, without header and names"
            raise ValueError(f"{path} must be {allowed}: {cut(problem)}") from problem
        require(table.size > 0, str(path), "a table of at least one number", table.shape)
        for row, column in np.argwhere((table < 0.0) | (table > LARGEST_NUMBER))[:1]:
            raise ValueError(
                f"{path}: row {row + 1}, column {column + 1} must be in [0, {LARGEST_NUMBER:g}], "
                f"or nan where it is missing, got {table[row, column]}"
            )
        return table

    def _turned(self, kind: str, table: FloatArray) -> FloatArray:
        """Return a table in the usual unit, of shape (cells, intervals), from upstream on."""
        unit = getattr(self, f"{kind}_unit") or USUAL[kind]
        table = UNITS[kind][unit] * (table.T if self.transposed else table)
        return table[::-1] if self.reversed else table


def _number_or_nan(text: str) -> float:
    return float(text) if text.strip() else np.nan


def _runs(where: BoolArray) -> list[list[int]]:
    """Return the start of each run of True, and the place after its end."""
    edges = np.flatnonzero(np.diff(where, prepend=False, append=False))
    runs: list[list[int]] = edges.reshape(-1, 2).tolist()
    return runs


def _conservation(density: FloatArray, flow: FloatArray, cell: float, interval: float) -> float:
    """Return how far what enters blocks of a field stays or leaves: 1 if all; NaN if unknown.

    Blocks are as long as half the way that vehicles drive in their time.
    """
    j = math.ceil(BLOCK_TIME / interval)
    speed = flow.sum() / max(density.sum(), VACANT)
    i = max(1, math.ceil(speed * j * interval / 7200.0 / cell))
    c, t = len(density) // i, density.shape[1] // j
    if c < 3 or t < 3 or (c - 2) * (t - 2) < FEWEST_BLOCKS:
        return math.nan
    k, q = (
        each[: c * i, : t * j].reshape(c, i, t, j).mean(axis=(1, 3)) for each in (density, flow)
    )
    stays = HOUR * (k[1:-1, 2:] - k[1:-1, :-2]) / (j * interval)
    leaves = (q[2:, 1:-1] - q[:-2, 1:-1]) / (i * cell)
    all_changes = stays.var() + leaves.var()
    if all_changes == 0.0:
        return math.nan
    return float(1.0 - (stays + leaves).var() / all_changes)


def _odd_density(density: FloatArray, lanes: int) -> str | None:
    """Return what says that densities [veh/km] are of another unit."""
    above = float((density > FULL * lanes).mean())
    if above > FEW:
        return f"{100 * above:.0f} % of cells are above {FULL * lanes:g} veh/km, full of vehicles"
    largest = float(density.max())
    return None if largest >= 1.0 else f"no density is above {largest:.2g} veh/km"


def _odd_speed(speed: FloatArray, light: FloatArray, speed_limit: float) -> str | None:
    """Return what says that speeds [km/h], or those in light traffic, are of another unit."""
    above = float((speed > FEW_ABOVE).mean()) if speed.size else 0.0
    if above > FEW:
        return f"{100 * above:.0f} % of speeds are above {FEW_ABOVE:g} km/h"
    if speed.size and speed.max() < SOME_ABOVE:
        return f"no speed is above {speed.max():.2g} km/h"
    usual = float(np.median(light)) if light.size > FEW * speed.size else speed_limit
    if usual >= SLOW * speed_limit:
        return None
    return f"speeds are {usual:.2g} km/h in light traffic, at a limit of {speed_limit:g} km/h"


@dataclass(frozen=True)
class FieldRoad:
    """The road of a field, which has no ramps.

    Attributes:
        segments: Segments N that are estimated, each of equally many cells; one more at either end
            of the road is the boundary.
        lanes: Lanes.
        speed_limit: Speed limit [km/h].
    """

    segments: int
    lanes: int
    speed_limit: float

    def corridor(self, name: str, segment_length: float, duration: int) -> Corridor:
        """Return the road without demand and recordings."""
        geometry = Geometry(
            self.segments,
            lanes=self.lanes,
            segment_length=segment_length,
            speed_limit=self.speed_limit,
        )
        conditions = Conditions(Demand(mainline=((0.0, 0.0),)), duration)
        return Corridor(name, geometry, conditions, Scales.of(geometry))


def import_field(
    source: FieldSource, road: FieldRoad, output: Path, splits: Sequence[Split],
    duration: int = 450,
) -> tuple[Corridor, dict[str, tuple[int, ...]]]:  # fmt: skip
    """Import a field as records without vehicles, and return its road and its traffic seeds.

    Cells are averaged over segments, density and flow alike, and intervals are interpolated to
    seconds. The field is cut into windows of `duration` seconds, that many and the second 0, which
    do not overlap: each is the record of a traffic seed, the first windows those of the first
    split. The demand of the written road is the mean flow of the first split that has windows.

    Args:
        source: The files.
        road: The road.
        output: Folder to create; it appears when it is complete. Its name is that of the road.
        splits: Parts of the windows, in order of time.
        duration: Length of a window [s].

    Raises:
        ValueError: The field or an argument is malformed, there are fewer cells than segments or
            fewer seconds than a window, or the folder exists.
        OSError: A file cannot be read, or the folder not be written.
    """
    integer("duration", duration, 1)
    integer("segments", road.segments, 2)
    name = named_after(output)
    require_new(output)
    density, flow = source.read(road.lanes, road.speed_limit)
    each = source.cells_of(road.segments, len(density))
    field = np.stack(by_second(density, flow, road.segments + 2, source.interval), axis=-1)
    starts = range(0, len(field) - duration, duration + 1)
    turned = len(density) * source.interval > duration
    allowed = f"below the field's {len(field)} s{', or transposed given' if turned else ''}"
    require(len(starts) > 0, "duration", allowed, duration)
    seeds = assign_seeds(splits, len(starts))
    flat = [seed for split in splits for seed in seeds[split.name]]
    bare = road.corridor(name, each * source.cell, duration)
    # The boundary segments, at both ends, come last in a record.
    order = [*range(1, road.segments + 1), 0, road.segments + 1]
    windows = [field[start : start + duration + 1, order] for start in starts]
    records = [
        Record(n_steps=duration + 1, n_columns=len(order), field=window) for window in windows
    ]
    n_first = len(next(filter(None, seeds.values())))
    entering = np.mean([window[:, 0].prod(axis=-1).mean() for window in windows[:n_first]])
    demand = Demand(mainline=((0.0, round(float(entering), 1)),))
    measured = with_measured(bare, records[:n_first], demand)
    sources: list[dict[str, Any]] = [
        {"seed": seed, "file": source.density.name, "start": start}
        for seed, start in zip(flat, starts, strict=True)
    ]
    with new_folder(output) as folder:
        kept = save_records(folder, bare, records, sources, "fields")
        written = measured.replaced(recordings=kept)
        comment = "A measured field. Demand and average dwell are those of its first windows."
        write_corridor(folder / ROAD, written, comment=comment)
    return moved(written, output), seeds


def by_second(
    density: FloatArray, flow: FloatArray, n: int, interval: float
) -> tuple[FloatArray, FloatArray]:
    """Return density and speed of every second of n segments, (seconds, n) each."""
    each, seconds = len(density) // n, np.arange(0.0, density.shape[1] * interval)
    middles = (np.arange(density.shape[1]) + 0.5) * interval
    rho, q = (
        np.column_stack([np.interp(seconds, middles, row) for row in table])
        for table in (t[: n * each].reshape(n, each, -1).mean(axis=1) for t in (density, flow))
    )
    return rho, q / np.maximum(rho, VACANT)
