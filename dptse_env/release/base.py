"""Base class of release models: released values, privacy account and privacy report."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dptse_env.estimators import Estimate
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
        bandwidth: Largest number of mainline segments queried in a step.
        horizon: Steps of an episode.
        n_episodes: Size n of the batch.
    """

    name: str
    settings: PrivacySettings
    traffic: TrafficTable
    bandwidth: int
    horizon: int
    n_episodes: int

    @property
    def corridor(self) -> Corridor:
        """The road."""
        return self.traffic.corridor

    @cached_property
    def n_columns(self) -> int:
        """Columns of a release: the S segments, then the boundary segments if they are released."""
        corridor = self.corridor
        private = self.settings.boundary == "private"
        return corridor.n_segments + (corridor.n_boundaries if private else 0)

    @cached_property
    def always_observed(self) -> IntArray:
        """Columns that are observed at every step without a query."""
        corridor = self.corridor
        boundaries = range(corridor.n_segments, self.n_columns)
        return np.array([*corridor.fixed_sensors, *boundaries], dtype=np.int64)

    def observed(self, queried: BoolArray) -> BoolArray:
        """Return the observed columns (k, n_columns) of queried segments (k, n_mainline)."""
        observed = np.zeros((len(queried), self.n_columns), dtype=bool)
        observed[:, : queried.shape[1]] = queried
        observed[:, self.always_observed] = True
        return observed


def _no_prediction() -> Estimate:
    raise RuntimeError("this release request carries no prediction")


class ReleaseRequest(NamedTuple):
    """A second of k episodes whose data is to be released.

    Attributes:
        episodes: Distinct rows of the batch, shape (k,).
        traffic: Index of each episode's traffic seed, shape (k,).
        times: Second of the record, shape (k,).
        observed: Columns that were queried or are always observed, shape (k, n_columns).
        prediction: Returns the estimator's prediction for this second, which is public: it depends
            on earlier releases and the configuration alone. Raises where there is no estimator.
    """

    episodes: IntArray
    traffic: IntArray
    times: IntArray
    observed: BoolArray
    prediction: Callable[[], Estimate] = _no_prediction


class Released(NamedTuple):
    """Released values of a second of k episodes.

    Attributes:
        values: Density [veh/km] and mean speed [km/h] or centred flow [veh/h] of every column,
            shape (k, n_columns, 2), in a fresh array; those not observed are to be discarded.
        sigma: Standard deviations of their noise, shape (2,), in the same units.
    """

    values: FloatArray
    sigma: FloatArray


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
        """Standard deviations of the noise of both released quantities, shape (2,)."""

    @abstractmethod
    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes.

        Args:
            episodes: Distinct rows of the batch, shape (k,).
            generators: k noise streams; only the model uses them from now on.
        """

    @abstractmethod
    def release(self, request: ReleaseRequest) -> Released:
        """Release one second of some episodes.

        Noise should be drawn for all columns, observed or not, so that different policies with the
        same seed have common random numbers.
        """

    def load(self, index: int, record: Record) -> None:  # noqa: B027 (nothing by default)
        """Prepare for the traffic of an index into the traffic seeds; called once for each."""

    @property
    def shared(self) -> tuple[AnyArray, ...]:
        """Arrays that depend on traffic alone: a fork of the process shares them."""
        return ()

    def spent(self, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return mu and epsilon of a vehicle after some steps, (k,) each; infinite if unknown."""
        unknown = np.full(len(steps), math.inf)
        return unknown, unknown.copy()

    def report(self) -> PrivacyReport:
        """Return the privacy report; that of the base class claims no guarantee."""
        settings, setup = self.setup.settings, self.setup
        flow = self.flow_centre(setup.corridor, settings) is not None
        return PrivacyReport(
            preset=setup.name,
            guarantee="none",
            void_reasons=("not_stated",),
            protects=f"not stated by {name_of_class(type(self))}",
            claimed_epsilon=settings.epsilon,
            claimed_delta=settings.delta,
            speed_release="flow" if flow else "mean",
            boundary_inputs=settings.boundary,
        )

    def private_info(self, episodes: IntArray, traffic: IntArray) -> Rows:
        """Return private data for ``info["truth"]`` alone, rows of k episodes; by default none."""
        return {}
