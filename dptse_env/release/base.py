"""The types of a release, and the base class of release models.

A `Task` says what is measured of which road, a `Request` asks for a second of it, and a
`ReleaseModel` answers with a `dptse_env.estimators.Measurement`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.estimators import Estimate, Measurement
from dptse_env.model import MeasurementRows
from dptse_env.model.network import covered
from dptse_env.privacy import Adjacency, rounded_up
from dptse_env.release.noise import NoiseSource
from dptse_env.release.queries import QueryOptions
from dptse_env.release.report import PrivacyReport
from dptse_env.release.vehicles import Traffic
from dptse_env.traffic import Corridor, Penetration
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.fields import Interval, checked_fields, require
from dptse_env.utils.registry import name_of_class
from dptse_env.utils.vector_info import Infos

BoundaryInputs = Literal["true", "nominal", "private"]
"""Source of the estimator's inputs at the boundary: measured traffic, public demand, or the
boundary segments' releases."""

CHANGES: dict[Adjacency, str] = {
    "replace": "replaced by any other, connected or not, or by none",
    "add_remove": "added or removed",
}
"""Change of a vehicle's data between two adjacent records, in words."""


@dataclass(frozen=True)
class PrivacySettings:
    """Settings of every release model, the keyword ``privacy``; subclasses add further ones.

    Attributes:
        preset: The release model: ``paper``, ``corrected``, ``capped``, ``paced``, a registered
            name, ``"package.module:Class"``, or a class.
        epsilon: Privacy parameter epsilon.
        delta: Privacy parameter delta.
        boundary_inputs: Source of the estimator's inputs at the boundary: ``true``, ``nominal`` or
            ``private``; None for the model's default.
        noise: Source of the noise: ``seeded``, the episode's stream, for simulation, or ``secure``,
            the operating system's randomness, which nobody can repeat. Both have exactly the same
            distribution. An episode with secure noise stays where it began: its process has no
            `fork`, and a copy, a pickle or an operating system's fork must reset it.

    Raises:
        ValueError: A field is out of range; the message names its path below ``privacy``.
    """

    default_boundary: ClassVar[BoundaryInputs] = "true"

    preset: Any = "paper"
    epsilon: Annotated[float, Interval(1e-4, 1e4)] = 1.0
    delta: Annotated[float, Interval(1e-12, 0.5, open_high=True)] = 0.05
    boundary_inputs: BoundaryInputs | None = None
    noise: NoiseSource = "seeded"

    def __post_init__(self) -> None:
        """Check the fields."""
        checked_fields(self, "privacy")

    @property
    def boundary(self) -> BoundaryInputs:
        """Source of the estimator's inputs at the boundary."""
        return self.boundary_inputs or self.default_boundary

    def guarantee(self, mu: float, quantities: str, protected: str) -> str:
        """Return the sentence that states mu and (epsilon, delta), and what is protected."""
        against = "" if self.noise == "secure" else ", against whoever does not know the seed"
        return (
            f"{rounded_up(mu)}-Gaussian differential privacy, which is "
            f"({rounded_up(self.epsilon)}, {rounded_up(self.delta)})-differential privacy, of "
            f"{quantities} together, for {protected}{against}"
        )


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
        model: Its class.
        settings: Its settings, of its ``settings_type``.
        corridor: The road, with the scales of densities and speeds.
        queries: The options that can be queried, the first G columns, and their bandwidth.
        horizon: Steps of an episode.
        n_episodes: Size n of the batch.
        groups: Groups of columns, one or two. All columns are one group, or the options are the
            first and all others the second.

    Raises:
        ValueError: Groups see other vehicles, or there are two, and the model knows of none; or
            its noise cannot be secure.
    """

    name: str
    model: type[ReleaseModel]
    settings: Any
    corridor: Corridor
    queries: QueryOptions
    horizon: int
    n_episodes: int = 1
    groups: tuple[Group, ...] = (Group("queries"),)

    def __post_init__(self) -> None:
        """Check that the release model can serve the groups, and has the noise."""
        if not (self.is_whole or self.model.knows_groups):
            raise ValueError(
                f"penetration.share must be 1, and detectors left out, with the release model "
                f"{self.name!r}, which knows of no groups of columns"
            )
        has_noise = self.settings.noise == "seeded" or self.model.takes_noise
        only = f"'seeded' with the release model {self.name!r}, whose noise is its own"
        require(has_noise, "privacy.noise", only, self.settings.noise)

    @property
    def is_whole(self) -> bool:
        """True if all columns see all vehicles, as one group."""
        return len(self.groups) == 1 and self.groups[0].population is None

    # Speeds -------------------------------------------------------------------------------------

    @cached_property
    def flow_centre(self) -> float | None:
        """Speed v_0 [km/h] that released flows are centred on; None where mean speeds are."""
        return self.model.flow_centre(self.corridor, self.settings)

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


class ReleaseModel(ABC):
    """Base class of release models, for a batch of episodes.

    Estimators, observations and policies learn of the traffic through `release` and the boundary
    inputs (`dptse_env.release.boundary`) alone. A subclass reads true traffic from ``traffic``. Its
    constructor must be cheap: nothing is loaded then.

    A model with a guarantee overrides `report` and `spent`; otherwise no guarantee is reported.

    Attributes:
        task: What is measured.
        traffic: The true traffic; that of an episode is in memory from its `reset` on.
    """

    settings_type: ClassVar[type[PrivacySettings]] = PrivacySettings
    """Dataclass of the settings under the keyword ``privacy``."""
    claims_guarantee: ClassVar[bool] = False
    """True where users expect a guarantee, so that a warning is due if it is void."""
    releases_sums: ClassVar[bool] = False
    """True where a release may cover several segments."""
    needs_vehicles: ClassVar[bool] = False
    """True where the model reads the vehicles of a record, which measured fields have not."""
    has_prices: ClassVar[bool] = False
    """True where queries have prices, which `public` gives."""
    knows_groups: ClassVar[bool] = False
    """True where each column shows what its group sees, and spends its group's part of the
    budget."""
    takes_noise: ClassVar[bool] = False
    """True where noise is a `dptse_env.release.noise.Noise`, which `give_noise` sets for trainings
    by swaps, and which may be secure."""

    @classmethod
    def flow_centre(cls, corridor: Corridor, settings: Any) -> float | None:
        """Return the speed v_0 [km/h] that released flows rho (v - v_0) are centred on.

        None where mean speeds are released.
        """
        return None

    def __init__(self, task: Task, traffic: Traffic) -> None:
        """Store the configuration."""
        self.task, self.traffic = task, traffic

    @property
    @abstractmethod
    def sigma(self) -> FloatArray:
        """Standard deviations of the noise of both released quantities of a query, shape (2,).

        Where they vary, those that are expected before an episode begins.
        """

    @abstractmethod
    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes.

        Args:
            episodes: Distinct rows of the batch, shape (k,); their traffic is loaded.
            generators: k noise streams; only the model uses them from now on.
        """

    @abstractmethod
    def release(self, request: Request) -> Measurement:
        """Release one second of some episodes; called once for every second.

        Noise should be drawn for all columns, observed or not, so that different policies with the
        same seed have common random numbers.
        """

    def measurement(self, request: Request, values: FloatArray, sigma: FloatArray) -> Measurement:
        """Return a release in which all columns answer, around the `flow_centre`.

        Args:
            request: The request.
            values: Shape (k, C, 2), a fresh array.
            sigma: Shape (k, C, 2), or one that broadcasts to it.
        """
        centre = math.nan if self.task.flow_centre is None else self.task.flow_centre
        places = np.full((len(values), self.task.n_places), centre)
        return Measurement(request.observed, values, np.broadcast_to(sigma, values.shape), places)

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds on a vehicle's privacy loss so far, mu and epsilon, shape (k,) each.

        They are public, and infinite if unknown. They read like an odometer; what is guaranteed is
        the budget, in the report.

        Args:
            episodes: Distinct rows of the batch, shape (k,).
            steps: Steps released so far in each of them, shape (k,).
        """
        unknown = np.full(len(steps), math.inf)
        return unknown, unknown.copy()

    def report(self) -> PrivacyReport:
        """Return the privacy report; that of the base class claims no guarantee."""
        task, settings = self.task, self.task.settings
        return PrivacyReport(
            preset=task.name,
            guarantee="none",
            void_reasons=("not_stated",),
            protects=f"not stated by {name_of_class(type(self))}",
            claimed_epsilon=settings.epsilon,
            claimed_delta=settings.delta,
            speed_release="flow" if task.releases_flow else "mean",
            boundary_inputs=settings.boundary,
            noise=settings.noise,
        )

    def public(self, episodes: IntArray) -> Infos:
        """Return further public numbers for ``info``, rows of k episodes; by default none.

        Where queries have prices, ``prices`` (k, G) and ``tracer`` (k, n_mainline) are among them,
        as `dptse_env.spaces.observations.PublicState` describes them.
        """
        return {}

    def private(self, episodes: IntArray, traffic: IntArray) -> Infos:
        """Return private data for ``info["truth"]`` alone, rows of k episodes; by default none."""
        return {}

    def budgets_spent(self, episodes: IntArray) -> FloatArray:
        """Return the budgets that vehicles have spent so far, parts of them added up, shape (k,).

        Private; zeros where vehicles have no budget for their trip.
        """
        return np.zeros(len(episodes))

    def give_noise(self, noise: FloatArray) -> None:
        """Set the noise of the next release of all episodes, as what-if trials in forks need it.

        Args:
            noise: In standard deviations, shape (n, C, 2).

        Raises:
            ValueError: Noise of this model cannot be set, or ``noise`` has another shape.
        """
        raise ValueError(f"noise of the release model {self.task.name!r} cannot be set")


def check_released(release: ReleaseModel, released: Any, request: Request) -> None:
    """Refuse a foreign model's release of a wrong type or shape, or that is not finite.

    Raises:
        ValueError: See above; what was not observed may be anything.
    """
    path = f"privacy.preset {name_of_class(release)}.release()"
    if not isinstance(released, Measurement):
        raise ValueError(f"{path} must return a Measurement, got {type(released).__name__}")
    columns, places = request.observed.shape, (len(request.observed), release.task.n_places)
    for name, array, kind, shape in (
        ("observed", released.observed, "b", columns),
        ("values", released.values, "f", (*columns, 2)),
        ("sigma", released.sigma, "f", (*columns, 2)),
        ("centre", released.centre, "f", places),
    ):
        found = np.asarray(array)
        if found.shape != shape or found.dtype.kind != kind:
            raise ValueError(
                f"{path} must return {name} of shape {shape}, got {found.dtype} of shape "
                f"{found.shape}"
            )
    if (released.observed & ~request.observed).any():
        raise ValueError(f"{path} must not say that a column was observed that was not asked for")
    if not np.isfinite(released.values[released.observed]).all():
        raise ValueError(f"{path} must return finite values of observed segments")
    if not (np.isfinite(released.sigma) & (released.sigma >= 0.0)).all():
        raise ValueError(f"{path} must return finite standard deviations >= 0")
    if release.task.releases_flow and not np.isfinite(released.centre).all():
        raise ValueError(f"{path} must return finite centres of flows")
