"""Places of points on a road: branch, position along the road and record column."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.importers.branches import OFF, Road
from dptse_env.traffic.importers.points import Labels, Points
from dptse_env.traffic.importers.source import Layout, Part
from dptse_env.traffic.sumo_input import edge_ids
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.fields import require

LINE_SPACING = 0.005
"""Spacing of the points of a centre line by which the nearest one is found [km]."""


class Placed(NamedTuple):
    """Places of n points.

    Attributes:
        branch: 0 for the mainline, 1..I for the on-ramps, I+1..I+O for the off-ramps, or `OFF`.
        position: Position along the mainline [km]; on a ramp, that of the face it joins plus or
            minus the distance to it.
        column: Record column, or `OFF`.
        lane: Number of the lane, where its name is one, else 0.
    """

    branch: NDArray[np.int16]
    position: FloatArray
    column: NDArray[np.int16]
    lane: NDArray[np.int32]


class Placer:
    """Places points on a road by what a `Layout` says.

    Raises:
        ValueError: The layout does not fit the corridor.
    """

    def __init__(self, corridor: Corridor, layout: Layout, length: float) -> None:
        """Prepare for points whose file has a unit of `length` [km]."""
        self.road, self.layout, self._unit = Road(corridor), layout, length
        counts = (("on_ramps", corridor.n_on_ramps), ("off_ramps", corridor.n_off_ramps))
        for name, n in counts:
            parts = getattr(layout, name)
            allowed = f"one part for each of the {n} {name.replace('_', '-')} at most"
            require(len(parts) <= n, f"layout.{name}", allowed, len(parts))
        # The mainline comes last: without lanes and range it takes what no ramp has.
        first_off = 1 + corridor.n_on_ramps
        self._parts = [
            *((1 + i, part) for i, part in enumerate(layout.on_ramps)),
            *((first_off + i, part) for i, part in enumerate(layout.off_ramps)),
            (0, layout.mainline),
        ]
        self._edges = self._read_edges(corridor)
        line = np.array(layout.centre_line) * length
        self._line = _dense(line) if len(line) else None
        self._tree = None if self._line is None else cKDTree(self._line)

    def place(self, points: Points) -> Placed:
        """Return where points are."""
        lane = np.zeros(len(points), dtype=np.int32)
        if points.lane is not None:
            numbers = np.array([_lane_number(name) for name in points.lane.names])
            lane = numbers[points.lane.codes]
        if points.edge is not None and self._tree is None:
            return self._on_edges(points.x, points.edge, lane)
        x, y = points.x, points.y
        if self._tree is not None:
            x, y = self._project(points)
        position = x - self.layout.origin * self._unit
        if self.layout.reversed:
            position = -position
        branch = self._branch(points, y)
        return Placed(branch, position, self.road.column(branch, position), lane)

    def _branch(self, points: Points, y: FloatArray | None) -> NDArray[np.int16]:
        branch = np.full(len(points), OFF, dtype=np.int16)
        for number, part in self._parts:
            here = branch == OFF
            if part.lanes:
                if points.lane is None:
                    raise ValueError(f"layout needs lanes {part.lanes}, and the file has none")
                known = np.array([name in part.names for name in points.lane.names])
                here &= known[points.lane.codes]
            if part.lateral is not None:
                if y is None:
                    raise ValueError("layout needs lateral positions, and the file has none")
                low, high = (bound * self._unit for bound in part.lateral)
                here &= (y >= low) & (y < high)
            elif number > 0 and not part.lanes:
                continue  # a ramp that the data does not show
            branch[here] = number
        return branch

    def _read_edges(self, corridor: Corridor) -> dict[str, tuple[int, float]]:
        """Return column, or `OFF` for the mainline by position, and start [km] of each edge."""
        columns = edge_ids(corridor)
        start = self.road.column_starts[1]
        edges = {}
        for name, value in (self.layout.edges or {each: each for each in columns}).items():
            if isinstance(value, str):
                require(value in columns, f"layout.edges.{name}", f"one of {', '.join(columns)}",
                        value)  # fmt: skip
                column = columns.index(value)
                edges[name] = column, float(start[column])
            else:
                edges[name] = OFF, float(value)
        return edges

    def _on_edges(self, x: FloatArray, edge: Labels, lane: NDArray[np.int32]) -> Placed:
        known = [self._edges.get(name) for name in edge.names]
        branches = self.road.column_starts[0]
        column = np.array([OFF if each is None else each[0] for each in known], dtype=np.int16)
        start = np.array([np.nan if each is None else each[1] for each in known])
        branch = np.where(column >= 0, branches[column], 0).astype(np.int16)
        branch[[each is None for each in known]] = OFF
        codes = edge.codes
        position, found = start[codes] + x, column[codes]
        by_position = (found == OFF) & (branch[codes] != OFF)
        found[by_position] = self.road.column(branch[codes][by_position], position[by_position])
        return Placed(branch[codes], position, found, lane)

    def _project(self, points: Points) -> tuple[FloatArray, FloatArray]:
        """Return distances along the centre line, and to its left, of points in the plane [km]."""
        if points.y is None:
            raise ValueError("layout.centre_line needs two coordinates, and the file has one")
        assert self._tree is not None and self._line is not None  # noqa: PT018
        line = self._line
        place = np.column_stack([points.x, points.y])
        nearest = self._tree.query(place)[1]
        steps = np.diff(line, axis=0)
        length = np.hypot(*steps.T)
        along = np.concatenate([[0.0], np.cumsum(length)])
        best = np.full(len(place), np.inf)
        s, d = np.zeros(len(place)), np.zeros(len(place))
        for offset in (-1, 0):  # the pieces on both sides of the nearest point
            piece = np.clip(nearest + offset, 0, len(steps) - 1)
            unit = steps[piece] / length[piece, None]
            relative = place - line[piece]
            forward = (relative * unit).sum(axis=1)
            # Beyond its ends the line goes straight on.
            low = np.where(piece == 0, -np.inf, 0.0)
            high = np.where(piece == len(steps) - 1, np.inf, length[piece])
            held = np.clip(forward, low, high)
            away = np.hypot(*(relative - held[:, None] * unit).T)
            left = unit[:, 0] * relative[:, 1] - unit[:, 1] * relative[:, 0]
            better = away < best
            best = np.where(better, away, best)
            s = np.where(better, along[piece] + held, s)
            d = np.where(better, np.where(left < 0.0, -away, away), d)
        return s, d


def part_in_words(part: Part) -> str:
    """Describe a part of the road for messages."""
    lanes = f"lanes {', '.join(map(str, part.lanes))}" if part.lanes else ""
    lateral = f"lateral positions {part.lateral}" if part.lateral else ""
    return " and ".join(filter(None, (lanes, lateral))) or "all other vehicles"


def _dense(line: FloatArray) -> FloatArray:
    """Return a line with points at `LINE_SPACING` at most, its own among them."""
    pieces = []
    for start, end in itertools.pairwise(line):
        n = max(1, int(np.ceil(np.hypot(*(end - start)) / LINE_SPACING)))
        pieces.append(start + np.arange(n)[:, None] / n * (end - start))
    dense: FloatArray = np.concatenate([*pieces, line[-1:]])
    repeated = np.flatnonzero(np.hypot(*np.diff(dense, axis=0).T) == 0.0)
    require(len(repeated) == 0, "layout.centre_line", "free of points that repeat", len(repeated))
    return dense


def _lane_number(name: str) -> int:
    return int(name) if name.isdecimal() and len(name) < 9 else 0
