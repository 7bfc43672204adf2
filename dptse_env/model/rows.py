"""Rows of a measurement: averages over one or several neighbouring segments."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


def covered(first: IntArray, span: IntArray, n: int) -> BoolArray:
    """Return flags of n neighbours in a row: True for `span` of them from `first` on.

    Shape (M, n), for `first` and `span` of shape (M,).
    """
    place = np.arange(n) - first[:, None]
    inside: BoolArray = (place >= 0) & (place < span[:, None])
    return inside


@dataclass(frozen=True, eq=False)
class MeasurementRows:
    """The M rows that a measurement may have, each an average over neighbouring segments.

    A row has two numbers: the average density, and the average centred flow, of its segments.

    Attributes:
        first: The first segment of each row, shape (M,).
        span: The number of segments of each row, shape (M,).
        n_segments: Segments S of the road.

    Raises:
        ValueError: A row is empty or leaves the road.
    """

    first: IntArray
    span: IntArray
    n_segments: int

    def __post_init__(self) -> None:
        """Check that every row lies on the road."""
        for row, (first, span) in enumerate(zip(self.first, self.span, strict=True)):
            if not (span >= 1 and first >= 0 and first + span <= self.n_segments):
                raise ValueError(
                    f"rows[{row}] must cover segments in 0..{self.n_segments - 1}, got "
                    f"{span} from {first} on"
                )

    @classmethod
    def single(cls, n_segments: int) -> MeasurementRows:
        """Return the rows of a road whose segments are measured one by one."""
        return cls(np.arange(n_segments), np.ones(n_segments, dtype=np.int64), n_segments)

    @property
    def n_rows(self) -> int:
        """Number of rows M."""
        return self.first.size

    @cached_property
    def are_single(self) -> bool:
        """True if row s is segment s, for all segments."""
        every = np.arange(self.n_segments)
        return bool((self.span == 1).all()) and np.array_equal(self.first, every)

    @cached_property
    def weights(self) -> FloatArray:
        """Weights of the segments in each row, shape (M, S): 1 / span of those it covers."""
        inside = covered(self.first, self.span, self.n_segments)
        return np.where(inside, 1.0 / self.span[:, None], 0.0)

    def averages(self, values: FloatArray) -> FloatArray:
        """Return the rows' averages, shape (n, M, 2), of values of shape (n, S, 2)."""
        if self.are_single:
            return values
        averages: FloatArray = np.einsum("ms,nsk->nmk", self.weights, values)
        return averages
