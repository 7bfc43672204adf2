"""Settings of release models: the keyword ``privacy`` of an environment."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from dptse_env.privacy import Adjacency
from dptse_env.release.pacing import PACINGS
from dptse_env.utils.fields import Interval, checked_fields

Unit = Literal["trip", "horizon", "event"]
"""Unit of protection: a trip with capped contributions, a complete trip, or a second of it."""

SpeedRelease = Literal["mean", "flow"]
"""Release of speeds: as their mean over a segment's vehicles, or as a sum, the centred flow."""

BoundaryInputs = Literal["true", "nominal", "private"]
"""Source of the estimator's inputs at the boundary: measured traffic, public demand, or the
boundary segments' releases."""


CHANGES: dict[Adjacency, str] = {
    "replace": "replaced by another",
    "add_remove": "added or removed",
}
"""Change of a vehicle's data between two adjacent records, in words."""


@dataclass(frozen=True)
class PrivacySettings:
    """Settings of every release model; subclasses add further ones.

    Attributes:
        preset: The release model: ``paper``, ``corrected``, ``capped``, a registered name,
            ``"package.module:Class"``, or a class.
        epsilon: Privacy parameter epsilon.
        delta: Privacy parameter delta.
        boundary_inputs: Source of the estimator's inputs at the boundary: ``true``, ``nominal`` or
            ``private``; None for the model's default.

    Raises:
        ValueError: A field is out of range; the message names its path below ``privacy``.
    """

    default_boundary: ClassVar[BoundaryInputs] = "true"

    preset: Any = "paper"
    epsilon: Annotated[float, Interval(1e-4, 1e4)] = 1.0
    delta: Annotated[float, Interval(1e-12, 0.5, open_high=True)] = 0.05
    boundary_inputs: BoundaryInputs | None = None

    def __post_init__(self) -> None:
        """Check the fields."""
        checked_fields(self, "privacy")

    @property
    def boundary(self) -> BoundaryInputs:
        """Source of the estimator's inputs at the boundary."""
        return self.boundary_inputs or self.default_boundary

    def guarantee(self, quantities: str, protected: str) -> str:
        """Return the sentence that states (epsilon, delta) for quantities and what is protected."""
        return (
            f"({self.epsilon:g}, {self.delta:g})-differential privacy of {quantities} together, "
            f"for {protected}"
        )


@dataclass(frozen=True)
class CappedSettings(PrivacySettings):
    """Settings of `dptse_env.release.Capped`.

    Attributes:
        unit: Unit of protection: ``trip``, a vehicle's trip, which counts in its first ``cap``
            queried steps; ``horizon``, a trip without a cap, charged for every step of an episode;
            ``event``, one second of a trip.
        cap: Queried steps in which a vehicle counts, for the unit ``trip``.
        adjacency: Difference of two adjacent records: ``replace`` or ``add_remove``.
        share: Part of the budget mu^2 for the density.
        speed_release: ``flow``, or ``mean`` for mean speeds, which void the guarantee.

    Raises:
        ValueError: A field is out of range; the message names its path below ``privacy``.
    """

    default_boundary: ClassVar[BoundaryInputs] = "nominal"

    preset: Any = "capped"
    unit: Unit = "trip"
    cap: Annotated[int, Interval(1, 1_000_000)] = 64
    adjacency: Adjacency = "replace"
    share: Annotated[float, Interval(0.001, 0.999)] = 0.5
    speed_release: SpeedRelease = "flow"

    def __post_init__(self) -> None:
        """Check the fields, and that they are compatible."""
        super().__post_init__()
        if self.speed_release == "mean" and self.adjacency == "add_remove":
            raise ValueError(
                "privacy.adjacency must be 'replace' where mean speeds are released, got "
                "'add_remove': without its one vehicle a segment has no mean"
            )

    @property
    def contribution_cap(self) -> int | None:
        """Queried steps in which a vehicle counts; None if it counts in all of them."""
        return self.cap if self.unit == "trip" else None

    def contributions(self, horizon: int) -> int:
        """Return the most steps of ``horizon`` in which the protected unit can count."""
        return {"trip": min(self.cap, horizon), "horizon": horizon, "event": 1}[self.unit]

    @property
    def protected(self) -> str:
        """Description of the protected data and of the change that is protected."""
        change = CHANGES[self.adjacency]
        return {
            "trip": f"one vehicle's trip, {change}, which counts in {self.cap} queried steps",
            "horizon": f"one vehicle's whole trip, {change}",
            "event": f"one second of one vehicle's trip, {change}",
        }[self.unit]


PacedUnit = Literal["trip", "event"]
"""Unit of protection of the paced ledger: a complete trip, or a second of it."""


@dataclass(frozen=True)
class PacedSettings(PrivacySettings):
    """Settings of `dptse_env.release.Paced`.

    Attributes:
        unit: Unit of protection: ``trip``, all of a vehicle's trip that an episode covers;
            ``event``, one second of a trip.
        adjacency: Difference of two adjacent records: ``replace`` or ``add_remove``.
        pace: Part of the budget that the pacing tries to have spent at the end of a trip.
        clip: Largest deviation D of a speed from its centre that is released [km/h]; larger ones
            are clipped.
        ratio: Ratio r of the charge for a deviation of D and the charge for being counted; noise
            of flows has D / sqrt(r) times the deviation of that of counts. At most 1 for the
            adjacency ``replace``.
        pacing: Rule that sets the prices: ``tracer``, a registered name,
            ``"package.module:Class"``, or a class.

    Raises:
        ValueError: A field is out of range; the message names its path below ``privacy``.
    """

    default_boundary: ClassVar[BoundaryInputs] = "nominal"

    preset: Any = "paced"
    unit: PacedUnit = "trip"
    adjacency: Adjacency = "replace"
    pace: Annotated[float, Interval(0.05, 1)] = 0.85
    clip: Annotated[float, Interval(1, 200)] = 25.0
    ratio: Annotated[float, Interval(0.01, 100)] = 1.0
    pacing: Any = "tracer"

    def __post_init__(self) -> None:
        """Check the fields, and that they are compatible."""
        super().__post_init__()
        PACINGS.find(self.pacing)
        if self.ratio > 1.0 and self.adjacency == "replace":
            raise ValueError(
                "privacy.ratio must be at most 1 for privacy.adjacency 'replace', where two "
                f"vehicles may deviate in opposite directions, got {self.ratio:g}"
            )

    @property
    def protected(self) -> str:
        """Description of the protected data and of the change that is protected."""
        part = "whole trip" if self.unit == "trip" else "second of a trip"
        return f"one vehicle's {part}, {CHANGES[self.adjacency]}"
