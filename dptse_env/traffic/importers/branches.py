"""Branches of a road, mainline and ramps, and where its record columns lie on them."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.corridor import Corridor
from dptse_env.utils.arrays import FloatArray, IntArray

OFF = -1
"""Branch and column of a point that is not on the road."""


class Road:
    """The record columns of a corridor by branch and position."""

    def __init__(self, corridor: Corridor) -> None:
        """Lay the columns along the road."""
        self.corridor = corridor
        n, first = corridor.n_mainline, corridor.n_segments
        lengths = np.array(corridor.with_boundaries(corridor.segment_lengths))
        self.faces = np.concatenate([[0.0], np.cumsum(lengths[:n])])
        start, end = -lengths[first], self.faces[-1] + lengths[first + 1]
        self.starts: list[FloatArray] = []
        """Start of each column of a branch, ascending, and the end of the last."""
        self.columns: list[IntArray] = []
        """Columns of each branch."""
        self._add([start, *self.faces, end], [first, *range(n), first + 1])
        boundary = itertools.count(first + 2)
        for face, segments in zip(corridor.on_ramps, corridor.on_ramp_segments, strict=True):
            ramp = [next(boundary), *segments]
            before = self.faces[face] - np.cumsum(lengths[ramp][::-1])[::-1]
            starts = [*before, *self.faces[face:], end]
            self._add(starts, [*ramp, *range(face, n), first + 1])
        for face, segments in zip(corridor.off_ramps, corridor.off_ramp_segments, strict=True):
            ramp = [*segments, next(boundary)]
            after = self.faces[face] + np.cumsum(lengths[ramp])
            starts = [start, *self.faces[: face + 1], *after]
            self._add(starts, [first, *range(face), *ramp])
        self.n_branches = 1 + corridor.n_ramps

    def _add(self, starts: list[float], columns: list[int]) -> None:
        self.starts.append(np.array(starts))
        self.columns.append(np.array([*columns, OFF]))

    @property
    def column_starts(self) -> tuple[NDArray[np.int16], FloatArray]:
        """Branch of each record column, and the position at which it starts [km]."""
        n_columns = self.corridor.n_segments + self.corridor.n_boundaries
        branch, start = np.zeros(n_columns, dtype=np.int16), np.zeros(n_columns)
        for number in reversed(range(self.n_branches)):
            columns = self.columns[number][:-1]
            branch[columns], start[columns] = number, self.starts[number][:-1]
        return branch, start

    def column(self, branch: NDArray[np.int16], position: FloatArray) -> NDArray[np.int16]:
        """Return the record column at positions of branches, or `OFF`, shape (n,)."""
        found = np.full(len(position), OFF, dtype=np.int16)
        for number in range(self.n_branches):
            here = branch == number
            if here.any():
                place = np.searchsorted(self.starts[number], position[here], side="right") - 1
                found[here] = self.columns[number][place]  # -1, before the first, is OFF
        return found
