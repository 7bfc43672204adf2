"""Incidents: temporary speed limits, fixed or drawn for every traffic seed."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dptse_env.traffic.demand import Second
from dptse_env.utils.fields import Interval, checked_fields, require

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


def limit_changes(
    incidents: Iterable[Incident], speed_limits: Sequence[float]
) -> list[tuple[float, int, float]]:
    """Return the changes of limits in order, each as (time [s], segment, new limit [km/h]).

    Where several incidents act on a segment at once, the lowest of their limits holds.

    Args:
        incidents: The incidents.
        speed_limits: Limit of each segment outside incidents [km/h].
    """
    by_segment: dict[int, list[tuple[float, float, float]]] = {}
    for incident in incidents:
        by_segment.setdefault(incident.segment, []).extend(incident.phases)
    changes = []
    for segment, phases in by_segment.items():
        for time in sorted({time for start, end, _ in phases for time in (start, end)}):
            active = [limit for start, end, limit in phases if start <= time < end]
            changes.append((time, segment, min(active, default=speed_limits[segment])))
    return sorted(changes)
