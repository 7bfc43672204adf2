"""The channels that are measured of a road, and the request for a second of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.estimators import Estimate
from dptse_env.model import Channels
from dptse_env.release.queries import Queries
from dptse_env.release.settings import Change
from dptse_env.traffic import Corridor, Penetration
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


class Group(NamedTuple):
    """Release channels that share a vehicle population and a fixed share of the privacy budget.

    Attributes:
        name: ``queries`` or ``sensors``.
        budget_share: Part of the privacy budget mu^2 of a vehicle.
        population: Which vehicles it sees, and what they report; None for all, with their speeds.
    """

    name: str
    budget_share: float = 1.0
    population: Penetration | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """Measurements of a road in a batch of n episodes.

    *Cells* are the columns of a record: the S segments, then the R boundary cells where they are
    released. *Channels* are what is measured: the M on the road, which estimators are given (the G
    queries, the ramps, the fixed sensors that are no query), then the R boundary cells. Each covers
    one cell, or several that are neighbours.

    Attributes:
        name: Name of the release model, for reports.
        settings: Its settings, of its ``settings_type``.
        corridor: The road, with the scales of densities and speeds.
        queries: The queries to choose from, the first G channels, and their bandwidth.
        horizon: Seconds of an episode.
        centre: Speed v_0 [km/h] that released flows are centred on; None where mean speeds
            are released.
        has_prices: Whether queries have prices.
        n_episodes: Size n of the batch.
        groups: Groups of channels, one or two. All channels are one group, or the queries are
            the first and all others the second.
        query_every: Seconds from one decision on queries to the next.
    """

    name: str
    settings: Any
    corridor: Corridor
    queries: Queries
    horizon: int
    centre: float | None = None
    has_prices: bool = False
    n_episodes: int = 1
    groups: tuple[Group, ...] = (Group("queries"),)
    query_every: int = 1

    @property
    def is_whole(self) -> bool:
        """True if all channels see all vehicles, as one group."""
        return len(self.groups) == 1 and self.groups[0].population is None

    @property
    def releases_flow(self) -> bool:
        """True where flows are released, False where mean speeds are."""
        return self.centre is not None

    # Channels -----------------------------------------------------------------------------------

    @cached_property
    def channels(self) -> Channels:
        """The C channels: queries, ramps, fixed sensors that are no query; then boundary cells.

        Sums over several segments are released where all lengths on the mainline are equal.
        """
        road, queries = self.corridor.road, self.queries
        others = np.array(queries.others(self.corridor), dtype=np.int64)
        boundary = np.arange(road.n_segments, self.n_cells)
        first = np.concatenate([queries.first, others, boundary])
        span = np.concatenate([queries.span, np.ones(others.size + boundary.size, dtype=np.int64)])
        group = np.where(np.arange(first.size) < queries.n_queries, 0, len(self.groups) - 1)
        return Channels(first, span, group, road.lengths[first] * span)

    @cached_property
    def n_channels(self) -> int:
        """Channels C."""
        return self.channels.size

    @cached_property
    def n_cells(self) -> int:
        """Cells that are measured: S + R where boundary cells are released, else S."""
        road = self.corridor.road
        return road.n_segments + (road.beside.size if self.settings.boundary == "private" else 0)

    @cached_property
    def n_on_road(self) -> int:
        """Channels M on the road, the first ones, which estimators are given."""
        return self.n_channels - (self.n_cells - self.corridor.road.n_segments)

    @cached_property
    def sensors(self) -> IntArray:
        """Channel of each of the corridor's fixed sensors, shape (F,)."""
        return np.array(self.queries.sensor_channels(self.corridor), dtype=np.int64)

    @cached_property
    def always(self) -> IntArray:
        """Channels that are observed at every step without a query, shape (A,)."""
        return np.concatenate([self.sensors, np.arange(self.n_on_road, self.n_channels)])

    def observed(self, queried: BoolArray) -> BoolArray:
        """Return the observed channels (k, C) of queries (k, G)."""
        observed = np.zeros((len(queried), self.n_channels), dtype=bool)
        observed[:, : queried.shape[1]] = queried
        observed[:, self.always] = True
        return observed

    def covered(self, observed: BoolArray) -> BoolArray:
        """Return the mainline segments (k, n_mainline) of observed channels (k, C)."""
        if self.queries.are_segments and self.n_on_road == self.corridor.road.n_segments:
            return observed[:, : self.corridor.geometry.n_mainline]
        on_road = observed[:, : self.n_on_road].astype(np.float32)
        segments: BoolArray = on_road @ self._covers_mainline > 0.0
        return segments

    @cached_property
    def covers(self) -> BoolArray:
        """True where a channel covers a cell, shape (C, cells)."""
        return self.channels.covers(self.n_cells)

    @cached_property
    def _covers_mainline(self) -> NDArray[np.float32]:
        """Shape (M, n_mainline), as numbers: products of floats are faster."""
        return self.covers[: self.n_on_road, : self.corridor.geometry.n_mainline].astype(np.float32)

    # Groups -------------------------------------------------------------------------------------

    @cached_property
    def shares(self) -> FloatArray:
        """Part of the budget mu^2 of each group, shape (groups,)."""
        return np.array([group.budget_share for group in self.groups])

    def protects(self, what: str, change: Change) -> str:
        """Return what a release protects, in words: of a vehicle that all groups see.

        Beside loops it is what the vehicle reports: they count it, whatever that is.
        """
        has_loops = self.corridor.loops is not None
        protected = f"{what}, {change.reports if has_loops else change.rows}"
        if len(self.groups) > 1:
            others = "fixed sensors" if self.corridor.fixed_sensors else "boundary segments"
            protected += f", under queries and {others} together"
        if has_loops:
            return f"the reports of a connected vehicle: {protected}"
        return protected if self.is_whole else f"a connected vehicle: {protected}"

    def group_reports(self, mu: FloatArray, noise_std: FloatArray) -> dict[str, Any]:
        """Return ``groups`` for the details of a report; nothing where all channels are one group.

        Args:
            mu: Parameter of each group, shape (groups,).
            noise_std: Standard deviations of its noise, shape (groups, 2).
        """
        if self.is_whole:
            return {}
        total = float(mu @ mu)
        numbers = zip(self.groups, mu.tolist(), noise_std.tolist(), strict=True)
        reports = [
            {
                "group": group.name,
                "vehicles": "all" if group.population is None else "connected",
                "budget_share": own**2 / total,
                "mu": own,
                "noise_std": stds,
            }
            for group, own, stds in numbers
        ]
        return {"groups": reports}


def _no_prediction() -> Estimate:
    raise RuntimeError("this request carries no prediction")


class Request(NamedTuple):
    """A second of k episodes whose data is to be released.

    Attributes:
        episodes: Distinct episodes of the batch, shape (k,).
        traffic: Index of each episode's traffic seed, shape (k,).
        times: Second of the record, shape (k,).
        observed: Channels that were queried or are always observed, shape (k, C).
        prediction: Returns the estimator's prediction for this second, which is public: it depends
            on earlier releases and the configuration alone. Raises where there is no estimator.
    """

    episodes: IntArray
    traffic: IntArray
    times: IntArray
    observed: BoolArray
    prediction: Callable[[], Estimate] = _no_prediction
