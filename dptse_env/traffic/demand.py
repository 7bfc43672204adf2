"""Demand: arrival rates of vehicles, fixed or drawn for every traffic seed."""

import dataclasses
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from dptse_env.utils.fields import Interval, checked_fields, require

Rate = Annotated[float, Interval(0, 100_000)]
"""Vehicles an hour."""
Second = Annotated[float, Interval(0, 1e6)]
"""Seconds of simulated time."""
Profile = tuple[tuple[Second, Rate], ...]
"""Steps (time [s], rate [veh/h]): each rate holds until the next time, the last one to the end."""
Share = Annotated[float, Interval(0, 1, open_low=True, open_high=True)]
"""Share of the vehicles that pass an off-ramp."""
ShareProfile = tuple[tuple[Second, Share], ...]
"""Steps (time [s], share), as in a `Profile`."""
Factor = Annotated[float, Interval(0, 100, open_low=True)]
"""Factor on every rate."""


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

    def draw(self, generator: np.random.Generator) -> Demand:
        """Draw one demand."""
        return self.base.scaled(self.draw_scale(generator))

    def draw_scale(self, generator: np.random.Generator) -> float:
        """Draw the factor on every rate [-]."""
        return float(generator.uniform(*self.scale))
