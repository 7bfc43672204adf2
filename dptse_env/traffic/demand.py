"""Demand: arrival rates of vehicles, fixed or drawn for every traffic seed."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dptse_env.utils.fields import Interval, checked_fields
from dptse_env.utils.validation import require

Rate = Annotated[float, Interval(0, 100_000)]
"""Vehicles an hour."""
Second = Annotated[float, Interval(0, 1e6)]
"""Seconds of simulated time."""
Factor = Annotated[float, Interval(0, 100, open_low=True)]
"""Factor on every rate."""


@dataclass(frozen=True)
class Demand:
    """Mean arrival rates; the arrivals themselves are Poisson.

    Attributes:
        mainline: steps (time [s], rate [veh/h]); each rate holds until the next time, the first
            time is 0 and the last rate holds until the end.
        on_ramps: one constant rate [veh/h] per on-ramp.

    Raises:
        ValueError: A rate is negative, or the times do not start at 0 and increase.
    """

    mainline: tuple[tuple[Second, Rate], ...]
    on_ramps: tuple[Rate, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "demand")
        times = np.array([time for time, _ in self.mainline])
        increasing = len(times) > 0 and times[0] == 0.0 and bool(np.all(np.diff(times) > 0))
        allowed = "steps (time, rate) whose times start at 0 and increase"
        require(increasing, "demand.mainline", allowed, self.mainline)

    def scaled(self, factor: float) -> "Demand":
        """Return this demand with every rate multiplied by `factor` [-]."""
        return Demand(
            mainline=tuple((time, rate * factor) for time, rate in self.mainline),
            on_ramps=tuple(rate * factor for rate in self.on_ramps),
        )


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

    def draw(self, generator: np.random.Generator) -> Demand:
        """Draw one demand."""
        return self.base.scaled(self.draw_scale(generator))

    def draw_scale(self, generator: np.random.Generator) -> float:
        """Draw the factor on every rate [-]."""
        return float(generator.uniform(*self.scale))
