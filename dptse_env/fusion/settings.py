"""Settings of the fusion: the keyword ``fusion`` of an environment."""

from dataclasses import dataclass
from typing import Annotated, Literal

from dptse_env.utils.fields import Interval, checked_fields

ShareSource = Literal["published", "estimated"]
"""Source of the share of connected vehicles: the public one, or the releases."""


@dataclass(frozen=True)
class FusionSettings:
    """Settings by which answers of both kinds of sensors become measurements of all vehicles.

    Attributes:
        share: Source of the share of connected vehicles: ``published``, or ``estimated``, a state
            that is learned from the releases.
        share_deviation: Standard deviation of the prior of an estimated share, over the published
            one.
        share_walk: Standard deviation of a second of its random walk, over the published one.
        speed_spread: Standard deviation of the vehicles' speeds on a segment [km/h], for the
            sampling error of speeds.
        dwell_factor: Allowance for answers of a segment that have the same sampling error, since
            the same vehicles are there: the variance of sampling is multiplied by this factor times
            the seconds that a vehicle spends on the segment, where the product is more than one. It
            suits `recurrent`, whose deviations are honest; filters on the ARZ model trust their
            prediction too much, and err more where answers weigh less.

    Raises:
        ValueError: A value is out of range.
    """

    share: ShareSource = "published"
    share_deviation: Annotated[float, Interval(0.01, 10)] = 0.5
    share_walk: Annotated[float, Interval(0, 1)] = 0.002
    speed_spread: Annotated[float, Interval(0, 100)] = 12.0
    dwell_factor: Annotated[float, Interval(0, 100)] = 0.0

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "fusion")
