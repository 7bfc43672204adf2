"""Ledgers of vehicles: what each has paid of its privacy budget, contribution by contribution.

A vehicle on a queried segment contributes (1, d) to the sums of the query, with d its speed less
the segment's centre, clipped to [-D, D], and pays ``a (1 + r d^2 / D^2)`` for it, with the price a
of the query and the ratio r. It contributes if its ledger covers the charge, and otherwise neither
contributes nor pays. Whether it does depends on its own trip and on public numbers alone.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.model.network import covered
from dptse_env.release.vehicle_table import VehicleTable, widened
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import kernel


class Columns(NamedTuple):
    """Record columns that each of the C columns of a release covers.

    Attributes:
        first: The first record column of each, shape (C,).
        span: The number of neighbouring record columns of each, shape (C,).
        n_places: Record columns: the segments, and the boundary segments if they are released.
    """

    first: IntArray
    span: IntArray
    n_places: int


class Sums(NamedTuple):
    """True sums of a second, before noise.

    Attributes:
        counts: Numbers of vehicles that contribute, shape (k, C).
        deviations: Sums of their d [km/h], shape (k, C).
        refused: Contributions that ledgers did not cover, shape (k,).
    """

    counts: FloatArray
    deviations: FloatArray
    refused: IntArray


class Ledgers:
    """Ledgers of the vehicles of a set of records, in each episode.

    Attributes:
        budget: Largest total that a vehicle can pay.
        clip: D [km/h].
        ratio: r.
        vehicles: The vehicles by second.
        n_places: Record columns that can be covered.
        covers: Whether a column covers a record column, 1 or 0, shape (C, n_places).
        are_single: Whether no two columns cover the same record column.
        paid: What each vehicle has paid, shape (n_episodes, n_vehicles); as wide as the largest
            record loaded.
    """

    def __init__(
        self,
        columns: Columns,
        vehicles: VehicleTable,
        n_episodes: int,
        *,
        budget: float,
        clip: float,
        ratio: float,
    ) -> None:
        """Prepare for the records that will be loaded; no vehicle has paid anything."""
        self.budget, self.clip, self.ratio = budget, clip, ratio
        self.vehicles = vehicles
        self.paid: FloatArray = np.zeros((n_episodes, 0))
        self._columns = columns
        self.n_places = columns.n_places
        self.covers = covered(columns.first, columns.span, columns.n_places).astype(np.float64)
        self.are_single = bool((self.covers.sum(axis=0) <= 1.0).all())

    def load(self, slot: int, record: Record) -> None:
        """Read the vehicles of a record."""
        self.vehicles.load(slot, record)
        self.paid = widened(self.paid, record.n_vehicles)

    def reset(self, episodes: IntArray) -> None:
        """Begin new budgets in episodes of shape (k,)."""
        self.paid[episodes] = 0.0

    def paid_by(self, episode: int, slot: int) -> FloatArray:
        """Return what each vehicle of a slot's record has paid, shape (n_vehicles,)."""
        return self.paid[episode, : self.vehicles.n_vehicles[slot]].copy()

    def collect(
        self,
        episodes: IntArray,
        slots: IntArray,
        times: IntArray,
        observed: BoolArray,
        prices: FloatArray,
        centre: FloatArray,
    ) -> Sums:
        """Sum the contributions of a step to the observed columns, and charge the vehicles.

        Args:
            episodes: Shape (k,).
            slots: Slots of their records, shape (k,).
            times: Seconds of the records, shape (k,).
            observed: Shape (k, C).
            prices: Price a of each column, shape (k, C).
            centre: Centre of each record column [km/h], shape (k, n_places).
        """
        counts, deviations = np.zeros((2, *observed.shape))
        refused = np.zeros(len(episodes), dtype=np.int64)
        table, columns = self.vehicles, self._columns
        _collect(
            columns.first, columns.span, columns.n_places, table.start, table.vehicle,
            table.segment, table.speed, episodes, slots, times, observed, prices, centre,
            self.clip, self.ratio, self.budget, self.paid, counts, deviations, refused,
        )  # fmt: skip
        return Sums(counts, deviations, refused)


@kernel
def _collect(
    first: IntArray,
    span: IntArray,
    n_places: int,
    start: IntArray,
    vehicle: NDArray[np.int32],
    segment: NDArray[np.int16],
    speed: NDArray[np.float32],
    episodes: IntArray,
    slots: IntArray,
    times: IntArray,
    observed: BoolArray,
    prices: FloatArray,
    centre: FloatArray,
    clip: float,
    ratio: float,
    budget: float,
    paid: FloatArray,
    counts: FloatArray,
    deviations: FloatArray,
    refused: IntArray,
) -> None:
    n_columns = first.size
    n_covering = np.empty(n_places, dtype=np.int64)
    covering = np.empty((n_places, n_columns), dtype=np.int64)
    for k in range(episodes.size):
        n_covering[:] = 0
        for c in range(n_columns):
            if observed[k, c]:
                for s in range(first[c], first[c] + span[c]):
                    covering[s, n_covering[s]] = c
                    n_covering[s] += 1
        ledger = paid[episodes[k]]
        for row in range(start[slots[k], times[k]], start[slots[k], times[k] + 1]):
            s, v = segment[row], vehicle[row]
            if s >= n_places:
                continue
            # A vehicle pays for every query that covers it, in the order of the columns.
            for i in range(n_covering[s]):
                c = covering[s, i]
                d = min(max(speed[row] - centre[k, s], -clip), clip)
                cost = prices[k, c] * (1.0 + ratio * d * d / (clip * clip))
                if ledger[v] + cost <= budget:
                    ledger[v] += cost
                    counts[k, c] += 1.0
                    deviations[k, c] += d
                else:
                    refused[k] += 1
