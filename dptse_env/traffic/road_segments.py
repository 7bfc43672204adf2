"""Segments of a road: their order, names, lengths, lanes and limits."""

import itertools
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TypeVar

T = TypeVar("T")


class RoadSegments:
    """Base class of a corridor: what follows from its fields for each of its segments."""

    n_mainline: int
    on_ramps: tuple[int, ...]
    off_ramps: tuple[int, ...]
    lanes: int | tuple[int, ...]
    ramp_lanes: int | tuple[int, ...]
    segment_length: float | tuple[float, ...]
    speed_limit: float | tuple[float, ...]
    ramp_segments: int | tuple[int, ...]
    ramp_length: float | tuple[float, ...] | None
    ramp_speed_limit: float | tuple[float, ...] | None

    @property
    def n_on_ramps(self) -> int:
        """Number I of on-ramps."""
        return len(self.on_ramps)

    @property
    def n_off_ramps(self) -> int:
        """Number O of off-ramps."""
        return len(self.off_ramps)

    @property
    def n_segments(self) -> int:
        """Number S of segments that are estimated: those of the mainline and of all ramps."""
        return self.n_mainline + sum(self._per_ramp(self.ramp_segments))

    @property
    def n_ramps(self) -> int:
        """Number I + O of ramps."""
        return self.n_on_ramps + self.n_off_ramps

    @property
    def n_boundaries(self) -> int:
        """Number R = 2 + I + O of boundary segments around them."""
        return 2 + self.n_ramps

    @cached_property
    def on_ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        """Segments of each on-ramp, in the direction of travel."""
        return self._ramp_segments[: self.n_on_ramps]

    @cached_property
    def off_ramp_segments(self) -> tuple[tuple[int, ...], ...]:
        """Segments of each off-ramp, in the direction of travel."""
        return self._ramp_segments[self.n_on_ramps :]

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

    @cached_property
    def boundary_neighbours(self) -> tuple[int, ...]:
        """Segment next to each of the R boundary segments."""
        before = [segments[0] for segments in self.on_ramp_segments]
        after = [segments[-1] for segments in self.off_ramp_segments]
        return (0, self.n_mainline - 1, *before, *after)

    @property
    def boundary_lanes(self) -> tuple[int, ...]:
        """Lanes of each of the R boundary segments."""
        return tuple(self.segment_lanes[s] for s in self.boundary_neighbours)

    def with_boundaries(self, values: Sequence[T]) -> tuple[T, ...]:
        """Return values of the S segments, followed by those of the R boundary segments."""
        return (*values, *(values[s] for s in self.boundary_neighbours))

    @property
    def most_lanes(self) -> int:
        """Largest number of lanes of the mainline."""
        return max(self.segment_lanes[: self.n_mainline])

    @property
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
