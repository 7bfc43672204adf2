"""Settings that every release model has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from dptse_env.privacy import Adjacency, rounded_up
from dptse_env.release.noise import NoiseSource
from dptse_env.utils.validation import Interval, checked_fields

BoundaryInputs = Literal["true", "nominal", "private"]
"""Source of the estimator's inputs at the boundary: measured traffic, public demand, or the
boundary segments' releases."""


class Change(NamedTuple):
    """Change of a vehicle's data between two adjacent records, in words.

    Attributes:
        rows: That of all of its data.
        reports: That of what it reports, where loops count it exactly whatever it reports.
    """

    rows: str
    reports: str


CHANGES: dict[Adjacency, Change] = {
    "replace": Change(
        "replaced by any other, connected or not, or by none", "replaced by others or left out"
    ),
    "add_remove": Change("added or removed", "added or left out"),
}
"""Change of each adjacency."""


@dataclass(frozen=True)
class PrivacySettings:
    """Settings of every release model, the keyword ``privacy``; subclasses add further ones.

    Attributes:
        preset: The release model: ``printed``, ``corrected``, ``capped``, ``paced``, a registered
            name, ``"package.module:Class"``, or a class.
        epsilon: Privacy parameter epsilon.
        delta: Privacy parameter delta.
        boundary_inputs: Source of the estimator's inputs at the boundary: ``true``, ``nominal`` or
            ``private``; None for the model's default.
        noise: Source of the noise: ``seeded``, the episode's stream, for simulation, or ``secure``,
            the operating system's randomness, which nobody can repeat. Both have exactly the same
            distribution. An episode with secure noise stays where it began: its process has no
            `fork`, and a copy, a pickle or an operating system's fork must reset it.

    Raises:
        ValueError: A field is out of range; the message names its path below ``privacy``.
    """

    default_boundary: ClassVar[BoundaryInputs] = "true"

    preset: Any = "printed"
    epsilon: Annotated[float, Interval(1e-4, 1e4)] = 1.0
    delta: Annotated[float, Interval(1e-12, 0.5, open_high=True)] = 0.05
    boundary_inputs: BoundaryInputs | None = None
    noise: NoiseSource = "seeded"

    def __post_init__(self) -> None:
        """Check the fields."""
        checked_fields(self, "privacy")

    @property
    def boundary(self) -> BoundaryInputs:
        """Source of the estimator's inputs at the boundary."""
        return self.boundary_inputs or self.default_boundary

    def guarantee(self, mu: float, quantities: str, protected: str) -> str:
        """Return the sentence that states mu and (epsilon, delta), and what is protected."""
        against = "" if self.noise == "secure" else ", against whoever does not know the seed"
        return (
            f"{rounded_up(mu, '.4g')}-Gaussian differential privacy (rounded up), which is "
            f"({rounded_up(self.epsilon)}, {rounded_up(self.delta)})-differential privacy, of "
            f"{quantities} together, for {protected}{against}"
        )
