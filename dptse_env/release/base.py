"""Base class of release models: released values, privacy account and privacy report."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.estimators import Estimate, Measurement
from dptse_env.model import MeasurementRows
from dptse_env.release.queries import NO_OPTIONS, QueryOptions
from dptse_env.release.report import PrivacyReport
from dptse_env.release.settings import PrivacySettings
from dptse_env.release.traffic_table import TrafficTable
from dptse_env.traffic import Corridor, Record
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.registry import name_of_class
from dptse_env.utils.vector_info import Rows


@dataclass(frozen=True)
class ReleaseSetup:
    """Configuration that a release model is made for.

    Attributes:
        name: Name of the model, for reports.
        settings: The privacy settings.
        traffic: The true traffic, with its corridor.
        bandwidth: Largest total cost of the queries of a step, in the unit of ``queries``.
        horizon: Steps of an episode.
        n_episodes: Size n of the batch.
        queries: The G options that can be queried; the mainline segments where they are not given.
        budget_share: Part of the privacy budget mu^2 that the releases may spend.
    """

    name: str
    settings: PrivacySettings
    traffic: TrafficTable
    bandwidth: int
    horizon: int
    n_episodes: int
    queries: QueryOptions = NO_OPTIONS
    budget_share: float = 1.0

    def __post_init__(self) -> None:
        """Fill in the options."""
        if self.queries is NO_OPTIONS:
            options = QueryOptions.make(self.corridor.n_mainline, self.bandwidth)
            object.__setattr__(self, "queries", options)

    @property
    def corridor(self) -> Corridor:
        """The road."""
        return self.traffic.corridor

    @cached_property
    def rows(self) -> MeasurementRows:
        """The M rows that estimators may be given: the options and what is observed besides."""
        return self.queries.rows(self.corridor)

    @cached_property
    def n_columns(self) -> int:
        """Columns of a release: the M rows, then the boundary segments if they are released."""
        private = self.settings.boundary == "private"
        return self.rows.n_rows + (self.corridor.n_boundaries if private else 0)

    @cached_property
    def places(self) -> IntArray:
        """The first record column of each column of a release, shape (n_columns,)."""
        boundaries = np.arange(self.n_columns - self.rows.n_rows)
        return np.concatenate([self.rows.first, self.corridor.n_segments + boundaries])

    @property
    def n_places(self) -> int:
        """Record columns: the segments, and the boundary segments if they are released."""
        return self.corridor.n_segments + self.n_columns - self.rows.n_rows

    @cached_property
    def spans(self) -> IntArray:
        """Number of record columns that each column of a release covers, shape (n_columns,)."""
        boundaries = np.ones(self.n_columns - self.rows.n_rows, dtype=np.int64)
        return np.concatenate([self.rows.span, boundaries])

    @cached_property
    def lengths(self) -> FloatArray:
        """Length of each column of a release [km], shape (n_columns,)."""
        every = np.array(self.corridor.with_boundaries(self.corridor.segment_lengths))
        # Sums over several segments are released where all lengths on the mainline are equal.
        lengths: FloatArray = every[self.places] * self.spans
        return lengths

    @cached_property
    def always_observed(self) -> IntArray:
        """Columns that are observed at every step without a query."""
        sensors = self.queries.sensor_rows(self.corridor)
        boundaries = range(self.rows.n_rows, self.n_columns)
        return np.array([*sensors, *boundaries], dtype=np.int64)

    def observed(self, queried: BoolArray) -> BoolArray:
        """Return the observed columns (k, n_columns) of queried options (k, G)."""
        observed = np.zeros((len(queried), self.n_columns), dtype=bool)
        observed[:, : queried.shape[1]] = queried
        observed[:, self.always_observed] = True
        return observed

    def covered(self, observed: BoolArray) -> BoolArray:
        """Return the mainline segments (k, n_mainline) of observed columns (k, n_columns)."""
        n = self.corridor.n_mainline
        if self.rows.are_single:
            return observed[:, :n]
        covered: BoolArray = observed[:, : self.rows.n_rows].astype(np.float32) @ self._covers > 0.0
        return covered

    def at_places(self, values: FloatArray) -> FloatArray:
        """Return predictions of the segments, shape (k, S), for all record columns: (k, n_places).

        That of a boundary segment is the prediction of the road's segment next to it.
        """
        if self.n_places == values.shape[1]:
            return values
        return np.concatenate([values, values[:, self.corridor.boundary_neighbours]], axis=1)

    @cached_property
    def _covers(self) -> NDArray[np.float32]:
        """Mainline segments in each row, shape (M, n_mainline): products of floats are faster."""
        return (self.rows.weights[:, : self.corridor.n_mainline] > 0.0).astype(np.float32)


def _no_prediction() -> Estimate:
    raise RuntimeError("this release request carries no prediction")


class ReleaseRequest(NamedTuple):
    """A second of k episodes whose data is to be released.

    Attributes:
        episodes: Distinct rows of the batch, shape (k,).
        traffic: Index of each episode's traffic seed, shape (k,).
        times: Second of the record, shape (k,).
        observed: Columns that were queried or are always observed, shape (k, n_columns): those of
            the options come first.
        prediction: Returns the estimator's prediction for this second, which is public: it depends
            on earlier releases and the configuration alone. Raises where there is no estimator.
    """

    episodes: IntArray
    traffic: IntArray
    times: IntArray
    observed: BoolArray
    prediction: Callable[[], Estimate] = _no_prediction


class ReleaseModel(ABC):
    """Base class of release models, for a batch of episodes.

    Estimators, observations and policies learn of the traffic through `release` and the boundary
    inputs (`dptse_env.release.boundary`) alone. A subclass may read true traffic from
    ``setup.traffic``. Its constructor must be cheap: nothing is loaded before `load`.

    A model with a guarantee overrides `report` and `spent`; otherwise no guarantee is reported.
    """

    settings_type: ClassVar[type[PrivacySettings]] = PrivacySettings
    """Dataclass of the settings under the keyword ``privacy``."""
    claims_guarantee: ClassVar[bool] = False
    """True where users expect a guarantee, so that a warning is due if it is void."""
    releases_sums: ClassVar[bool] = False
    """True where a release may cover several segments, at a price level that the query chooses."""
    needs_vehicles: ClassVar[bool] = False
    """True where the model reads the vehicles of a record, which measured fields have not."""
    has_prices: ClassVar[bool] = False
    """True where queries have prices, which `public_state` gives."""
    takes_noise: bool = False
    """True where `give_noise` works, which trainings by swaps need."""

    @classmethod
    def flow_centre(cls, corridor: Corridor, settings: Any) -> float | None:
        """Return the speed v_0 [km/h] that released flows rho (v - v_0) are centred on.

        None where mean speeds are released.
        """
        return None

    def __init__(self, setup: ReleaseSetup) -> None:
        """Store the configuration."""
        self.setup = setup

    @property
    @abstractmethod
    def sigma(self) -> FloatArray:
        """Standard deviations of the noise of both released quantities, shape (2,).

        Where they vary, those that are expected before an episode begins.
        """

    @abstractmethod
    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes.

        Args:
            episodes: Distinct rows of the batch, shape (k,).
            generators: k noise streams; only the model uses them from now on.
        """

    @abstractmethod
    def release(self, request: ReleaseRequest) -> Measurement:
        """Release one second of some episodes.

        Noise should be drawn for all columns, observed or not, so that different policies with the
        same seed have common random numbers.
        """

    def measurement(
        self,
        request: ReleaseRequest,
        values: FloatArray,
        sigma: FloatArray,
        centre: FloatArray | None = None,
    ) -> Measurement:
        """Return a release in which all columns answer, with what they share written out.

        Args:
            request: The request.
            values: Shape (k, n_columns, 2), a fresh array.
            sigma: Shape (k, n_columns, 2), or one that broadcasts to it.
            centre: Speeds that flows are centred on [km/h], shape (k, n_places); None for the
                `flow_centre`.
        """
        if centre is None:
            centre = np.full((len(values), self.setup.n_places), self._common_centre)
        return Measurement(request.observed, values, np.broadcast_to(sigma, values.shape), centre)

    @property
    def releases_flow(self) -> bool:
        """True where flows are released, False where mean speeds are."""
        return not math.isnan(self._common_centre)

    @cached_property
    def _common_centre(self) -> float:
        centre = self.flow_centre(self.setup.corridor, self.setup.settings)
        return math.nan if centre is None else centre

    def load(self, index: int, record: Record) -> None:  # noqa: B027 (nothing by default)
        """Prepare for the traffic of an index into the traffic seeds; called once for each."""

    @property
    def shared(self) -> tuple[AnyArray, ...]:
        """Arrays that depend on the traffic alone, so that forks of the process share them."""
        return ()

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds on a vehicle's privacy loss so far, mu and epsilon, shape (k,) each.

        They are public, and infinite if unknown.

        Args:
            episodes: Distinct rows of the batch, shape (k,).
            steps: Steps released so far in each of them, shape (k,).
        """
        unknown = np.full(len(steps), math.inf)
        return unknown, unknown.copy()

    def report(self) -> PrivacyReport:
        """Return the privacy report; that of the base class claims no guarantee."""
        settings, setup = self.setup.settings, self.setup
        return PrivacyReport(
            preset=setup.name,
            guarantee="none",
            void_reasons=("not_stated",),
            protects=f"not stated by {name_of_class(type(self))}",
            claimed_epsilon=settings.epsilon,
            claimed_delta=settings.delta,
            speed_release="flow" if self.releases_flow else "mean",
            boundary_inputs=settings.boundary,
        )

    def public_info(self, episodes: IntArray) -> Rows:
        """Return further public entries of ``info``, rows of k episodes; by default none."""
        return {}

    def public_state(self, episodes: IntArray) -> tuple[FloatArray, FloatArray] | None:
        """Return prices (k, G) and tracer (k, n_mainline) of ``episodes``, see `PublicState`.

        None where queries have no prices.
        """
        return None

    def give_noise(self, noise: FloatArray) -> None:
        """Set the noise of the next release of all episodes, as what-if trials in forks need it.

        Args:
            noise: In standard deviations, shape (n_episodes, n_columns, 2).

        Raises:
            ValueError: Noise of this model cannot be set, or ``noise`` has another shape.
        """
        raise ValueError(f"noise of the release model {self.setup.name!r} cannot be set")

    def budgets_spent(self, episodes: IntArray) -> FloatArray:
        """Return the budgets that vehicles have spent so far, parts of them added up, shape (k,).

        Private; zeros where vehicles have no budget for their trip.
        """
        return np.zeros(len(episodes))

    def private_info(self, episodes: IntArray, traffic: IntArray) -> Rows:
        """Return private data for ``info["truth"]`` alone, rows of k episodes; by default none."""
        return {}
