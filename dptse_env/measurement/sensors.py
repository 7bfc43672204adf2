"""Connected vehicles and fixed sensors: their groups of channels, and errors of the latter."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.release import Group, Request, Task
from dptse_env.traffic import Corridor, Penetration
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.validation import Interval, checked_fields

CountFactor = Annotated[float, Interval(0, 10)]
"""A factor on a sensor's count."""


@dataclass(frozen=True)
class SensorSettings:
    """Errors of the fixed sensors beside the noise of the release, and their part of the budget.

    A sensor reports ``factor`` times what is released of it, plus a normal error whose standard
    deviation is ``absolute`` vehicles plus ``relative`` times the count. Of these, ``absolute`` and
    ``relative`` are known to the estimator, and ``factor`` is not.

    Attributes:
        factor: Factor on counts and flows: one for all sensors, or one for each of the corridor's
            fixed sensors, in their order.
        dropout: Probability that a sensor does not answer in a second.
        absolute: Standard deviation of a count at zero vehicles [veh].
        relative: Further standard deviation, as a share of the count.
        budget_share: Part of the privacy budget mu^2 of a connected vehicle that pays for the fixed
            sensors; None for 1 / (1 + 3 sqrt(p)), which grows from a quarter as the share p of
            connected vehicles falls, and answers of queries with it tell less.

    Raises:
        ValueError: A value is out of range, or ``relative`` is positive and ``absolute`` is 0, so
            that a count of zero vehicles would have no error.
    """

    factor: CountFactor | tuple[CountFactor, ...] = 1.0
    dropout: Annotated[float, Interval(0, 1, open_high=True)] = 0.0
    absolute: Annotated[float, Interval(0, 1000)] = 0.0
    relative: Annotated[float, Interval(0, 10)] = 0.0
    budget_share: Annotated[float, Interval(0.01, 0.99)] | None = None

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "sensor_settings")
        if self.relative > 0.0 and self.absolute == 0.0:
            raise ValueError(
                "sensor_settings.absolute must be > 0 where sensor_settings.relative is, or a "
                f"count of zero vehicles would have no error, got {self.absolute:g}"
            )

    @property
    def are_exact(self) -> bool:
        """True if sensors have no errors."""
        return replace(self, budget_share=SensorSettings.budget_share) == SensorSettings()


def make_groups(
    penetration: Penetration,
    settings: SensorSettings,
    corridor: Corridor,
    *,
    private_boundary: bool,
) -> tuple[Group, ...]:
    """Return the groups of channels.

    A query sums over the connected vehicles of its segments, a fixed sensor over all vehicles of
    its segment. They share no ledger, since a fixed sensor cannot tell which vehicle is which: each
    group has a part of the budget mu^2 for the trip of a vehicle. The squared parameters of groups
    add up to that of a connected vehicle (composition of Gaussian mechanisms); a vehicle that is
    not connected is seen by the fixed sensors alone and has their smaller parameter.

    Where all vehicles are connected and sensors have no errors there is one group, and one
    ledger; without fixed sensors or private boundary segments the queries have the whole budget.
    """
    if penetration.is_complete and settings == SensorSettings():
        return (Group("queries"),)
    if not (corridor.fixed_sensors or private_boundary):
        return (Group("queries", 1.0, penetration),)
    share = settings.budget_share
    if share is None:
        share = 1.0 / (1.0 + 3.0 * math.sqrt(penetration.published_share))
    return Group("queries", 1.0 - share, penetration), Group("sensors", share)


class SensorErrors:
    """Errors of the F fixed sensors in a batch of n episodes; they are no part of a release.

    They are drawn for every sensor and second, whatever is queried, from streams of their own. Who
    does not answer is not asked; what is released of the others has its guarantee before its error.
    """

    def __init__(self, task: Task, settings: SensorSettings) -> None:
        """Prepare for episodes."""
        self._settings, self._channels = settings, task.sensors
        self._length, self._releases_flow = task.channels.length[task.sensors], task.releases_flow
        self._factor = np.broadcast_to(np.array(settings.factor, np.float64), task.sensors.shape)
        self._streams: dict[int, np.random.Generator] = {}

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes, shape (k,), with a stream for each."""
        self._streams |= dict(zip(episodes.tolist(), generators, strict=True))

    def answering(self, request: Request) -> Request:
        """Return a request without the sensors that do not answer in this second."""
        silent = self._drawn(request.episodes, "random") < self._settings.dropout
        observed: BoolArray = request.observed.copy()
        observed[:, self._channels] &= ~silent
        return request._replace(observed=observed)

    def added(self, episodes: IntArray, released: Measurement) -> Measurement:
        """Return a release with the errors of this second; mean speeds are not affected."""
        values, sigma = released.values.copy(), released.sigma.copy()
        settings, channels = self._settings, self._channels
        density = values[:, channels, 0] * self._factor
        error = settings.absolute / self._length + settings.relative * np.maximum(
            density, 0.0
        )  # [veh/km]
        values[:, channels, 0] = density + error * self._drawn(episodes, "standard_normal")
        sigma[:, channels, 0] = np.hypot(sigma[:, channels, 0], error)
        if self._releases_flow:
            values[:, channels, 1] *= self._factor
        return released._replace(values=values, sigma=sigma)

    def _drawn(self, episodes: IntArray, kind: str) -> FloatArray:
        """Return a draw for each sensor of k episodes, shape (k, F)."""
        rows = [self._streams[episode] for episode in episodes.tolist()]
        return np.stack([getattr(row, kind)(self._channels.size) for row in rows])
