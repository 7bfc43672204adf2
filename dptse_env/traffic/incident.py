"""What slows the traffic down: a fixed incident, or ranges from which each seed draws one."""

from dataclasses import dataclass

import numpy as np

from dptse_env.validation import (
    integer,
    interval,
    non_negative,
    positive,
    require,
    sequence,
)


@dataclass(frozen=True)
class Incident:
    """A temporary speed limit on one mainline segment, as a variable speed sign sets it.

    Attributes:
        segment: index of the mainline segment.
        phases: (start [s], end [s], speed limit [km/h]), in order and not overlapping. Outside
            the phases the corridor's own limit holds.

    Raises:
        ValueError: if a phase is empty, out of order, or has a limit that is not positive.
    """

    segment: int
    phases: tuple[tuple[float, float, float], ...]

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        object.__setattr__(self, "segment", integer("incident.segment", self.segment, 0))
        phases, last_end = [], 0.0
        for i, phase in enumerate(sequence("incident.phases", self.phases)):
            path = f"incident.phases[{i}]"
            values = sequence(path, phase, length=3)
            start = non_negative(f"{path} start", values[0])
            end = positive(f"{path} end", values[1])
            limit = positive(f"{path} speed limit", values[2])
            require(last_end <= start < end, path, f"after {last_end} s with start < end", phase)
            phases.append((start, end, limit))
            last_end = end
        require(bool(phases), "incident.phases", "at least one phase", self.phases)
        object.__setattr__(self, "phases", tuple(phases))

    @property
    def start(self) -> float:
        """Start of the first phase [s]."""
        return self.phases[0][0]

    def limit_changes(self, speed_limit: float) -> list[tuple[float, float]]:
        """List the moments at which the segment's limit changes.

        Args:
            speed_limit: the limit outside the phases [km/h].

        Returns:
            Pairs (time [s], new limit [km/h]) in order of time.
        """
        changes: list[tuple[float, float]] = []
        for start, end, limit in self.phases:
            if changes and changes[-1][0] == start:
                changes.pop()  # the next phase follows at once: the limit never returns in between
            changes += [(start, limit), (end, speed_limit)]
        return changes


@dataclass(frozen=True)
class IncidentDistribution:
    """Ranges from which every traffic seed draws its own incident, each uniformly.

    The incident has the two phases of the paper's: a blockage, then a slower recovery.

    Attributes:
        segments: candidate mainline segments.
        start: range of the start [s].
        duration: range of the blockage's duration [s].
        speed_limit: range of the speed limit during the blockage [km/h].
        recovery_duration: range of the recovery's duration [s].
        recovery_speed_limit: range of the speed limit during the recovery [km/h].

    Raises:
        ValueError: if there is no candidate segment, or a range is not positive and ordered.
    """

    segments: tuple[int, ...]
    start: tuple[float, float] = (60.0, 300.0)
    duration: tuple[float, float] = (60.0, 240.0)
    speed_limit: tuple[float, float] = (5.0, 30.0)
    recovery_duration: tuple[float, float] = (30.0, 120.0)
    recovery_speed_limit: tuple[float, float] = (40.0, 70.0)

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        segments = tuple(
            integer(f"incident.segments[{i}]", segment, 0)
            for i, segment in enumerate(sequence("incident.segments", self.segments))
        )
        require(bool(segments), "incident.segments", "at least one segment", self.segments)
        object.__setattr__(self, "segments", segments)
        object.__setattr__(self, "start", interval("incident.start", self.start, allow_zero=True))
        for name in ("duration", "speed_limit", "recovery_duration", "recovery_speed_limit"):
            object.__setattr__(self, name, interval(f"incident.{name}", getattr(self, name)))

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
