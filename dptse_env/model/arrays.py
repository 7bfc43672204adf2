"""Arguments of kernels beside a `dptse_env.road.Road`: channels, and numbers of the model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dptse_env.road import Road
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class Channels(NamedTuple):
    """C sums or averages over neighbouring cells, which are measured and have two numbers each.

    The first M are those that estimators are given; those of boundary cells follow.
    """

    first: IntArray  # (C,) first cell
    span: IntArray  # (C,) number of cells
    group: IntArray  # (C,) which vehicles it sees and whose budget it spends, ascending
    length: FloatArray  # (C,) [km]

    @classmethod
    def of_segments(cls, road: Road) -> Channels:
        """Return the channels of a road whose segments are measured one by one."""
        S = road.n_segments
        one, none = np.ones(S, dtype=np.int64), np.zeros(S, dtype=np.int64)
        return cls(np.arange(S), one, none, road.lengths[:S])

    @property
    def size(self) -> int:
        """Number of channels C."""
        return self.first.size

    def head(self, n: int) -> Channels:
        """Return the first n channels."""
        return Channels(self.first[:n], self.span[:n], self.group[:n], self.length[:n])

    def covers(self, n_cells: int) -> BoolArray:
        """Return flags of the cells that each channel covers, shape (C, n_cells)."""
        return covered(self.first, self.span, n_cells)

    def averaging(self, n_cells: int) -> FloatArray:
        """Return weights of cells in the averages of channels, shape (C, n_cells)."""
        weights: FloatArray = self.covers(n_cells) / self.span[:, None]
        return weights

    def __deepcopy__(self, memo: object) -> Channels:
        """Return the same arrays, which copies of an environment share."""
        return self


def covered(first: IntArray, span: IntArray, n: int) -> BoolArray:
    """Return flags of n neighbours: True for `span` (C,) of them from `first` (C,) on, (C, n)."""
    cell = np.arange(n) - first[:, None]
    inside: BoolArray = (cell >= 0) & (cell < span[:, None])
    return inside


class ARZ(NamedTuple):
    """Numbers of a model on a road of S segments and R boundary cells; nothing changes them."""

    free_flow_speed: float  # v_f [km/h]
    gamma: float  # exponent of the pressure
    step_ratio: FloatArray  # (S,) T / l [h/km]
    relaxation: float  # T / tau
    kept: float  # exp(-T / memory), what a step keeps of a demand factor's distance from 1
    jam: FloatArray  # (S + R,) jam densities rho_m of cells [veh/km]
    term_weight: FloatArray  # (T,) weight of the outflow's gradient in the Jacobian [h/km]
    second_scale: float  # unit of the second number of a channel [km/h or veh/h]

    def __deepcopy__(self, memo: object) -> ARZ:
        """Return the same arrays, which copies of a filter share."""
        return self
