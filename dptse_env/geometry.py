"""Geometry of a road: its segments, ramps, lanes and speed limits.

Segments are numbered from 0: the mainline first, then the on-ramps, then the off-ramps, each in the
direction of travel. A ramp at face j sits between the mainline segments j-1 and j. Around these S
segments lie boundary segments that are recorded but not estimated: one upstream and one downstream
of the mainline, one before every on-ramp and one after every off-ramp. A boundary segment has
length, lanes and limit of the segment that it lies next to.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, TypeVar

from dptse_env.utils.validation import Interval, checked_fields, integer, require

T = TypeVar("T")

Face = Annotated[int, Interval(1, 999)]
"""Number of a face between two mainline segments."""
Lanes = Annotated[int, Interval(1, 16)]
"""Number of lanes."""
# SUMO cannot drive an edge shorter than about a vehicle and its gap.
SHORTEST_SEGMENT = 0.04
"""Length of a segment at least [km]."""
Length = Annotated[float, Interval(SHORTEST_SEGMENT, 10)]
"""Length of a segment [km]."""
SpeedLimit = Annotated[float, Interval(1, 1000)]
"""A speed limit [km/h]."""
Share = Annotated[float, Interval(0, 1, open_low=True, open_high=True)]
"""Share of the vehicles that pass an off-ramp."""
RampSegments = Annotated[int, Interval(1, 100)]
"""Number of segments of a ramp."""


@dataclass(frozen=True)
class Geometry:
    """Geometry of a stretch of highway with ramps.

    Lengths, lanes and speed limits are one value for all mainline segments or a sequence with one
    for each; those of ramps one value for all ramps or a sequence with one for each, on-ramps
    first. A sequence of equal values is the same as the value.

    Attributes:
        n_mainline: number N of mainline segments, at least 2.
        on_ramps: face of each on-ramp, in 1..N-1, increasing.
        off_ramps: face of each off-ramp, in 1..N-1, increasing, none shared with an on-ramp.
        exit_shares: share in (0, 1) of the vehicles passing each off-ramp that take it.
        lanes: lanes of the mainline; where they get fewer, the leftmost ones end.
        ramp_lanes: lanes of the ramps, at most those of the mainline segment that they join or
            leave.
        segment_length: length of the mainline's segments [km].
        speed_limit: speed limit of the mainline outside incidents [km/h].
        ramp_segments: number of segments of the ramps.
        ramp_length: length of a ramp's segments [km]; None for that of the mainline segment that
            it joins or leaves.
        ramp_speed_limit: speed limit of the ramps [km/h]; None for that of the same segment.

    Raises:
        ValueError: The geometry is impossible; the message names the field of the corridor.
    """

    n_mainline: Annotated[int, Interval(2, 1000)]
    on_ramps: tuple[Face, ...] = ()
    off_ramps: tuple[Face, ...] = ()
    exit_shares: tuple[Share, ...] = ()
    lanes: Lanes | tuple[Lanes, ...] = 3
    ramp_lanes: Lanes | tuple[Lanes, ...] = 1
    segment_length: Length | tuple[Length, ...] = 0.1
    speed_limit: SpeedLimit | tuple[SpeedLimit, ...] = 102.0
    ramp_segments: RampSegments | tuple[RampSegments, ...] = 1
    ramp_length: Length | tuple[Length, ...] | None = None
    ramp_speed_limit: SpeedLimit | tuple[SpeedLimit, ...] | None = None

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "corridor")
        self._check_ramps()
        self._check_profiles()

    def _require(self, condition: bool, name: str, allowed: str) -> None:
        """Raise ``ValueError`` with the value of a field unless a condition holds."""
        require(condition, f"corridor.{name}", allowed, getattr(self, name))

    def _check_ramps(self) -> None:
        for name in ("on_ramps", "off_ramps"):
            faces = getattr(self, name)
            for i, face in enumerate(faces):
                integer(f"corridor.{name}[{i}]", face, 1, self.n_mainline - 1)
            self._require(list(faces) == sorted(set(faces)), name, "increasing")
        disjoint = not set(self.on_ramps) & set(self.off_ramps)
        self._require(disjoint, "off_ramps", f"at other faces than the on-ramps {self.on_ramps}")
        fits = len(self.exit_shares) == len(self.off_ramps)
        allowed = f"one share for each of the {len(self.off_ramps)} off-ramps"
        self._require(fits, "exit_shares", allowed)

    def _check_profiles(self) -> None:
        """Check what varies along the road, and collapse sequences of equal values."""
        of_mainline = ("lanes", "segment_length", "speed_limit")
        of_ramps = ("ramp_lanes", "ramp_segments", "ramp_length", "ramp_speed_limit")
        for names, count, each in (
            (of_mainline, self.n_mainline, "mainline segment"),
            (of_ramps, self.n_ramps, "ramp"),
        ):
            for name in names:
                values = getattr(self, name)
                if not isinstance(values, tuple):
                    continue
                allowed = f"one value, or {count}, one for each {each}"
                self._require(len(values) == count, name, allowed)
                if len(set(values)) == 1:
                    object.__setattr__(self, name, values[0])
        lanes = self.segment_lanes
        for face, beside, segments in self.ramps():
            allowed = f"<= {lanes[beside]} lanes at face {face}"
            most = lanes[segments[0]]
            require(most <= lanes[beside], "corridor.ramp_lanes", allowed, most)

    @property
    def n_ramps(self) -> int:
        """Number I + O of ramps."""
        return len(self.on_ramps) + len(self.off_ramps)

    @cached_property
    def n_segments(self) -> int:
        """Number S of segments that are estimated: those of the mainline and of all ramps."""
        return self.n_mainline + sum(self._per_ramp(self.ramp_segments))

    @cached_property
    def n_cells(self) -> int:
        """Number S + R of cells, with the R = 2 + I + O boundary segments around them."""
        return self.n_segments + 2 + self.n_ramps

    @cached_property
    def on_ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        """Segments of each on-ramp, in the direction of travel."""
        return self._ramp_segments[: len(self.on_ramps)]

    @cached_property
    def off_ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        """Segments of each off-ramp, in the direction of travel."""
        return self._ramp_segments[len(self.on_ramps) :]

    @cached_property
    def _ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        counts = self._per_ramp(self.ramp_segments)
        firsts = itertools.accumulate(counts, initial=self.n_mainline)
        return tuple(
            tuple(range(first, first + count)) for first, count in zip(firsts, counts, strict=False)
        )

    @cached_property
    def segment_lengths(self) -> tuple[float, ...]:
        """Length [km] of each of the S segments."""
        return self._along(self.segment_length, self.ramp_length)

    @cached_property
    def segment_lanes(self) -> tuple[int, ...]:
        """Lanes of each of the S segments."""
        return self._along(self.lanes, self.ramp_lanes)

    @cached_property
    def speed_limits(self) -> tuple[float, ...]:
        """Speed limit [km/h] of each of the S segments, outside incidents."""
        return self._along(self.speed_limit, self.ramp_speed_limit)

    @property
    def most_lanes(self) -> int:
        """Largest number of lanes of the mainline."""
        return max(self.segment_lanes[: self.n_mainline])

    @cached_property
    def largest_speed_limit(self) -> float:
        """Largest speed limit of the road [km/h]."""
        return max(self.speed_limits)

    def ramps(self) -> Iterator[tuple[int, int, tuple[int, ...]]]:
        """Yield each ramp's face, the mainline segment that it joins or leaves, its segments."""
        faces = [*self.on_ramps, *self.off_ramps]
        beside = [*self.on_ramps, *(face - 1 for face in self.off_ramps)]
        yield from zip(faces, beside, self._ramp_segments, strict=True)

    def _per_ramp(self, values: T | tuple[T, ...]) -> tuple[T, ...]:
        return values if isinstance(values, tuple) else (values,) * self.n_ramps

    def _along(
        self, values: T | tuple[T, ...], of_ramps: T | tuple[T, ...] | None
    ) -> tuple[T, ...]:
        """Return values of the S segments, given those of the mainline and of ramps."""
        n = self.n_mainline
        mainline = values if isinstance(values, tuple) else (values,) * n
        if of_ramps is None:
            of_ramps = tuple(mainline[beside] for _, beside, _ in self.ramps())
        ramps = zip(self._per_ramp(of_ramps), self._ramp_segments, strict=True)
        return (*mainline, *(value for value, segments in ramps for _ in segments))
