"""What is measured of a road, and the request for a second of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.estimators import Estimate
from dptse_env.model import MeasurementRows
from dptse_env.model.network import covered
from dptse_env.release.queries import QueryOptions
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

    *Places* are the columns of a record: the S segments, then the R boundary segments where they
    are released. *Columns* are those of a release: first the M rows of the road, which estimators
    are given (the G options, the ramps, the fixed sensors that are no option), then the R boundary
    segments. Each covers one place, or several that are neighbours; columns of a group are
    neighbours, too.

    Attributes:
        name: Name of the release model, for reports.
        settings: Its settings, of its ``settings_type``.
        corridor: The road, with the scales of densities and speeds.
        queries: The options that can be queried, the first G columns, and their bandwidth.
        horizon: Steps of an episode.
        flow_centre: Speed v_0 [km/h] that released flows are centred on; None where mean speeds
            are released.
        has_prices: Whether queries have prices.
        n_episodes: Size n of the batch.
        groups: Groups of columns, one or two. All columns are one group, or the options are the
            first and all others the second.
    """

    name: str
    settings: Any
    corridor: Corridor
    queries: QueryOptions
    horizon: int
    flow_centre: float | None = None
    has_prices: bool = False
    n_episodes: int = 1
    groups: tuple[Group, ...] = (Group("queries"),)

    @property
    def is_whole(self) -> bool:
        """True if all columns see all vehicles, as one group."""
        return len(self.groups) == 1 and self.groups[0].population is None

    @property
    def releases_flow(self) -> bool:
        """True where flows are released, False where mean speeds are."""
        return self.flow_centre is not None

    # Columns and places -------------------------------------------------------------------------

    @cached_property
    def rows(self) -> MeasurementRows:
        """The M rows."""
        return self.queries.rows(self.corridor)

    @property
    def n_rows(self) -> int:
        """Rows M that estimators are given."""
        return self.rows.n_rows

    @cached_property
    def _boundary(self) -> IntArray:
        """Places of the boundary segments, shape (R,)."""
        is_private = self.settings.boundary == "private"
        return self.corridor.n_segments + np.arange(self.corridor.n_boundaries * is_private)

    @property
    def n_places(self) -> int:
        """Places S + R."""
        return self.corridor.n_segments + self._boundary.size

    @property
    def n_columns(self) -> int:
        """Columns C of a release."""
        return self.first.size

    @cached_property
    def first(self) -> IntArray:
        """The first place of each column, shape (C,)."""
        return np.concatenate([self.rows.first, self._boundary])

    @cached_property
    def span(self) -> IntArray:
        """Number of places that each column covers, shape (C,)."""
        return np.concatenate([self.rows.span, np.ones_like(self._boundary)])

    @cached_property
    def length(self) -> FloatArray:
        """Length of each column [km], shape (C,).

        Sums over several segments are released where all lengths on the mainline are equal.
        """
        corridor = self.corridor
        every: FloatArray = np.array(corridor.with_boundaries(corridor.segment_lengths))
        return every[self.first] * self.span

    @cached_property
    def limit(self) -> FloatArray:
        """Speed limit at the first place of each column [km/h], shape (C,)."""
        corridor = self.corridor
        every: FloatArray = np.array(corridor.with_boundaries(corridor.speed_limits))
        return every[self.first]

    @cached_property
    def sensors(self) -> IntArray:
        """Column of each of the corridor's fixed sensors, shape (F,)."""
        return np.array(self.queries.sensor_rows(self.corridor), dtype=np.int64)

    @cached_property
    def always(self) -> IntArray:
        """Columns that are observed at every step without a query, shape (A,)."""
        return np.concatenate([self.sensors, np.arange(self.n_rows, self.n_columns)])

    def observed(self, queried: BoolArray) -> BoolArray:
        """Return the observed columns (k, C) of queried options (k, G)."""
        observed = np.zeros((len(queried), self.n_columns), dtype=bool)
        observed[:, : queried.shape[1]] = queried
        observed[:, self.always] = True
        return observed

    def covered(self, observed: BoolArray) -> BoolArray:
        """Return the mainline segments (k, n_mainline) of observed columns (k, C)."""
        if self.rows.are_single:
            return observed[:, : self.corridor.n_mainline]
        rows = observed[:, : self.n_rows].astype(np.float32)
        segments: BoolArray = rows @ self._rows_cover > 0.0
        return segments

    @property
    def columns(self) -> tuple[IntArray, IntArray, IntArray]:
        """First place, number of places and group of each column, shape (C,) each."""
        return self.first, self.span, self.group

    @cached_property
    def covers(self) -> BoolArray:
        """True where a column covers a place, shape (C, S + R)."""
        return covered(self.first, self.span, self.n_places)

    @cached_property
    def _rows_cover(self) -> NDArray[np.float32]:
        """Mainline segments in each row, shape (M, n_mainline): products of floats are faster."""
        return self.covers[: self.n_rows, : self.corridor.n_mainline].astype(np.float32)

    # Groups -------------------------------------------------------------------------------------

    @cached_property
    def group(self) -> IntArray:
        """Group of each column, ascending, shape (C,)."""
        is_option = np.arange(self.n_columns) < self.queries.n_options
        return np.where(is_option, 0, len(self.groups) - 1)

    @cached_property
    def shares(self) -> FloatArray:
        """Part of the budget mu^2 of each group, shape (groups,)."""
        return np.array([group.budget_share for group in self.groups])

    def protects(self, what: str) -> str:
        """Return what a release protects, in words: a vehicle that all groups see."""
        if self.is_whole:
            return what
        return f"a connected vehicle: {what}, under queries and fixed sensors together"

    def group_reports(self, mu: FloatArray, noise_std: FloatArray) -> dict[str, Any]:
        """Return ``groups`` for the details of a report; nothing where all columns are one group.

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
        episodes: Distinct rows of the batch, shape (k,).
        traffic: Index of each episode's traffic seed, shape (k,).
        times: Second of the record, shape (k,).
        observed: Columns that were queried or are always observed, shape (k, C).
        prediction: Returns the estimator's prediction for this second, which is public: it depends
            on earlier releases and the configuration alone. Raises where there is no estimator.
    """

    episodes: IntArray
    traffic: IntArray
    times: IntArray
    observed: BoolArray
    prediction: Callable[[], Estimate] = _no_prediction
