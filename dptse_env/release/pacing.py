"""Pacing: the price of a query, from public numbers alone.

A price a buys noise of variance 1 / a on the count of a query, and every vehicle that is counted
pays for it. Pacing should make a vehicle's budget last for its trip. It decides how accurate the
releases are, never whether the guarantee holds.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from dptse_env.model.network import Layout, make_layout
from dptse_env.model.parameters import SECONDS_PER_HOUR
from dptse_env.release import pacing_kernels as kernels
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.registry import Registry

MEAN_SQUARE = 0.15
"""Expected value of d^2 / D^2, by which a contribution costs more than its price."""

LEAST_SHARE = 0.01
"""Least part of the budget that is offered for the rest of a trip, so that prices stay positive."""


@dataclass(frozen=True)
class PacingSetup:
    """Configuration that a pacing is made for.

    Attributes:
        corridor: The road.
        budget: Budget b of a vehicle.
        pace: Part of the budget that should be spent by the end of a trip.
        ratio: Ratio r of the charge for speeds.
        first: First record column that each of the C columns of a release covers, shape (C,).
        span: Number of record columns that each covers, shape (C,).
        level: Price level of each column, shape (C,).
        always: Columns that are observed at every step, shape (A,).
        coverage: Expected share of the mainline's segments that a step's queries cover.
        n_places: Record columns: the segments, and the boundary segments if they are released.
        n_episodes: Size n of the batch.
    """

    corridor: Corridor
    budget: float
    pace: float
    ratio: float
    first: IntArray
    span: IntArray
    level: FloatArray
    always: IntArray
    coverage: float
    n_places: int
    n_episodes: int


@dataclass(frozen=True)
class PublicStep:
    """Public numbers that a price may depend on: a second of k episodes, before its release.

    Attributes:
        episodes: Distinct rows of the batch, shape (k,).
        observed: Columns that are observed, shape (k, C).
        density: Predicted densities [veh/km], shape (k, S).
        speed: Predicted speeds [km/h], shape (k, S).
    """

    episodes: IntArray
    observed: BoolArray
    density: FloatArray
    speed: FloatArray

    def __getattr__(self, name: str) -> NoReturn:
        """Refuse what is not public.

        Raises:
            AttributeError: Always; the message says that prices depend on public numbers alone.
        """
        raise AttributeError(
            f"privacy.pacing must depend on public numbers alone: a step has episodes, observed, "
            f"density and speed, got a request for {name!r}"
        )


class Pacing(ABC):
    """Base class of pacings, for a batch of n episodes.

    A subclass keeps public state of episodes, and returns prices.
    """

    def __init__(self, setup: PacingSetup) -> None:
        """Store the configuration."""
        self.setup = setup

    def reset(self, episodes: IntArray) -> None:  # noqa: B027 (nothing by default)
        """Begin new episodes, shape (k,)."""

    @abstractmethod
    def prices(self, step: PublicStep) -> FloatArray:
        """Return the price [1/veh^2] of every column, positive and finite, shape (k, C).

        It is called once for every second.
        """

    def expected_price(self, speed: FloatArray) -> float:
        """Return a typical price at predicted speeds [km/h] of shape (S,)."""
        return self.setup.budget

    def tracer(self, episodes: IntArray) -> FloatArray:
        """Return the part of the budget that vehicles on each mainline segment may have spent.

        Shape (k, n_mainline), in [0, 1].
        """
        return np.zeros((len(episodes), self.setup.corridor.n_mainline))


class TracerPacing(Pacing):
    """Prices that spend what is left of a budget evenly over the rest of a trip.

    A tracer m follows the mean ledger of the vehicles on each segment: a query adds its expected
    charge, ``a (1 + 0.15 r)``, predicted flows carry it along, and vehicles enter with 0. The rest
    of a trip has R queried seconds: the sum, over the segments from here on, of the rate of
    querying times the length over the predicted speed, which is held to [8, 102] km/h, and a margin
    of 2 s. The price on a segment is ``max(pace b - m, 0.01 b) / R``, and that of a query the mean
    over its segments, times its level. Where vehicles contribute deviations of what they report in
    place of being counted, they pay less for it, and prices are higher in proportion.

    Rates of querying are averages over the last minute or so. They begin at equal rates for all
    segments, so that a policy that keeps querying the same place is soon paced for that.
    """

    def __init__(self, setup: PacingSetup) -> None:
        """Prepare for episodes without any charge so far."""
        super().__init__(setup)
        corridor, n = setup.corridor, setup.n_episodes
        layout = make_layout(corridor)
        S = layout.n_segments
        boundary = [layout.entry_boundaries, layout.exit_boundaries]
        if setup.n_places > S:
            entry_places, exit_places = (S + places for places in boundary)
        else:
            entry_places, exit_places = (np.full_like(places, -1) for places in boundary)
        road = kernels.PacedRoad(
            n_mainline=corridor.n_mainline,
            n_segments=S,
            length=layout.lengths,
            edges=layout.edges,
            edge_share=layout.edge_shares,
            entries=layout.entries,
            entry_places=entry_places,
            exits=layout.exits,
            exit_places=exit_places,
            next_segment=_next_segments(layout),
        )
        columns = kernels.PacedColumns(setup.first, setup.span, setup.level)
        self._packed = tuple(road), tuple(columns)
        always = np.zeros(setup.n_places, dtype=bool)
        for column in setup.always:
            always[setup.first[column]] = True
        self._first_rates = np.where(always, 1.0, 0.0)
        mainline = slice(0, corridor.n_mainline)
        self._first_rates[mainline] = np.maximum(self._first_rates[mainline], setup.coverage)
        self._rates = np.tile(self._first_rates, (n, 1))
        self._tracer = np.zeros((n, setup.n_places))
        self._offer = setup.pace * setup.budget, LEAST_SHARE * setup.budget

    def reset(self, episodes: IntArray) -> None:
        """See `Pacing.reset`."""
        self._rates[episodes] = self._first_rates
        self._tracer[episodes] = 0.0

    def prices(self, step: PublicStep) -> FloatArray:
        """See `Pacing.prices`."""
        prices = np.empty(step.observed.shape)
        kernels.pace(
            *self._packed, step.episodes, step.observed, step.density, step.speed, *self._offer,
            1.0 + MEAN_SQUARE * self.setup.ratio, self._rates,
            self._tracer, prices,
        )  # fmt: skip
        return prices

    def expected_price(self, speed: FloatArray) -> float:
        """Return the price at the upstream end, at these speeds and the rates of the beginning."""
        corridor = self.setup.corridor
        n, length = corridor.n_mainline, np.array(corridor.segment_lengths[: corridor.n_mainline])
        seconds = SECONDS_PER_HOUR * length / np.clip(speed[:n], kernels.SLOWEST, kernels.FASTEST)
        queried = float((self._first_rates[:n] * seconds).sum()) + kernels.MARGIN
        return self._offer[0] / queried

    def tracer(self, episodes: IntArray) -> FloatArray:
        """See `Pacing.tracer`."""
        tracer = self._tracer[episodes, : self.setup.corridor.n_mainline]
        return np.minimum(tracer / self.setup.budget, 1.0)


def _next_segments(layout: Layout) -> IntArray:
    """Return the segment that each one leads to, (S,): the mainline at a diverge, -1 at an exit."""
    following = np.full(layout.n_segments, -1, dtype=np.int64)
    for start, end in layout.edges:
        if following[start] < 0 or end < following[start]:
            following[start] = end
    return following


class EventPacing(Pacing):
    """Prices for the unit ``event``, where each second of a trip has a budget of its own.

    Every vehicle can pay for all queries that cover it, at any deviation.
    """

    def __init__(self, setup: PacingSetup) -> None:
        """Work out the price of a query that has a second's budget to itself."""
        super().__init__(setup)
        self._whole = setup.budget / (1.0 + setup.ratio)
        self._columns = tuple(kernels.PacedColumns(setup.first, setup.span, setup.level))

    def prices(self, step: PublicStep) -> FloatArray:
        """See `Pacing.prices`."""
        prices = np.empty(step.observed.shape)
        places = self.setup.n_places
        kernels.divide(self._columns, places, step.observed, self._whole, prices)
        return prices

    def expected_price(self, speed: FloatArray) -> float:
        """Return the price where queries do not overlap."""
        return self._whole


PACINGS = Registry(
    "privacy.pacing",
    {"tracer": TracerPacing},
    check=lambda part: (
        None
        if isinstance(part, type) and issubclass(part, Pacing)
        else "be a subclass of dptse_env.release.Pacing"
    ),
)
"""Pacings by name."""


def check_prices(prices: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return the prices of a pacing; refuse those that are malformed.

    Raises:
        ValueError: Their shape is wrong, or one is not positive and finite.
    """
    array = np.asarray(prices)
    if array.shape != shape or array.dtype.kind != "f":
        raise ValueError(
            f"privacy.pacing must return floats of shape {shape}, got {array.dtype} of shape "
            f"{array.shape}"
        )
    if not ((array > 0.0) & np.isfinite(array)).all():
        raise ValueError("privacy.pacing must return prices that are positive and finite")
    return array
