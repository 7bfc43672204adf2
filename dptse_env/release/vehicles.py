"""The true traffic in memory, and what vehicles contribute to the sums of a release.

A vehicle on an observed channel contributes (1, d) to its sums, with d its speed less the centre of
its cell, clipped to [-D, D] and rounded to the grid of the channel's noise, and pays
``a (1 + r d^2 / D^2)`` for it, with the price a of the channel and the ratio r. Sums of integers
are exact in any order, so that other vehicles cancel exactly between two records.

A vehicle has a ledger for each group of channels, and contributes if that covers the charge;
otherwise it neither contributes nor pays. Whether it does depends on its own trip and on public
numbers, never on other vehicles: removing one from a record does not change the contributions of
the others. A price of 1, a ratio of 0 and a budget of C is a cap: a vehicle counts in its first C
observed steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from dptse_env.model import Channels
from dptse_env.release.noise import grid_of
from dptse_env.traffic import (
    MOST_VEHICLES,
    Corridor,
    Penetration,
    Record,
    RecordLibrary,
    readings,
)
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, kernel
from dptse_env.utils.validation import require

GROWTH = 1.5
"""Factor on the size of full tables."""

NumberT = TypeVar("NumberT", bound=np.generic)


class VehicleRows(NamedTuple):
    """The vehicles of a second of k episodes: ranges of rows in a table of all that are loaded.

    Attributes:
        start: First row of each episode, shape (k,).
        stop: The row after its last, shape (k,).
        vehicle: Index of a row's vehicle in its record, shape (rows,).
        cell: Cell that it is on, shape (rows,).
        speed: Speed that it reports to each group of channels [km/h], shape (groups, rows);
            negative where the group does not see it.
    """

    start: IntArray
    stop: IntArray
    vehicle: NDArray[np.int32]
    cell: NDArray[np.int16]
    speed: NDArray[np.float32]


class Traffic:
    """The true traffic of a set of traffic seeds, in memory: per segment, and vehicle by vehicle.

    Aggregates are computed once per record and stored in one table, so that a batch of episodes
    reads its traffic with a single index. A mean speed is over vehicles; an empty segment has its
    speed limit, so that no gap reveals that it is empty.

    Attributes:
        corridor: The road.
        seeds: The traffic seeds.
        library: Source of the records.
        populations: Vehicles that each group of channels sees, None for all; none where vehicles
            are not read.
        n_vehicles: Vehicles of each record, shape (n_seeds,); 0 where vehicles are not read.
        readings: What each of the F loops reports at the end of each interval, as
            `dptse_env.traffic.readings` gives it, shape (n_seeds, K, F, 2).
    """

    def __init__(
        self,
        corridor: Corridor,
        seeds: tuple[int, ...],
        library: RecordLibrary,
        populations: Sequence[Penetration | None] = (),
    ) -> None:
        """Prepare tables; nothing is loaded or recorded yet."""
        self.corridor, self.seeds, self.library = corridor, seeds, library
        self.populations = tuple(populations)
        columns = corridor.geometry.n_cells
        # np.empty takes address space, not memory, until a record is written.
        self._table = np.empty((len(seeds), corridor.conditions.duration + 1, columns, 2))
        self._loaded = np.zeros(len(seeds), dtype=bool)
        self.n_vehicles: IntArray = np.zeros(len(seeds), dtype=np.int64)
        self._start: IntArray = np.zeros(
            (len(seeds), corridor.conditions.duration + 2), dtype=np.int64
        )
        self._vehicle: NDArray[np.int32] = np.empty(0, dtype=np.int32)
        self._cell: NDArray[np.int16] = np.empty(0, dtype=np.int16)
        self._speed: NDArray[np.float32] = np.empty((len(self.populations), 0), dtype=np.float32)
        self._n_rows = 0
        self._derived: list[tuple[FloatArray, Callable[[int], FloatArray]]] = []
        loops, n_stations = corridor.loops, len(corridor.stations.positions)
        n_intervals = 0 if loops is None else corridor.conditions.duration // loops.interval
        self.readings: FloatArray = np.empty((len(seeds), n_intervals, n_stations, 2))

    def derived(self, shape: tuple[int, ...], of: Callable[[int], FloatArray]) -> FloatArray:
        """Return a table of what follows from each record, shape (n_seeds, *shape).

        It has the rows of what is loaded, and `load` writes the others.

        Args:
            shape: Shape of a row.
            of: Returns the row of a record by its index.
        """
        # np.empty takes address space, not memory, until a record is written.
        table = np.empty((len(self.seeds), *shape))
        for index in np.flatnonzero(self._loaded).tolist():
            table[index] = of(index)
        self._derived.append((table, of))
        return table

    def load(self, indices: npt.ArrayLike) -> None:
        """Load the records of some traffic seeds that are not in memory.

        Records that are missing on disk are made, on all cores where there are several.

        Raises:
            ValueError: A record is a measured field, and vehicles are read.
        """
        new = [index for index in np.unique(indices).tolist() if not self._loaded[index]]
        if len(new) > 1:
            self.library.ensure(self.corridor, [self.seeds[index] for index in new])
        for index in new:
            record, road = self.record(index), self.corridor.road
            self._table[index] = record.traffic(road.lengths, road.limits)
            if self.populations:
                self._append(index, record)
            if (loops := self.corridor.loops) is not None:
                self.readings[index] = readings(record, self.corridor.stations, loops)
            for table, of in self._derived:
                table[index] = of(index)
            self._loaded[index] = True

    def record(self, index: int) -> Record:
        """Return the record of ``seeds[index]``, which is made now if it is missing."""
        return self.library.get(self.corridor, self.seeds[index])

    def aggregates(
        self, indices: IntArray, times: IntArray, n_cells: int | None = None
    ) -> FloatArray:
        """Return density [veh/km] and mean speed [km/h] of every segment, shape (k, S, 2).

        Args:
            indices: Indices of loaded traffic seeds, shape (k,).
            times: Seconds of their records, shape (k,).
            n_cells: Number of cells; None for the S segments.
        """
        rows: FloatArray = self._table[indices, times, : n_cells or self.corridor.road.n_segments]
        return rows

    def complete(self, index: int) -> FloatArray:
        """Return density and speed of all segments over a complete record, (T + 1, S + R, 2).

        The boundary segments come last, in the order of `dptse_env.traffic.corridor`.
        """
        traffic: FloatArray = self._table[index]
        return traffic

    def vehicles(self, indices: IntArray, times: IntArray) -> VehicleRows:
        """Return the vehicles of a second of k episodes; arguments are as in `aggregates`."""
        at = indices * self._start.shape[1] + times
        start, stop = self._start.take(at), self._start.take(at + 1)  # quicker than two indices
        return VehicleRows(start, stop, self._vehicle, self._cell, self._speed)

    def _append(self, index: int, record: Record) -> None:
        """Append the vehicles of a record, with what each group sees of them."""
        record = record.vehicles_for("the release model, or the keyword penetration,")
        end = self._n_rows + record.n_rows
        if end > self._vehicle.size:
            size = max(end, int(GROWTH * self._vehicle.size))
            self._vehicle, self._cell = _longer(self._vehicle, size), _longer(self._cell, size)
            self._speed = _longer(self._speed, size)
        rows = slice(self._n_rows, end)
        self._vehicle[rows], self._cell[rows] = record.vehicle, record.segment
        for group, population in enumerate(self.populations):
            self._speed[group, rows] = (
                record.speed if population is None else population.speeds(self.seeds[index], record)
            )
        self._start[index] = self._n_rows + record.offsets
        self.n_vehicles[index] = record.n_vehicles
        self._n_rows = end


def _longer(column: NDArray[NumberT], size: int) -> NDArray[NumberT]:
    """Return a copy with a longer last axis; values beyond its end are undefined."""
    longer = np.empty((*column.shape[:-1], size), dtype=column.dtype)
    longer[..., : column.shape[-1]] = column
    return longer


class Terms(NamedTuple):
    """Terms on which vehicles pay; by default no contribution is clipped or costs by its speed.

    Attributes:
        budget: Largest total that a vehicle can pay in each group, shape (groups,).
        ratio: r, at most 1 where vehicles are replaced: two may deviate in opposite directions.
        clip: D [km/h].
        fastest: Speed that reports are clipped to [km/h], a float32 as reports are.
    """

    budget: FloatArray
    ratio: float = 0.0
    clip: float = math.inf
    fastest: np.float32 = np.float32(math.inf)


class Ledgers:
    """Ledgers of the vehicles of each episode: what each has paid in each group of channels.

    Attributes:
        terms: Budgets, and what is charged.
        paid: What each vehicle has paid, shape (n, groups, vehicles); as wide as the largest record
            so far.
    """

    def __init__(self, channels: Channels, n_episodes: int, terms: Terms) -> None:
        """Prepare for n episodes."""
        self.terms = terms
        self.paid: FloatArray = np.zeros((n_episodes, terms.budget.size, 0))
        self._bundle = Bundle(channels, terms)

    def reset(self, episodes: IntArray, n_vehicles: IntArray | None = None) -> None:
        """Clear the ledgers of episodes (k,), with room for the vehicles of every record."""
        most = 0 if n_vehicles is None else int(n_vehicles.max())
        if most > self.paid.shape[2]:
            wider = np.zeros((*self.paid.shape[:2], most))
            wider[..., : self.paid.shape[2]] = self.paid
            self.paid = wider
        self.paid[episodes] = 0.0

    def collect(
        self,
        episodes: IntArray,
        observed: BoolArray,
        rows: VehicleRows,
        prices: FloatArray,
        centre: FloatArray,
        sigma: FloatArray,
    ) -> tuple[FloatArray, IntArray]:
        """Sum the contributions of a second to the observed channels, and charge the vehicles.

        Args:
            episodes: Shape (k,).
            observed: Channels that are observed, shape (k, C).
            rows: The vehicles of the second.
            prices: Price a of each channel, shape (k, C).
            centre: Centre at each cell [km/h], shape (k, S + R).
            sigma: Standard deviations of the noise of both sums, shape (k, C, 2).

        Returns:
            The sums of vehicles and of their d [km/h], shape (k, C, 2), exact multiples of the grid
            of the noise and zero where not observed; and the contributions that ledgers did not
            cover, shape (k, groups).
        """
        return _collect(self._bundle, rows, episodes, observed, prices, centre, sigma, self.paid)

    def of(self, episodes: IntArray, n_vehicles: IntArray) -> list[FloatArray]:
        """Return what each vehicle of k episodes has paid, arrays of shape (groups, n_vehicles)."""
        pairs = zip(episodes.tolist(), n_vehicles.tolist(), strict=True)
        return [self.paid[episode, :, :n].copy() for episode, n in pairs]


@kernel
def _collect(
    bundle: Bundle,
    rows: VehicleRows,
    episodes: IntArray,
    observed: BoolArray,
    prices: FloatArray,
    centre: FloatArray,
    sigma: FloatArray,
    paid: FloatArray,
) -> tuple[FloatArray, IntArray]:
    channels, terms = bundle.parts
    first, span, clip = channels.first, channels.span, terms.clip
    n_channels, n_cells = first.size, centre.shape[1]
    sums = np.empty((episodes.size, n_channels, 2))
    refused = np.zeros((episodes.size, terms.budget.size), dtype=np.int64)
    n_covering = np.empty(n_cells, dtype=np.int64)
    covering = np.empty((n_cells, n_channels), dtype=np.int64)
    counts, deviations = np.empty(n_channels, dtype=np.int64), np.empty(n_channels, dtype=np.int64)
    grid, most = np.empty(n_channels), np.empty(n_channels)
    for k in range(episodes.size):
        n_covering[:] = 0
        counts[:] = 0
        deviations[:] = 0
        for c in range(n_channels):
            grid[c] = grid_of(sigma[k, c, 1])
            most[c] = np.floor(clip / grid[c])
            if observed[k, c]:
                for s in range(first[c], first[c] + span[c]):
                    covering[s, n_covering[s]] = c
                    n_covering[s] += 1
        ledgers = paid[episodes[k]]
        for row in range(rows.start[k], rows.stop[k]):
            s, v = rows.cell[row], rows.vehicle[row]
            # A vehicle pays for every query that covers it, in the order of the channels.
            for i in range(n_covering[s] if s < n_cells else 0):
                c = covering[s, i]
                g = channels.group[c]
                reported = rows.speed[g, row]
                if reported < 0.0:
                    continue
                steps = np.rint((min(reported, terms.fastest) - centre[k, s]) / grid[c])
                steps = min(max(steps, -most[c]), most[c])
                d = steps * grid[c]
                cost = prices[k, c] * (1.0 + terms.ratio * d * d / (clip * clip))
                if ledgers[g, v] + cost <= terms.budget[g]:
                    ledgers[g, v] += cost
                    counts[c] += 1
                    deviations[c] += np.int64(steps)
                else:
                    refused[k, g] += 1
        for c in range(n_channels):
            sums[k, c, 0] = counts[c]
            sums[k, c, 1] = deviations[c] * grid[c]
    return sums, refused


def require_exact_sums(sigma: FloatArray, clip: float) -> None:
    """Refuse noise so small that sums of `MOST_VEHICLES` contributions would not be exact.

    Sums and noise are doubles, which hold all multiples of a grid up to 2^53 of them.

    Args:
        sigma: Smallest deviations of the noise of counts and of sums of deviations, shape (2,).
        clip: D [km/h].

    Raises:
        ValueError: See above.
    """
    steps = max(1.0 / grid_of(float(sigma[0])), clip / grid_of(float(sigma[1])))
    require(
        steps * MOST_VEHICLES < 2.0**52,
        "privacy.epsilon",
        f"smaller: sums of {MOST_VEHICLES} vehicles must be exact in double precision",
        f"noise of {sigma.tolist()} vehicles and km/h",
    )
