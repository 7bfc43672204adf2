"""Demand: arrival rates of vehicles, their drivers, and incidents that slow them down.

Rates and incidents are fixed or drawn for every traffic seed.
"""

import dataclasses
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from dptse_env.geometry import Share
from dptse_env.utils.units import KMH
from dptse_env.utils.validation import Interval, checked_fields, require

Rate = Annotated[float, Interval(0, 100_000)]
"""Vehicles an hour."""
Second = Annotated[float, Interval(0, 1e6)]
"""Seconds of simulated time."""
Profile = tuple[tuple[Second, Rate], ...]
"""Steps (time [s], rate [veh/h]): each rate holds until the next time, the last one to the end."""
ShareProfile = tuple[tuple[Second, Share], ...]
"""Steps (time [s], share), as in a `Profile`."""
Factor = Annotated[float, Interval(0, 100, open_low=True)]
"""Factor on every rate."""

Segment = Annotated[int, Interval(0, 999)]
"""Index of a mainline segment."""
Limit = Annotated[float, Interval(0, 1000, open_low=True)]
"""Speed limit [km/h]."""
Duration = Annotated[float, Interval(0, 1e6, open_low=True)]
"""A positive number of seconds."""

CarFollowing = Literal["W99", "Krauss", "IDM"]
"""SUMO's name of a car-following model."""
Headway = Annotated[float, Interval(0.1, 10)]
"""A time headway [s]."""
Acceleration = Annotated[float, Interval(0.1, 20)]
"""Change of a speed [m/s^2]."""


@dataclass(frozen=True)
class Demand:
    """Mean arrival rates; the arrivals themselves are Poisson.

    Attributes:
        mainline: steps (time [s], rate [veh/h]); each rate holds until the next time, the first
            time is 0 and the last rate holds until the end.
        on_ramps: for each on-ramp a constant rate [veh/h], or steps as for the mainline.
        exit_shares: for each off-ramp steps (time [s], share), by the time at which vehicles
            enter the road; None for the corridor's constant shares. Estimators know these alone.

    Raises:
        ValueError: A rate is negative, a share leaves (0, 1), or the times of steps do not start
            at 0 and increase.
    """

    mainline: Profile
    on_ramps: tuple[Rate | Profile, ...] = ()
    exit_shares: tuple[ShareProfile, ...] | None = None

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "demand")
        _check_steps("demand.mainline", self.mainline, "rate")
        for i, rates in enumerate(self.on_ramps):
            if isinstance(rates, tuple):
                _check_steps(f"demand.on_ramps[{i}]", rates, "rate")
        for i, shares in enumerate(self.exit_shares or ()):
            _check_steps(f"demand.exit_shares[{i}]", shares, "share")

    @property
    def ramp_profiles(self) -> tuple[Profile, ...]:
        """Steps (time [s], rate [veh/h]) of each on-ramp."""
        return tuple(
            rates if isinstance(rates, tuple) else ((0.0, rates),) for rates in self.on_ramps
        )

    def scaled(self, factor: float) -> "Demand":
        """Return this demand with every rate multiplied by `factor` [-]."""
        return dataclasses.replace(
            self,
            mainline=_scaled(self.mainline, factor),
            on_ramps=tuple(
                _scaled(rates, factor) if isinstance(rates, tuple) else rates * factor
                for rates in self.on_ramps
            ),
        )


def value_at(steps: Profile, times: npt.ArrayLike) -> NDArray[np.float64]:
    """Return the value of steps at times [s] of any shape."""
    starts, values = np.array(steps).T
    found: NDArray[np.float64] = values[np.searchsorted(starts, times, side="right") - 1]
    return found


def _scaled(steps: Profile, factor: float) -> Profile:
    return tuple((time, rate * factor) for time, rate in steps)


def _check_steps(path: str, steps: Profile, of: str) -> None:
    times = np.array([time for time, _ in steps])
    increasing = len(times) > 0 and times[0] == 0.0 and bool(np.all(np.diff(times) > 0))
    require(increasing, path, f"steps (time, {of}) whose times start at 0 and increase", steps)


@dataclass(frozen=True)
class DemandDistribution:
    """A demand whose overall level varies from one traffic seed to the next.

    Attributes:
        base: the demand at scale 1.
        scale: range (low, high) [-] of the factor on every rate, drawn uniformly.

    Raises:
        ValueError: The range is not positive and ordered.
    """

    base: Demand
    scale: tuple[Factor, Factor] = (0.8, 1.2)

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "demand")
        require(self.scale[0] <= self.scale[1], "demand.scale", "(low, high)", self.scale)

    def draw_scale(self, generator: np.random.Generator) -> float:
        """Draw the factor on every rate [-]."""
        return float(generator.uniform(*self.scale))


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
        for name, pair in vars(self).items():
            ordered = name == "segments" or pair[0] <= pair[1]
            require(ordered, f"incident.{name}", "a pair (low, high) with low <= high", pair)

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


def lowest_limit(incidents: Iterable[Incident], segment: int, time: float) -> float | None:
    """Return the lowest limit of incidents on a segment [km/h] at a time [s]; None without any."""
    limits = (
        limit
        for incident in incidents
        if incident.segment == segment
        for start, end, limit in incident.phases
        if start <= time < end
    )
    return min(limits, default=None)


@dataclass(frozen=True)
class Drivers:
    """The car-following model of all vehicles, and its parameters; None leaves SUMO's default.

    Attributes:
        model: `W99` (Wiedemann, 1999), `Krauss` (1998) or `IDM` (Treiber et al., 2000).
        headway: desired time headway [s]: ``tau``, or ``cc1`` of W99.
        acceleration: largest acceleration [m/s^2].
        deceleration: comfortable deceleration [m/s^2].
        speed_deviation: standard deviation of desired speeds over the speed limit.

    Raises:
        ValueError: A value is out of range.
    """

    model: CarFollowing = "W99"
    headway: Headway | None = None
    acceleration: Acceleration | None = None
    deceleration: Acceleration | None = None
    speed_deviation: Annotated[float, Interval(0, 1)] | None = None

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "drivers")

    def attributes(self) -> dict[str, str]:
        """Return the attributes of SUMO's vehicle type."""
        given = {
            "cc1" if self.model == "W99" else "tau": self.headway,
            "accel": self.acceleration,
            "decel": self.deceleration,
            "speedDev": self.speed_deviation,
        }
        values = {name: f"{value:g}" for name, value in given.items() if value is not None}
        return {"carFollowModel": self.model, **values}


@dataclass(frozen=True)
class VehicleClass:
    """A class of vehicles, such as trucks.

    Attributes:
        name: lower-case letters, digits and hyphens.
        share: share of the vehicles that are of this class.
        length: length of a vehicle [m].
        largest_speed: largest speed of a vehicle [km/h]; None for SUMO's default.
        drivers: the car-following model of its vehicles; None for that of the corridor.

    Raises:
        ValueError: A value is out of range.
    """

    name: str
    share: Annotated[float, Interval(0, 1, open_low=True)]
    length: Annotated[float, Interval(1, 50)] = 5.0
    largest_speed: Annotated[float, Interval(1, 300)] | None = None
    drivers: Drivers | None = None

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "vehicle_class")
        is_name = bool(re.fullmatch(r"[a-z][a-z0-9-]*", self.name))
        require(is_name, "vehicle_class.name", "lower-case letters, digits and hyphens", self.name)

    def attributes(self, drivers: Drivers) -> dict[str, str]:
        """Return the attributes of SUMO's vehicle type, given the corridor's drivers."""
        values = (self.drivers or drivers).attributes() | {"length": f"{self.length:g}"}
        if self.largest_speed is not None:
            values["maxSpeed"] = f"{self.largest_speed / KMH:g}"
        return values
