"""Loops: settings, and their stations on a road.

A loop is a point, unlike a fixed sensor: it sees what passes a border between two segments, and
reports once an interval.
"""

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, NamedTuple, Self

import numpy as np

from dptse_env.geometry import Face, Geometry
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.validation import Interval, checked_fields, require

TOLERANCE = 0.001
"""Distance from a border at which a position still names it [km]."""


@dataclass(frozen=True)
class Loops:
    """Stations of loops, one in each lane.

    At the end of every interval of a record a station reports how many vehicles have passed it in
    the interval, and the arithmetic mean of their speeds.

    Attributes:
        positions: of stations on the mainline, from its upstream end [km], increasing. One within
            a segment is moved to the nearest border. A station counts who enters the segment behind
            its border: those of an on-ramp there, too, and not who leaves by an off-ramp.
        ramps: faces of ramps with a station, which counts who passes between ramp and mainline.
        interval: length of an interval [s]. Those of fewer than 10 s hold too few vehicles to tell
            what the traffic is.
        least_count: number of vehicles below which an interval reports nothing. A vehicle that
            passes alone shows its speed.

    Raises:
        ValueError: A value is out of range, or two stations have one place.
    """

    positions: tuple[Annotated[float, Interval(0, 10_000)], ...] = ()
    ramps: tuple[Face, ...] = ()
    interval: Annotated[int, Interval(10, 600)] = 20
    least_count: Annotated[int, Interval(0, 1000)] = 0

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "corridor.loops")
        for name in ("positions", "ramps"):
            values = getattr(self, name)
            increasing = list(values) == sorted(set(values))
            require(increasing, f"corridor.loops.{name}", "increasing", values)
        allowed = "not empty where no ramp has a station"
        some = bool(self.positions or self.ramps)
        require(some, "corridor.loops.positions", allowed, self.positions)

    def __str__(self) -> str:
        """Return the settings in words."""
        places = [f"{position:g} km" for position in self.positions]
        places += [f"ramp {face}" for face in self.ramps]
        least = f" (least count {self.least_count})" if self.least_count else ""
        return f"loops at {', '.join(places)} every {self.interval} s{least}"

    def fields(self) -> dict[str, Any]:
        """Return all fields by name, plain JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

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
            known = tuple(sorted((*geometry.on_ramps, *geometry.off_ramps)))
            allowed = f"faces with a ramp, {known}"
            require(face in known, "corridor.loops.ramps", allowed, face)
        nearest = [borders[each] for each in self.faces(geometry).tolist()]
        apart, allowed = len(set(nearest)) == len(nearest), "nearest to borders of their own"
        require(apart, "corridor.loops.positions", allowed, self.positions)
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


def borders_of(geometry: Geometry, segments: Sequence[int] | None = None) -> FloatArray:
    """Return the positions of the borders of segments, by default the mainline's, (N + 1,) [km]."""
    lengths = np.array(geometry.segment_lengths)
    ends = np.cumsum(lengths[: geometry.n_mainline] if segments is None else lengths[[*segments]])
    return np.round(np.concatenate([[0.0], ends]), 9)


class Stations(NamedTuple):
    """The F stations of a road, those of the mainline first.

    A station on the mainline counts who comes over its border into the segment behind it: at a face
    with an on-ramp also who comes from the ramp, at one with an off-ramp not who leaves by it. At
    the downstream end it counts who leaves the mainline. A station on a ramp counts who passes
    between ramp and mainline.

    A vehicle passes a station where it comes from a cell of `upstream` to one of `downstream`.
    """

    upstream: BoolArray  # (F, cells) flags
    downstream: BoolArray  # (F, cells) flags
    beside: IntArray  # (F, 2) segments with the same flow; one stands twice where it is alone
    enters: IntArray  # (F,) the first segment where vehicles come into the road, -1 elsewhere
    leaves: IntArray  # (F,) the last segment where they leave it, -1 elsewhere
    positions: FloatArray  # (F,) along the mainline [km]; of a ramp where it meets it

    @classmethod
    def of(cls, loops: Loops | None, geometry: Geometry) -> Self:
        """Return the stations of loops at borders; none without loops."""
        n, S, cells = geometry.n_mainline, geometry.n_segments, geometry.n_cells
        # Mainline faces up to these lie behind a cell, and those from there on ahead of it.
        behind, ahead = np.full(cells, -1), np.full(cells, n + 1)
        behind[:n] = np.arange(n)
        ahead[:n] = behind[:n] + 1
        ahead[S], behind[S + 1] = 0, n
        ramps = []
        for ramp, (face, _, segments) in enumerate(geometry.ramps()):
            own = np.zeros(cells, dtype=bool)
            own[[*segments, S + 2 + ramp]] = True
            is_on_ramp = ramp < len(geometry.on_ramps)
            # Nobody drives back onto a ramp, or from an off-ramp onto the road.
            (ahead if is_on_ramp else behind)[own] = face if is_on_ramp else face - 1
            if loops is not None and face in loops.ramps:
                ramps.append((face, own, is_on_ramp, segments[-1 if is_on_ramp else 0]))
        upstream, downstream, beside = [], [], []
        faces = [] if loops is None else loops.faces(geometry).tolist()
        for face in faces:
            upstream.append(ahead <= face)
            downstream.append(behind >= face)
            after = min(face, n - 1)
            alone = face == 0 or face in (*geometry.on_ramps, *geometry.off_ramps)
            beside.append((after if alone else face - 1, after))
        for face, own, is_on_ramp, end in ramps:
            upstream.append(own if is_on_ramp else ahead <= face)
            downstream.append(behind >= face if is_on_ramp else own)
            beside.append((end, end))
        ends = np.array([*faces, *(-1 for _ in ramps)])
        return cls(
            np.array(upstream, dtype=bool).reshape(-1, cells),
            np.array(downstream, dtype=bool).reshape(-1, cells),
            np.array(beside, dtype=np.int64).reshape(-1, 2),
            np.where(ends == 0, 0, -1),
            np.where(ends == n, n - 1, -1),
            borders_of(geometry)[[*faces, *(face for face, *_ in ramps)]],
        )
