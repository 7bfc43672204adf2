"""Loop detectors: settings, and their stations on a road.

A loop is a point, unlike a fixed sensor: it sees what passes a border between two segments, and
reports once an interval.
"""

import warnings
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple, Self

import numpy as np

from dptse_env.geometry import Face, Geometry
from dptse_env.road import Road
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.validation import Interval, checked_fields, require

TOLERANCE = 0.001
"""Distance from a border at which a position still names it [km]."""


@dataclass(frozen=True)
class Loops:
    """Stations of loop detectors, one in each lane.

    At the end of every interval of a record a station reports how many vehicles have passed it in
    the interval, and the arithmetic mean of their speeds.

    Attributes:
        positions: of stations on the mainline, from its upstream end [km], increasing. One within
            a segment is moved to the nearest border. Where a ramp meets the mainline a station
            counts the vehicles that stay on the mainline.
        ramps: faces of ramps with a station, where they meet the mainline.
        interval: length of an interval [s].
        least_count: number of vehicles below which an interval reports nothing. A vehicle that
            passes alone shows its speed.

    Raises:
        ValueError: A value is out of range, or two stations have one place.
    """

    positions: tuple[Annotated[float, Interval(0, 10_000)], ...] = ()
    ramps: tuple[Face, ...] = ()
    interval: Annotated[int, Interval(1, 600)] = 20
    least_count: Annotated[int, Interval(0, 1000)] = 0

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "corridor.loops")
        for name in ("positions", "ramps"):
            values = getattr(self, name)
            increasing = list(values) == sorted(set(values))
            require(increasing, f"corridor.loops.{name}", "increasing", values)
        any_station = bool(self.positions or self.ramps)
        require(any_station, "corridor.loops", "stations at positions or on ramps", "none")

    def at_borders(self, geometry: Geometry) -> Self:
        """Return these stations at borders of a road's segments.

        Raises:
            ValueError: A position is outside of the road, two name one border, or there is no ramp
                at a face.

        Warns:
            UserWarning: A position is moved.
        """
        borders = borders_of(geometry)
        for position in self.positions:
            allowed = f"in 0..{borders[-1]:g} km"
            inside = position <= borders[-1] + TOLERANCE
            require(inside, "corridor.loops.positions", allowed, position)
        for face in self.ramps:
            known = (*geometry.on_ramps, *geometry.off_ramps)
            allowed = f"faces with a ramp, {known}"
            require(face in known, "corridor.loops.ramps", allowed, face)
        nearest = [borders[each] for each in self.faces(geometry).tolist()]
        moved = [
            f"{given:g} to {border:g} km"
            for given, border in zip(self.positions, nearest, strict=True)
            if abs(given - border) > TOLERANCE
        ]
        if moved:
            message = f"corridor.loops.positions lie within segments; moved {', '.join(moved)}"
            warnings.warn(message, UserWarning, stacklevel=1)
        return replace(self, positions=tuple(float(border) for border in nearest))

    def faces(self, geometry: Geometry) -> IntArray:
        """Return the mainline face, 0 to N, that is nearest to each position."""
        distances = np.abs(borders_of(geometry) - np.array(self.positions).reshape(-1, 1))
        faces: IntArray = distances.argmin(axis=1)
        return faces


def borders_of(geometry: Geometry) -> FloatArray:
    """Return the positions of the borders of mainline segments, (N + 1,) [km]."""
    lengths = geometry.segment_lengths[: geometry.n_mainline]
    return np.round(np.concatenate([[0.0], np.cumsum(lengths)]), 9)


class Stations(NamedTuple):
    """The F stations of a road, those of the mainline first.

    A vehicle passes a station where it leaves one of its `upstream` cells for one of its
    `downstream` cells.
    """

    upstream: BoolArray  # (F, cells) flags
    downstream: BoolArray  # (F, cells) flags
    beside: IntArray  # (F, 2) segments before and after; one stands twice where the road ends
    lanes: FloatArray  # (F,) of the road there

    @classmethod
    def of(cls, loops: Loops, geometry: Geometry, road: Road) -> Self:
        """Return the stations of loops at borders."""
        n, S = geometry.n_mainline, geometry.n_segments
        place = np.full(geometry.n_cells, -2)
        place[:n], place[S], place[S + 1] = np.arange(n), -1, n
        on_mainline, upstream, downstream, beside = place > -2, [], [], []
        for face in loops.faces(geometry).tolist():
            upstream.append(on_mainline & (place < face))
            downstream.append(on_mainline & (place >= face))
            beside.append((max(face - 1, 0), min(face, n - 1)))
        for ramp, (face, _, segments) in enumerate(geometry.ramps()):
            if face not in loops.ramps:
                continue
            own = np.zeros(geometry.n_cells, dtype=bool)
            own[[*segments, S + 2 + ramp]] = True
            is_on_ramp = ramp < len(geometry.on_ramps)
            upstream.append(own if is_on_ramp else on_mainline)
            downstream.append(on_mainline if is_on_ramp else own)
            end = segments[-1] if is_on_ramp else segments[0]
            beside.append((end, end))
        pairs = np.array(beside, dtype=np.int64).reshape(-1, 2)
        return cls(np.array(upstream), np.array(downstream), pairs, road.lanes[pairs].min(axis=1))
