"""Statements of sources other than releases: stations of loops, probes, or any other.

`dptse_env.RoadEstimator` takes them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from dptse_env.measurement.loops import UNKNOWN
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import (
    Interval,
    checked_fields,
    inside,
    integer,
    non_negative,
    require,
)

SHORTEST, LONGEST = 10, 600
"""Seconds of a station's interval at least, and of any at most."""


@dataclass(frozen=True)
class Seen:
    """Statement of a source on a part of the road, an average over some seconds.

    Attributes:
        start: Where it begins [km], from the upstream end of the mainline, or of its ramp.
        end: Where it ends [km]. A point counts at the nearest border of two segments, for both, or
            where a ramp is for the one that it lies on. A part of the road counts for the segments
            whose middle it covers.
        density: Density of all lanes [veh/km]; None where it is not known.
        speed: Mean speed [km/h]; None where it is not known.
        density_std: Standard deviation of the density, for any second [veh/km].
        speed_std: Standard deviation of the speed, for any second [km/h].
        seconds: Seconds that it is an average of.
        until: The last of them; None for the present one.
        ramp: Face at which its ramp meets the mainline; None for the mainline.
        flow: Flow of all lanes at a point [veh/h], from which, with the speed, density and
            deviations follow (`dptse_env.measurement.loops.interpreted`); None elsewhere.

    Raises:
        ValueError: A value is out of range or lacks its deviation, or a flow its speed.
    """

    start: Annotated[float, Interval(0, 1e4)]
    end: Annotated[float, Interval(0, 1e4)]
    density: Annotated[float, Interval(0, 1e4)] | None = None
    speed: Annotated[float, Interval(0, 1e3)] | None = None
    density_std: Annotated[float, Interval(1e-3, UNKNOWN)] | None = None
    speed_std: Annotated[float, Interval(1e-3, UNKNOWN)] | None = None
    seconds: Annotated[int, Interval(1, LONGEST)] = 1
    until: int | None = None
    ramp: int | None = None
    flow: Annotated[float, Interval(0, 1e5)] | None = None

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "seen")
        require(self.start <= self.end, "seen.end", f">= start, {self.start:g} km", self.end)
        if self.flow is None:
            for name in ("density", "speed"):
                value, std = getattr(self, name), getattr(self, f"{name}_std")
                allowed = f"a number where {name} is one, and None elsewhere"
                require((value is None) == (std is None), f"seen.{name}_std", allowed, std)
            known = self.density is not None or self.speed is not None
            require(known, "seen.speed", "a number where there is no density", None)
            return
        others = self.density, self.density_std, self.speed_std
        alone, allowed = others == (None,) * 3, "None where there are densities or deviations"
        require(alone, "seen.flow", allowed, self.flow)
        require(self.start == self.end, "seen.end", f"start, {self.start:g} km", self.end)
        known = self.flow == 0.0 or self.speed is not None
        require(known, "seen.speed", "a number where vehicles passed", self.speed)
        allowed = f">= {SHORTEST} where there is a flow"
        require(self.seconds >= SHORTEST, "seen.seconds", allowed, self.seconds)


def station(
    km: float,
    *,
    count: float | None = None,
    flow: float | None = None,
    speed: float | None = None,
    seconds: int,
    until: int | None = None,
    ramp: int | None = None,
) -> Seen:
    """Return what a station of loops says, which counts all vehicles of all lanes.

    Args:
        km: Its place; see `Seen`.
        count: Vehicles that passed in its interval; None where `flow` is given.
        flow: The same as a flow [veh/h]; None where `count` is given.
        speed: Arithmetic mean of their speeds [km/h]; None or NaN where nobody passed.
        seconds: Length of the interval [s], 10 to 600. Add up the counts of shorter ones.
        until: Last second of the interval; None for the present one.
        ramp: See `Seen`.

    Raises:
        ValueError: A value is out of range, both or none of `count` and `flow` are given, or there
            is a count without a speed.
    """
    seconds = integer("station.seconds", seconds, SHORTEST, LONGEST)
    allowed = "given where flow is not, and only there"
    require((count is None) != (flow is None), "station.count", allowed, count)
    if count is None:
        name, passing = "flow", non_negative("station.flow", flow)
    else:
        name, passing = "count", non_negative("station.count", count) * HOUR / seconds
    if passing == 0.0:
        return Seen(km, km, seconds=seconds, until=until, ramp=ramp, flow=0.0)
    require(speed is not None, "station.speed", f"a number where {name} is above 0", speed)
    mean = non_negative("station.speed", speed)
    return Seen(km, km, speed=mean, seconds=seconds, until=until, ramp=ramp, flow=passing)


def probes(
    start: float,
    end: float,
    speed: float,
    *,
    vehicles: int,
    seconds: int,
    until: int | None = None,
    ramp: int | None = None,
    spread: float = 12.0,
) -> Seen:
    """Return what the mean speed of some vehicles on a part of the road says, of the speed alone.

    Args:
        start: Where the part begins [km]; see `Seen`.
        end: Where it ends.
        speed: Their mean speed [km/h].
        vehicles: Their number.
        seconds: Length of the interval [s].
        until: Last second of the interval; None for the present one.
        ramp: See `Seen`.
        spread: Standard deviation of the speeds of vehicles in the same place [km/h].

    Raises:
        ValueError: A value is out of range.
    """
    n = integer("probes.vehicles", vehicles, 1, 10**6)
    std = max(inside("probes.spread", spread, 0.0, 1e3) / n**0.5, 0.1)
    return Seen(start, end, None, speed, None, std, seconds, until, ramp)
