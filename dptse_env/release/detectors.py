"""Fixed sensors as a mechanism of their own: their errors, and their part of the budget."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.fields import Interval, checked_fields

CountFactor = Annotated[float, Interval(0, 10)]
"""A factor on a detector's count."""


@dataclass(frozen=True)
class Detectors:
    """Errors of the fixed sensors beside the noise of the release, and their part of the budget.

    A detector reports ``factor`` times what is released of it, plus a normal error whose standard
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
        checked_fields(self, "detectors")
        if self.relative > 0.0 and self.absolute == 0.0:
            raise ValueError(
                "detectors.absolute must be > 0 where detectors.relative is, or a count of zero "
                f"vehicles would have no error, got {self.absolute:g}"
            )

    def part_of_budget(self, share: float) -> float:
        """Return their part of the budget, given the published share of connected vehicles."""
        if self.budget_share is not None:
            return self.budget_share
        return 1.0 / (1.0 + 3.0 * math.sqrt(share))

    @property
    def are_exact(self) -> bool:
        """True if detectors have no errors."""
        return replace(self, budget_share=Detectors.budget_share) == Detectors()


class DetectorErrors:
    """Errors of the F fixed sensors in a batch of n episodes.

    They are drawn for every sensor and second, whatever is queried, and change released values
    alone: what is released of a vehicle has its guarantee before.
    """

    def __init__(
        self, detectors: Detectors, columns: IntArray, lengths: FloatArray, n_episodes: int
    ) -> None:
        """Prepare for episodes.

        Args:
            detectors: Their errors.
            columns: Column of each sensor in its release, shape (F,).
            lengths: Length of each sensor's segment [km], shape (F,).
            n_episodes: Size n of the batch.
        """
        self._detectors, self._columns, self._lengths = detectors, columns, lengths
        self._factor = np.broadcast_to(np.array(detectors.factor, dtype=np.float64), columns.shape)
        self._streams: list[np.random.Generator | None] = [None] * n_episodes

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes, shape (k,), with a stream for each."""
        for episode, generator in zip(episodes.tolist(), generators, strict=True):
            self._streams[episode] = generator

    def silent(self, episodes: IntArray) -> BoolArray:
        """Draw which sensors do not answer in this second, shape (k, F)."""
        silent: BoolArray = self._drawn(episodes, "random") < self._detectors.dropout
        return silent

    def apply(
        self, episodes: IntArray, released: Measurement, *, releases_flow: bool
    ) -> Measurement:
        """Return a release with the errors of this second; columns that are no sensor keep theirs.

        Mean speeds are not affected.
        """
        values, columns = released.values.copy(), self._columns
        sigma = released.sigma.copy()
        detectors, density = self._detectors, values[:, columns, 0] * self._factor
        error = detectors.absolute / self._lengths + detectors.relative * np.maximum(
            density, 0.0
        )  # [veh/km]
        values[:, columns, 0] = density + error * self._drawn(episodes, "standard_normal")
        sigma[:, columns, 0] = np.hypot(sigma[:, columns, 0], error)
        if releases_flow:
            values[:, columns, 1] *= self._factor
        return released._replace(values=values, sigma=sigma)

    def _drawn(self, episodes: IntArray, kind: str) -> FloatArray:
        """Return a draw for each sensor of k episodes, shape (k, F)."""
        rows = [self._stream(episode) for episode in episodes.tolist()]
        return np.stack([getattr(row, kind)(self._columns.size) for row in rows])

    def _stream(self, episode: int) -> np.random.Generator:
        stream = self._streams[episode]
        if stream is None:
            raise RuntimeError(f"episode {episode} was released before its first reset")
        return stream
