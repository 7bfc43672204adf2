"""The base class of release models, and the check of what one from another package releases.

A `ReleaseModel` is made for a `Task`, and answers a `Request` with a
`dptse_env.estimators.Measurement`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.release.report import PrivacyReport
from dptse_env.release.settings import PrivacySettings
from dptse_env.release.task import Request, Task
from dptse_env.release.vehicles import Traffic
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.registry import name_of_class
from dptse_env.utils.vector_info import Infos


class ReleaseModel(ABC):
    """Base class of release models, for a batch of episodes.

    Estimators, observations and policies learn of the traffic through `release`, the boundary
    inputs (`dptse_env.measurement.boundary`) and the readings of loops alone. A subclass reads true
    traffic from ``traffic``. Its constructor must be cheap: nothing is loaded then.

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
    """True where each channel shows what its group sees, and spends its group's part of the
    budget."""
    takes_noise: ClassVar[bool] = False
    """True where noise is a `dptse_env.release.noise.Noise`, which `give_noise` sets for trainings
    by swaps, and which may be secure."""

    @classmethod
    def centre(cls, corridor: Corridor, settings: Any) -> float | None:
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
            episodes: Distinct episodes of the batch, shape (k,); their traffic is loaded.
            generators: k noise streams; only the model uses them from now on.
        """

    @abstractmethod
    def release(self, request: Request) -> Measurement:
        """Release one second of some episodes; called once for every second.

        Noise should be drawn for all channels, observed or not, so that different policies with the
        same seed have common random numbers.
        """

    def measurement(self, request: Request, values: FloatArray, sigma: FloatArray) -> Measurement:
        """Return a release in which all channels answer, around the `centre`.

        Args:
            request: The request.
            values: Shape (k, C, 2), a fresh array.
            sigma: Shape (k, C, 2), or one that broadcasts to it.
        """
        centre = math.nan if self.task.centre is None else self.task.centre
        places = np.full((len(values), self.task.n_cells), centre)
        return Measurement(request.observed, values, np.broadcast_to(sigma, values.shape), places)

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds on a vehicle's privacy loss so far, mu and epsilon, shape (k,) each.

        They are public, and infinite if unknown. They read like an odometer; what is guaranteed is
        the budget, in the report.

        Args:
            episodes: Distinct episodes of the batch, shape (k,).
            steps: Steps released so far in each of them, shape (k,).
        """
        unknown = np.full(len(steps), math.inf)
        return unknown, unknown.copy()

    @property
    def flags(self) -> tuple[FloatArray, ...]:
        """Numbers in `public`, shape (n,) each, that are 1 where something happened in a second.

        A step of several seconds tells of what happened in any of them.
        """
        return ()

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
        """Return further public numbers for ``info``, of k episodes; by default none.

        Where queries have prices, ``prices`` (k, G) and ``spent_share`` (k, n_mainline) are among
        them, as `dptse_env.spaces.observations.PublicState` describes them.
        """
        return {}

    def private(self, episodes: IntArray, traffic: IntArray) -> Infos:
        """Return what vehicles of k episodes have paid, for tests alone; by default nothing."""
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


def middle_speed(corridor: Corridor) -> float:
    """Return half of the largest speed limit [km/h]: speeds deviate alike to both sides."""
    return 0.5 * corridor.geometry.largest_speed_limit


def check_released(release: ReleaseModel, released: Any, request: Request) -> None:
    """Refuse a foreign model's release of a wrong type or shape, or that is not finite.

    Raises:
        ValueError: See above; what was not observed may be anything.
    """
    path = f"privacy.preset {name_of_class(release)}.release()"
    if not isinstance(released, Measurement):
        raise ValueError(f"{path} must return a Measurement, got {type(released).__name__}")
    channels, cells = request.observed.shape, (len(request.observed), release.task.n_cells)
    for name, array, kind, shape in (
        ("observed", released.observed, "b", channels),
        ("values", released.values, "f", (*channels, 2)),
        ("sigma", released.sigma, "f", (*channels, 2)),
        ("centre", released.centre, "f", cells),
    ):
        found = np.asarray(array)
        if found.shape != shape or found.dtype.kind != kind:
            raise ValueError(
                f"{path} must return {name} of shape {shape}, got {found.dtype} of shape "
                f"{found.shape}"
            )
    if (released.observed & ~request.observed).any():
        raise ValueError(f"{path} must not say that a channel was observed that was not asked for")
    if not np.isfinite(released.values[released.observed]).all():
        raise ValueError(f"{path} must return finite values of observed segments")
    if not (np.isfinite(released.sigma) & (released.sigma >= 0.0)).all():
        raise ValueError(f"{path} must return finite standard deviations >= 0")
    if release.task.releases_flow and not np.isfinite(released.centre).all():
        raise ValueError(f"{path} must return finite centres of flows")
