"""Pacing: the price of a query, from public numbers alone.

A price a buys noise of variance 1 / a on the count of a query, and every vehicle that is counted
pays for it. Pacing should make a vehicle's budget last for its trip. It decides how accurate the
releases are, never whether the guarantee holds. Each group of channels is paced by itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from dptse_env.release.queries import Queries
from dptse_env.release.task import Task
from dptse_env.road import Road
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, copy_vector, kernel, kernel_part
from dptse_env.utils.units import HOUR

CHARGED_SQUARE = 0.5
"""Value of d^2 / D^2 for which pacing has vehicles pay. Most pay less, so that few run out."""

LEAST_SHARE = 0.01
"""Least part of the budget that is offered for the rest of a trip, so that prices stay positive."""

SLOWEST_TRIP, FASTEST_TRIP = 8.0, 102.0
"""Range that predicted speeds [km/h] are held to where they give the time of a trip."""

RATE_MEMORY = 60.0
"""Time constant of the average by which rates of querying follow the queries [s]."""


class Pacing(ABC):
    """Base class of pacings, for a batch of n episodes.

    A subclass keeps public state of episodes, and returns prices. It is shown public numbers alone.

    Attributes:
        task: What is measured.
        budget: Budget of a vehicle in each group of channels, shape (groups,).
    """

    def __init__(self, task: Task, budget: FloatArray) -> None:
        """Store the configuration."""
        self.task, self.budget = task, budget

    def reset(self, episodes: IntArray) -> None:  # noqa: B027 (nothing by default)
        """Begin new episodes, shape (k,)."""

    @abstractmethod
    def prices(
        self, episodes: IntArray, observed: BoolArray, density: FloatArray, speed: FloatArray
    ) -> FloatArray:
        """Return the price [1/veh^2] of every channel, above zero, shape (k, C).

        It is called once for every second, before its release.

        Args:
            episodes: Distinct episodes of the batch, shape (k,).
            observed: Channels that are observed, shape (k, C).
            density: Predicted densities [veh/km], shape (k, S).
            speed: Predicted speeds [km/h], shape (k, S).
        """

    def expected_prices(self, speed: FloatArray) -> FloatArray:
        """Return a typical price of each group (groups,) at predicted speeds [km/h] (S,)."""
        return self.budget

    def spent_share(self, episodes: IntArray) -> FloatArray:
        """Return the part of the budget for queries that vehicles on a segment may have spent.

        Shape (k, n_mainline), in [0, 1].
        """
        return np.zeros((len(episodes), self.task.corridor.geometry.n_mainline))


class Paces(NamedTuple):
    """Budgets of a `TripPacing`, and its public state of n episodes."""

    budget: FloatArray  # (groups,)
    ratio: float
    rates: FloatArray  # (n, groups, cells) of querying
    spent: FloatArray  # (n, groups, cells) what most have paid so far at most


class TripPacing(Pacing):
    """Prices for the unit ``trip``: they spend what is left of a budget evenly over its rest.

    What most vehicles on a segment have spent at most, m, is predicted: a query adds
    ``a (1 + 0.5 r)``, predicted flows carry it along, and vehicles enter with 0. The rest of a trip
    has R queried seconds: the sum, over the segments from here on, of the rate of querying times
    the length over the predicted speed, which is held to [8, 102] km/h, and ``1 + r``. The price on
    a segment is ``max(b - m, 0.01 b) / R``, and that of a query the mean over its segments. So
    whoever has spent at most m of a budget b can pay for a query at any deviation.

    Rates of querying are averages over the last minute or so. They begin at equal rates for all
    segments, so that a policy that keeps querying the same cell is soon paced for that.
    """

    def __init__(self, task: Task, budget: FloatArray) -> None:
        """Prepare for episodes without any charge so far."""
        super().__init__(task, budget)
        self._first_rates = np.zeros((len(task.groups), task.n_cells))
        self._first_rates[task.channels.group[task.always], task.channels.first[task.always]] = 1.0
        mainline = self._first_rates[0, : task.corridor.geometry.n_mainline]
        mainline[:] = np.maximum(mainline, _coverage(task.queries) / task.query_every)
        self._paces = Paces(
            budget=budget,
            ratio=task.settings.ratio,
            rates=np.tile(self._first_rates, (task.n_episodes, 1, 1)),
            spent=np.zeros((task.n_episodes, *self._first_rates.shape)),
        )
        self._bundle = Bundle(task.corridor.road, task.channels, self._paces)

    def reset(self, episodes: IntArray) -> None:
        """See `Pacing.reset`."""
        self._paces.rates[episodes] = self._first_rates
        self._paces.spent[episodes] = 0.0

    def prices(
        self, episodes: IntArray, observed: BoolArray, density: FloatArray, speed: FloatArray
    ) -> FloatArray:
        """See `Pacing.prices`."""
        prices = np.empty(observed.shape)
        _pace(self._bundle, episodes, observed, density, speed, prices)
        return prices

    def expected_prices(self, speed: FloatArray) -> FloatArray:
        """Return prices at the upstream end, at these speeds and the rates of the beginning."""
        road = self.task.corridor.road
        n, length = road.n_mainline, road.lengths[: road.n_mainline]
        seconds = HOUR * length / np.clip(speed[:n], SLOWEST_TRIP, FASTEST_TRIP)
        queried = (self._first_rates[:, :n] * seconds).sum(axis=1)
        prices: FloatArray = self.budget / (queried + 1.0 + self._paces.ratio)
        return prices

    def spent_share(self, episodes: IntArray) -> FloatArray:
        """See `Pacing.spent_share`."""
        spent = self._paces.spent.take(episodes, 0)[:, 0, : self.task.queries.n_mainline]
        part: FloatArray = np.minimum(spent / self.budget[0], 1.0)
        return part


def _coverage(queries: Queries) -> float:
    """Return the share of the mainline that a decision covers if all queries are alike."""
    if queries.n_queries == 0:
        return 0.0
    bought = queries.bandwidth * float(np.mean(queries.span / queries.cost))
    return min(bought / queries.n_mainline, 1.0)


class EventPacing(Pacing):
    """Prices for the unit ``event``, where each second of a trip has a budget of its own.

    Every vehicle can pay for all queries that cover it, at any deviation.
    """

    def __init__(self, task: Task, budget: FloatArray) -> None:
        """Work out the price of a query that has a second's budget to itself."""
        super().__init__(task, budget)
        self._whole: FloatArray = budget / (1.0 + task.settings.ratio)
        self._bundle = Bundle(task.channels)

    def prices(
        self, episodes: IntArray, observed: BoolArray, density: FloatArray, speed: FloatArray
    ) -> FloatArray:
        """See `Pacing.prices`."""
        prices = np.empty(observed.shape)
        _divide(self._bundle, self.task.n_cells, observed, self._whole, prices)
        return prices

    def expected_prices(self, speed: FloatArray) -> FloatArray:
        """Return the prices where queries do not overlap."""
        return self._whole


@kernel
def _pace(
    bundle: Bundle,
    episodes: IntArray,
    observed: BoolArray,
    density: FloatArray,
    speed: FloatArray,
    prices: FloatArray,
) -> None:
    """Carry what is spent along, set prices, and add what the queries cost.

    Args:
        bundle: `Road`, `Channels` and `Paces`, whose rates and payments are updated.
        episodes: Shape (k,).
        observed: Channels that are observed, shape (k, C).
        density: Predicted densities [veh/km], shape (k, S).
        speed: Predicted speeds [km/h], shape (k, S).
        prices: Output, shape (k, C).
    """
    road, channels, paces = bundle.parts
    rates, spent, largest = paces.rates, paces.spent, 1.0 + paces.ratio
    charge = 1.0 + CHARGED_SQUARE * paces.ratio
    n_groups, n_cells = spent.shape[1], spent.shape[2]
    rest, before, charged = np.empty(n_cells), np.empty(n_cells), np.empty(n_cells)
    inflow = np.empty((2, road.n_segments))
    for k in range(episodes.size):
        for g in range(n_groups):
            paid, rate, budget = spent[episodes[k], g], rates[episodes[k], g], paces.budget[g]
            copy_vector(paid, before)
            _carry(road, density[k], speed[k], before, paid, inflow)
            _remaining(road, speed[k], rate, largest, rest)
            charged[:] = 0.0
            for c in range(channels.first.size):
                if channels.group[c] != g:
                    continue
                first, last = channels.first[c], channels.first[c] + channels.span[c]
                price = 0.0
                for s in range(first, last):
                    price += max(budget - paid[s], LEAST_SHARE * budget) / rest[s]
                price *= 1.0 / channels.span[c]
                prices[k, c] = price
                if observed[k, c]:
                    for s in range(first, last):
                        charged[s] += price
            for s in range(n_cells):
                paid[s] += charge * charged[s]
                seen = 1.0 if charged[s] > 0.0 else 0.0
                rate[s] += (seen - rate[s]) / RATE_MEMORY


@kernel_part
def _carry(
    road: Road,
    density: FloatArray,
    speed: FloatArray,
    before: FloatArray,
    after: FloatArray,
    inflow: FloatArray,
) -> None:
    """Mix what is spent on each segment with that of the vehicles that arrived in a second."""
    flow, mass = inflow[0], inflow[1]
    flow[:], mass[:] = 0.0, 0.0
    for e in range(road.edges.shape[0]):
        start, end = road.edges[e, 0], road.edges[e, 1]
        arriving = road.edge_share[e] * density[start] * speed[start]
        flow[end] += arriving
        mass[end] += arriving * before[start]
    for e in range(road.entries.size):
        s, cell = road.entries[e], road.entry_cells[e]
        arriving = density[s] * speed[s]
        flow[s] += arriving
        if cell < before.size:
            mass[s] += arriving * before[cell]
            after[cell] *= 1.0 - _moved(road.lengths[s], speed[s])
    for s in range(road.n_segments):
        if flow[s] > 0.0:
            arrived = flow[s] / (HOUR * road.lengths[s] * max(density[s], 1e-9))
            share = min(arrived, 1.0)
            after[s] = (1.0 - share) * before[s] + share * mass[s] / flow[s]
    for e in range(road.exits.size):
        s, cell = road.exits[e], road.exit_cells[e]
        if cell < before.size:
            share = _moved(road.lengths[s], speed[s])
            after[cell] = (1.0 - share) * before[cell] + share * before[s]


@kernel_part
def _moved(length: float, speed: float) -> float:
    """Return the share of the vehicles on a length [km] that leave it in a second."""
    return float(min(speed / (HOUR * length), 1.0))


@kernel_part
def _remaining(
    road: Road, speed: FloatArray, rate: FloatArray, largest: float, rest: FloatArray
) -> None:
    """Write the queried seconds to come on each cell, and the largest payment over its price."""
    n, S = road.n_mainline, road.n_segments
    rest[:S] = 0.0
    for e in range(road.exits.size):
        s, cell = road.exits[e], road.exit_cells[e]
        rest[s] = largest
        if cell < rest.size:
            rest[s] += _seconds(road.lengths[s], speed[s]) * rate[cell]
            rest[cell] = rest[s]
    # Against the traffic: the segment that each one leads to comes first.
    for first, last in ((n, -1), (S, n - 1)):
        for s in range(first - 1, last, -1):
            following = road.parties[s, 1]
            ahead = rest[following] if following >= 0 else rest[s]
            rest[s] = ahead + _seconds(road.lengths[s], speed[s]) * rate[s]
    for e in range(road.entries.size):
        s, cell = road.entries[e], road.entry_cells[e]
        if cell < rest.size:
            rest[cell] = rest[s] + _seconds(road.lengths[s], speed[s]) * rate[cell]


@kernel_part
def _seconds(length: float, speed: float) -> float:
    """Return the time [s] on a length [km] at a speed [km/h]."""
    return float(HOUR * length / min(max(speed, SLOWEST_TRIP), FASTEST_TRIP))


@kernel
def _divide(
    bundle: Bundle, n_cells: int, observed: BoolArray, whole: FloatArray, prices: FloatArray
) -> None:
    """Divide a second's budgets alike among a group's queries that cover a cell."""
    (channels,) = bundle.parts
    total = np.empty((whole.size, n_cells))
    for k in range(observed.shape[0]):
        total[:] = 0.0
        for c in range(channels.first.size):
            if observed[k, c]:
                for s in range(channels.first[c], channels.first[c] + channels.span[c]):
                    total[channels.group[c], s] += 1.0
        for c in range(channels.first.size):
            most, g = 1.0, channels.group[c]
            for s in range(channels.first[c], channels.first[c] + channels.span[c]):
                own = 0.0 if observed[k, c] else 1.0
                most = max(most, total[g, s] + own)
            prices[k, c] = whole[g] / most
