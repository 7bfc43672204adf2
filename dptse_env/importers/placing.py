"""Placement of points on a road: branch, position along the road and record column."""

from __future__ import annotations

import itertools
from collections.abc import Collection

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dptse_env.importers.source import Layout
from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.sumo_input import edge_ids
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.validation import require

OFF = -1
"""Branch and column of a point that is not on the road."""
LINE_SPACING = 0.005
"""Spacing of the points of a centre line by which the nearest one is found [km]."""


class Branches:
    """Record columns along the branches of a road: the mainline, then each ramp."""

    def __init__(self, corridor: Corridor) -> None:
        """Lay the columns along the road."""
        self.corridor, road = corridor, corridor.geometry
        n, first = road.n_mainline, road.n_segments
        lengths = corridor.road.lengths
        self.faces = np.concatenate([[0.0], np.cumsum(lengths[:n])])
        start, end = -lengths[first], self.faces[-1] + lengths[first + 1]
        self.starts: list[FloatArray] = []
        """Start of each column of a branch, ascending, and the end of the last."""
        self.columns: list[IntArray] = []
        """Columns of each branch."""
        self._add([start, *self.faces, end], [first, *range(n), first + 1])
        for number, (face, _, segments) in enumerate(road.ramps()):
            boundary = first + 2 + number
            if number < len(road.on_ramps):
                ramp = [boundary, *segments]
                before = self.faces[face] - np.cumsum(lengths[ramp][::-1])[::-1]
                starts = [*before, *self.faces[face:], end]
                self._add(starts, [*ramp, *range(face, n), first + 1])
            else:
                ramp = [*segments, boundary]
                after = self.faces[face] + np.cumsum(lengths[ramp])
                starts = [start, *self.faces[: face + 1], *after]
                self._add(starts, [first, *range(face), *ramp])

    def _add(self, starts: list[float], columns: list[int]) -> None:
        self.starts.append(np.array(starts))
        self.columns.append(np.array([*columns, OFF]))

    @property
    def column_starts(self) -> tuple[NDArray[np.int16], FloatArray]:
        """Branch of each record column, and the position at which it starts [km]."""
        n_columns = self.corridor.geometry.n_cells
        branch, start = np.zeros(n_columns, dtype=np.int16), np.zeros(n_columns)
        for number, of_branch in reversed([*enumerate(self.columns)]):
            columns = of_branch[:-1]
            branch[columns], start[columns] = number, self.starts[number][:-1]
        return branch, start

    def column(self, branch: NDArray[np.int16], position: FloatArray) -> NDArray[np.int16]:
        """Return the record column at positions of branches, or `OFF`, shape (n,)."""
        found = np.full(len(position), OFF, dtype=np.int16)
        for number, (starts, columns) in enumerate(zip(self.starts, self.columns, strict=True)):
            here = branch == number
            if here.any():
                place = np.searchsorted(starts, position[here], side="right") - 1
                found[here] = columns[place]  # -1, before the first, is OFF
        return found


def placed(
    points: pl.LazyFrame, roles: Collection[str], branches: Branches, layout: Layout, unit: float
) -> pl.LazyFrame:
    """Return points with their branch, position [km], record column and number of the lane.

    The branch is 0 for the mainline, 1..I for the on-ramps, I+1..I+O for the off-ramps, or `OFF`,
    as is the column of a point that is not on the road. Positions on a ramp are those of the face
    that it joins or leaves, minus or plus the distance to it.

    Args:
        points: Points with the columns of `dptse_env.importers.tables.SCHEMA`.
        roles: Those of the columns that the file has.
        branches: Those of the road.
        layout: Where it lies in the data.
        unit: The file's unit of length [km].

    Raises:
        ValueError: The layout does not fit the road.
    """
    corridor = branches.corridor
    for name in ("on_ramps", "off_ramps"):
        strips, n = getattr(layout, name), len(getattr(corridor.geometry, name))
        allowed = f"one strip for each of the {n} {name.replace('_', '-')} at most"
        require(len(strips) <= n, f"layout.{name}", allowed, len(strips))
    for strip in (*layout.on_ramps, *layout.off_ramps, layout.mainline):
        for wanted, role in ((strip.names, "lane"), (strip.lateral, "y")):
            if wanted and role not in {*roles, *(("y",) if layout.centre_line else ())}:
                raise ValueError(f"layout needs {strip}, and the file has no column of that kind")
    lane = pl.col("lane")
    number = pl.when(lane.str.contains(r"^\d{1,8}$")).then(lane).cast(pl.Int32).fill_null(0)
    if layout.centre_line:
        require("y" in roles, "layout.centre_line", "left out where the file has no y", "one")
        line = _Line(np.array(layout.centre_line) * unit)
        plane = pl.col("plane").struct
        points = points.with_columns(plane=line.project()).with_columns(plane["x"], plane["y"])
    if "edge" in roles and not layout.centre_line:
        points = points.join(_edges(layout, branches), on="edge", how="left").with_columns(
            pl.col("branch").fill_null(OFF), position=pl.col("start") + pl.col("x")
        )
        column = pl.coalesce("known", column_at(branches))
        return points.with_columns(column=column, lane_number=number)
    position = pl.col("x") - layout.origin * unit
    points = points.with_columns(
        branch=_branch(layout, len(corridor.geometry.on_ramps), unit),
        position=-position if layout.reversed else position,
    )
    return points.with_columns(column=column_at(branches), lane_number=number)


def column_at(branches: Branches) -> pl.Expr:
    """Return the record column of points by their branch and position."""

    def find(both: pl.Series) -> pl.Series:
        branch, positions = both.struct.unnest()
        on = branch.fill_null(OFF).to_numpy().astype(np.int16)
        return pl.Series(branches.column(on, positions.fill_null(np.inf).to_numpy()))

    both = pl.struct("branch", "position")
    return both.map_batches(find, return_dtype=pl.Int16, is_elementwise=True)


def _edges(layout: Layout, branches: Branches) -> pl.LazyFrame:
    """Return branch, start [km] and column of each edge; null for the mainline by position."""
    names = edge_ids(branches.corridor.geometry)
    numbers, starts = branches.column_starts
    edges: list[tuple[str, int, float, int | None]] = []
    for name, value in (layout.edges or {each: each for each in names}).items():
        if not isinstance(value, str):
            edges.append((name, 0, float(value), None))
            continue
        require(value in names, f"layout.edges.{name}", f"one of {', '.join(names)}", value)
        at = names.index(value)
        edges.append((name, int(numbers[at]), float(starts[at]), at))
    kinds = {"edge": pl.String, "branch": pl.Int16, "start": pl.Float64, "known": pl.Int16}
    return pl.LazyFrame(edges, kinds, orient="row")


def _branch(layout: Layout, n_on_ramps: int, unit: float) -> pl.Expr:
    """Return the branch by lanes and lateral positions; the mainline takes what no ramp has."""
    ramps = [*enumerate(layout.on_ramps, 1), *enumerate(layout.off_ramps, 1 + n_on_ramps)]
    found = pl.lit(OFF, pl.Int16)
    for number, strip in reversed([*ramps, (0, layout.mainline)]):
        if number and not strip.names and strip.lateral is None:
            continue  # a ramp that the data does not show
        here = pl.lit(True)
        if strip.names:
            here &= pl.col("lane").is_in(sorted(strip.names)).fill_null(False)
        if strip.lateral is not None:
            low, high = (bound * unit for bound in strip.lateral)
            here &= pl.col("y").is_between(low, high, closed="left").fill_null(False)
        found = pl.when(here).then(pl.lit(number, pl.Int16)).otherwise(found)
    return found


class _Line:
    """A line in the plane, on which points are projected."""

    def __init__(self, line: FloatArray) -> None:
        pieces = []
        for start, end in itertools.pairwise(line):
            n = max(1, int(np.ceil(np.hypot(*(end - start)) / LINE_SPACING)))
            pieces.append(start + np.arange(n)[:, None] / n * (end - start))
        self._points: FloatArray = np.concatenate([*pieces, line[-1:]])
        self._steps = np.diff(self._points, axis=0)
        self._length = np.hypot(*self._steps.T)
        repeated = int((self._length == 0.0).sum())
        require(not repeated, "layout.centre_line", "free of points that repeat", repeated)
        self._along = np.concatenate([[0.0], np.cumsum(self._length)])
        self._tree = cKDTree(self._points)

    def project(self) -> pl.Expr:
        """Return distances along the line (x) and to its left (y), of points in the plane [km]."""

        def both(plane: pl.Series) -> pl.Series:
            x, y = (each.fill_null(0.0).to_numpy() for each in plane.struct.unnest())
            s, d = self._project(np.column_stack([x, y]))
            return pl.DataFrame({"x": s, "y": d}).to_struct()

        kind = pl.Struct({"x": pl.Float64, "y": pl.Float64})
        return pl.struct("x", "y").map_batches(both, return_dtype=kind, is_elementwise=True)

    def _project(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        nearest, last = self._tree.query(place)[1], len(self._steps) - 1
        best, s, d = np.full(len(place), np.inf), np.zeros(len(place)), np.zeros(len(place))
        for offset in (-1, 0):  # the pieces on both sides of the nearest point
            piece = np.clip(nearest + offset, 0, last)
            unit = self._steps[piece] / self._length[piece, None]
            relative = place - self._points[piece]
            # Beyond its ends the line goes straight on.
            low = np.where(piece == 0, -np.inf, 0.0)
            high = np.where(piece == last, np.inf, self._length[piece])
            held = np.clip((relative * unit).sum(axis=1), low, high)
            away = np.hypot(*(relative - held[:, None] * unit).T)
            left = unit[:, 0] * relative[:, 1] - unit[:, 1] * relative[:, 0]
            better = away < best
            best = np.where(better, away, best)
            s = np.where(better, self._along[piece] + held, s)
            d = np.where(better, np.where(left < 0.0, -away, away), d)
        return s, d
