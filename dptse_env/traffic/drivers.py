"""Drivers and vehicle classes: how vehicles follow one another in the simulation, and which."""

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from dptse_env.utils.fields import Interval, checked_fields, require

CarFollowing = Literal["W99", "Krauss", "IDM"]
"""SUMO's name of a car-following model."""
Seconds = Annotated[float, Interval(0.1, 10)]
"""A headway [s]."""
Rate = Annotated[float, Interval(0.1, 20)]
"""Change of a speed [m/s^2]."""
Share = Annotated[float, Interval(0, 1)]
"""Part of a whole."""


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
    headway: Seconds | None = None
    acceleration: Rate | None = None
    deceleration: Rate | None = None
    speed_deviation: Share | None = None

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
            values["maxSpeed"] = f"{self.largest_speed / 3.6:g}"
        return values
