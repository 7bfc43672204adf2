"""Incidents: temporary speed limits, fixed or drawn for every traffic seed."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dptse_env.traffic.demand import Second
from dptse_env.utils.fields import Interval, checked_fields
from dptse_env.utils.validation import require

Segment = Annotated[int, Interval(0, 999)]
"""Index of a mainline segment."""
Limit = Annotated[float, Interval(0, 1000, open_low=True)]
"""Speed limit [km/h]."""
Duration = Annotated[float, Interval(0, 1e6, open_low=True)]
"""A positive number of seconds."""


@dataclass(frozen=True)
class Incident:
    """A temporary speed limit on a mainline segment, as by a variable speed sign.

    Attributes:
        segment: index of the mainline segment.
        phases: (start [s], end [s], speed limit [km/h]), in order and not overlapping. Outside
            the phases the corridor's limit holds.

    Raises:
        ValueError: A phase is empty, out of order, or has a limit that is not positive.
    """

    segment: Segment
    phases: tuple[tuple[Second, Duration, Limit], ...]

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "incident")
        require(bool(self.phases), "incident.phases", "at least one phase", self.phases)
        last_end = 0.0
        for i, phase in enumerate(self.phases):
            start, end, _ = phase
            allowed = f"after {last_end} s with start < end"
            require(last_end <= start < end, f"incident.phases[{i}]", allowed, phase)
            last_end = end

    @property
    def start(self) -> float:
        """Start of the first phase [s]."""
        return self.phases[0][0]

    def limit_changes(self, speed_limit: float) -> list[tuple[float, float]]:
        """Return the changes of the segment's limit as pairs (time [s], new limit [km/h]).

        `speed_limit` is the limit outside the phases [km/h].
        """
        changes: list[tuple[float, float]] = []
        for start, end, limit in self.phases:
            if changes and changes[-1][0] == start:
                changes.pop()  # the next phase follows directly, without the usual limit in between
            changes += [(start, limit), (end, speed_limit)]
        return changes


@dataclass(frozen=True)
class IncidentDistribution:
    """Ranges from which the incident of each traffic seed is drawn uniformly.

    The incident has two phases, as in the paper: a blockage, then a slower recovery.

    Attributes:
        segments: candidate mainline segments.
        start: range of the start [s].
        duration: range of the blockage's duration [s].
        speed_limit: range of the speed limit during the blockage [km/h].
        recovery_duration: range of the recovery's duration [s].
        recovery_speed_limit: range of the speed limit during the recovery [km/h].

    Raises:
        ValueError: There is no candidate segment, or a range is not positive and ordered.
    """

    segments: tuple[Segment, ...]
    start: tuple[Second, Second] = (60.0, 300.0)
    duration: tuple[Duration, Duration] = (60.0, 240.0)
    speed_limit: tuple[Limit, Limit] = (5.0, 30.0)
    recovery_duration: tuple[Duration, Duration] = (30.0, 120.0)
    recovery_speed_limit: tuple[Limit, Limit] = (40.0, 70.0)

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "incident")
        require(bool(self.segments), "incident.segments", "at least one segment", self.segments)
        for name in (
            "start",
            "duration",
            "speed_limit",
            "recovery_duration",
            "recovery_speed_limit",
        ):
            low, high = pair = getattr(self, name)
            require(low <= high, f"incident.{name}", "a pair (low, high) with low <= high", pair)

    def draw(self, generator: np.random.Generator) -> Incident:
        """Draw one incident."""
        segment = int(generator.choice(self.segments))
        start = float(generator.uniform(*self.start))
        blocked_until = start + float(generator.uniform(*self.duration))
        blocked_limit = float(generator.uniform(*self.speed_limit))
        recovered_at = blocked_until + float(generator.uniform(*self.recovery_duration))
        recovery_limit = float(generator.uniform(*self.recovery_speed_limit))
        return Incident(
            segment=segment,
            phases=(
                (start, blocked_until, blocked_limit),
                (blocked_until, recovered_at, recovery_limit),
            ),
        )
