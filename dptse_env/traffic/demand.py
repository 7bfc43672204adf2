"""How many vehicles want to enter: a fixed demand, or a range from which each seed draws one."""

from dataclasses import dataclass

import numpy as np

from dptse_env.validation import interval, non_negative, require, sequence


@dataclass(frozen=True)
class Demand:
    """Mean arrival rates; the arrivals themselves are Poisson.

    Attributes:
        mainline: steps (time [s], rate [veh/h]); each rate holds until the next time, the first
            time is 0 and the last rate holds until the end.
        on_ramps: one constant rate [veh/h] per on-ramp.

    Raises:
        ValueError: if a rate is negative or the times do not start at 0 and increase.
    """

    mainline: tuple[tuple[float, float], ...]
    on_ramps: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        steps = []
        for i, step in enumerate(sequence("demand.mainline", self.mainline)):
            time, rate = sequence(f"demand.mainline[{i}]", step, length=2)
            steps.append(
                (
                    non_negative(f"demand.mainline[{i}] time", time),
                    non_negative(f"demand.mainline[{i}] rate", rate),
                )
            )
        times = np.array([time for time, _ in steps])
        require(
            len(times) > 0 and times[0] == 0.0 and bool(np.all(np.diff(times) > 0)),
            "demand.mainline",
            "steps (time, rate) whose times start at 0 and increase",
            self.mainline,
        )
        ramps = tuple(
            non_negative(f"demand.on_ramps[{i}]", rate)
            for i, rate in enumerate(sequence("demand.on_ramps", self.on_ramps))
        )
        object.__setattr__(self, "mainline", tuple(steps))
        object.__setattr__(self, "on_ramps", ramps)

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
        ValueError: if the range is not positive and ordered.
    """

    base: Demand
    scale: tuple[float, float] = (0.8, 1.2)

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        object.__setattr__(self, "scale", interval("demand.scale", self.scale))

    def draw(self, generator: np.random.Generator) -> Demand:
        """Draw one demand."""
        return self.base.scaled(float(generator.uniform(*self.scale)))
