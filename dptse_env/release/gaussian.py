"""Release models with Gaussian noise of a constant deviation: `Printed`, `Corrected`, `Capped`."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.privacy import (
    ROUNDING,
    Adjacency,
    ReleaseAccount,
    Sensitivity,
    contribution_sensitivity,
    epsilon_of,
    epsilons_of,
    joint_noise_std,
    paper_sensitivity,
    printed_noise_std,
    single_noise_std,
)
from dptse_env.release.model import ReleaseModel, middle_speed
from dptse_env.release.noise import Noise
from dptse_env.release.report import PrivacyReport, QuantityReport, in_order
from dptse_env.release.settings import CHANGES, BoundaryInputs, Change, PrivacySettings
from dptse_env.release.task import Request, Task
from dptse_env.release.vehicles import Ledgers, Terms, Traffic, require_exact_sums
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.validation import Interval
from dptse_env.utils.vector_info import Infos, object_array

Unit = Literal["trip", "event"]
"""Unit of protection: a trip with capped contributions, or a second of it."""


class GaussianRelease(ReleaseModel):
    """Release of true values plus Gaussian noise; subclasses define values and sensitivity.

    Sensitivity and noise are those of the shortest segment. One vehicle changes the density of a
    longer one by less, in proportion to its length, and its noise is smaller by as much: a vehicle
    counts alike on every segment, in units of the noise. Where flows are released, noise is added
    to the sums of vehicles and of their deviations, before these are divided by the length.

    Attributes:
        sensitivity: L2 sensitivities of both released quantities over an episode, by group.
        noise_std: Standard deviations of the noise of both, shape (groups, 2).
        added_std: Those of the noise that is added to `true_values`, shape (n, C, 2).
        unit: What these are divided by, shape (C,).
        mu: Parameter of Gaussian differential privacy of each group, rounded up, shape (groups,).
        ledgers: Contributions of the vehicles so far.
        noise: Standard normal noise.
    """

    void_reasons: ClassVar[tuple[str, ...]] = ()
    """Reasons for which the sensitivity or the noise gives no guarantee."""
    knows_groups: ClassVar[bool] = True
    takes_noise: ClassVar[bool] = True

    def __init__(self, task: Task, traffic: Traffic) -> None:
        """Compute sensitivity and noise; nothing is loaded."""
        super().__init__(task, traffic)
        n, groups = task.n_episodes, range(len(task.groups))
        self.sensitivity = tuple(self._sensitivity(group) for group in groups)
        self.noise_std: FloatArray = np.array([self._noise_std(group) for group in groups])
        self.mu: FloatArray = (1.0 + ROUNDING) * np.array(
            [self.sensitivity[group].joint_mu(self.noise_std[group].tolist()) for group in groups]
        )
        self._account = ReleaseAccount(
            math.hypot(*self.mu), task.settings.delta, self.sensitivity[0].contributions
        )
        shortest = min(task.corridor.geometry.segment_lengths)
        sigma = np.tile(self.noise_std[task.channels.group], (n, 1, 1))
        if task.releases_flow:
            self.unit, self.added_std = task.channels.length, sigma * shortest
        else:
            self.unit, self.added_std = task.channels.length / shortest, sigma
        self._released_sigma = self.added_std / self.unit[:, None]
        v_0 = math.nan if task.centre is None else task.centre
        self._centre = np.full((n, task.n_cells), v_0)
        self._price = np.ones((n, task.n_channels))
        self.noise = Noise(n, task.n_channels, task.settings.noise)
        self.ledgers = Ledgers(task.channels, n, self._terms())
        if task.releases_flow:
            require_exact_sums(self.added_std[0].min(axis=0), self.ledgers.terms.clip)

    def _terms(self) -> Terms:
        """Return terms on which vehicles may count without end."""
        return Terms(np.full(len(self.task.groups), math.inf))

    @abstractmethod
    def _sensitivity(self, group: int) -> Sensitivity:
        """Return the sensitivities of both released quantities in a group of channels."""

    @abstractmethod
    def _noise_std(self, group: int) -> tuple[float, ...]:
        """Return the standard deviations of the noise that `sensitivity` needs in a group."""

    @abstractmethod
    def true_values(self, request: Request) -> FloatArray:
        """Return what noise is added to, shape (k, C, 2).

        Sums over vehicles where flows are released, else means times the length of a channel over
        that of the shortest segment. Where contributions are bounded, those of the observed
        channels are charged.
        """

    @property
    def protects(self) -> str:
        """Description of the protected data and of the change that is protected."""
        change = Change("replaced by another", "replaced by others")
        return self.task.protects("one vehicle's trip", change)

    @property
    def sigma(self) -> FloatArray:
        """See `ReleaseModel.sigma`."""
        sigma: FloatArray = self.noise_std[0]
        return sigma

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `ReleaseModel.reset`; no vehicle has counted yet."""
        self.noise.reset(episodes, generators)
        self.ledgers.reset(episodes, self.traffic.n_vehicles)

    def release(self, request: Request) -> Measurement:
        """See `ReleaseModel.release`."""
        values = self.true_values(request)
        k = len(values)
        values = self.noise.added(request.episodes, values, self.added_std[:k], self.unit)
        return Measurement(request.observed, values, self._released_sigma[:k], self._centre[:k])

    def sums(self, request: Request, centre: FloatArray) -> FloatArray:
        """Return the sums of the vehicles that count, and of their speeds from a centre."""
        rows, k = self.traffic.vehicles(request.traffic, request.times), len(request.episodes)
        public = self._price[:k], centre[:k], self.added_std[:k]
        sums, _ = self.ledgers.collect(request.episodes, request.observed, rows, *public)
        return sums

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `ReleaseModel.spent`."""
        return self._account.spent(steps)

    def report(self) -> PrivacyReport:
        """See `ReleaseModel.report`; it describes the noise in force, its quantities the queries'.

        With two groups the parameters are those of a vehicle that both see: its mu^2 is the sum of
        theirs.
        """
        task, settings, sensitivity = self.task, self.task.settings, self.sensitivity[0]
        mu = self._account.mu
        epsilon = epsilon_of(mu, settings.delta)
        found = list(self.void_reasons)
        # Le Ny's kappa may be so loose that even both releases together stay below epsilon.
        if epsilon > settings.epsilon * (1.0 + 1e-9):
            found.append("releases_not_composed")
        protects = self.protects
        quantities = " and ".join(release.quantity for release in sensitivity.releases)
        return replace(
            super().report(),
            guarantee="none" if found else settings.guarantee(mu, quantities, protects),
            void_reasons=in_order(found),
            protects=protects,
            mu=mu,
            epsilon=epsilon,
            epsilons=epsilons_of(mu),
            releases=tuple(
                QuantityReport(item.quantity, item.unit, item.bound, std, item.bound / std)
                for item, std in zip(sensitivity.releases, self.sigma.tolist(), strict=True)
            ),
            assumptions=dict(sensitivity.assumptions),
            details={**self._details(), **task.group_reports(self.mu, self.noise_std)},
        )

    def _details(self) -> Mapping[str, Any]:
        """Return the settings specific to this model, for the report; none of them is None."""
        return {"adjacency": "replace"}

    def give_noise(self, noise: FloatArray) -> None:
        """See `ReleaseModel.give_noise`."""
        self.noise.give(noise)


def require_gaussian(release: ReleaseModel, user: str) -> GaussianRelease:
    """Return a release model with Gaussian noise; ``user`` names in errors what needs one.

    Raises:
        ValueError: It is another release model.
    """
    if not isinstance(release, GaussianRelease):
        raise ValueError(
            f"{user} needs a release model with Gaussian noise, got {release.task.name!r}"
        )
    return release


class Printed(GaussianRelease):
    """True density and mean speed of all vehicles, with the noise as printed in the paper.

    Where a group of channels does not see all vehicles, of those that it sees.
    """

    void_reasons: ClassVar[tuple[str, ...]] = (
        "literal_variance", "average_dwell", "adaptive_queries", "speed_sensitivity",
    )  # fmt: skip

    def __init__(self, task: Task, traffic: Traffic) -> None:
        """See `GaussianRelease`."""
        super().__init__(task, traffic)
        in_order = np.array_equal(task.channels.first, np.arange(task.n_cells))
        self._places = slice(None) if in_order else task.channels.first
        self._zero = np.zeros((task.n_episodes, task.n_cells))

    def _sensitivity(self, group: int) -> Sensitivity:
        task, corridor = self.task, self.task.corridor
        always = int(np.count_nonzero(task.channels.group[task.always] == group))
        return paper_sensitivity(
            n_sensors=(0 if group else task.queries.bandwidth) + always,
            average_dwell=corridor.scales.average_dwell,
            segment_length=min(corridor.geometry.segment_lengths),
            # Constants of the corridor, so that the noise does not depend on the estimator.
            free_flow_speed=corridor.scales.speed_scale,
            jam_density=corridor.scales.density_scale,
        )

    def _noise_std(self, group: int) -> tuple[float, ...]:
        settings = self.task.settings
        return printed_noise_std(self.sensitivity[group], settings.epsilon, settings.delta)

    def true_values(self, request: Request) -> FloatArray:
        """See `GaussianRelease.true_values`."""
        task = self.task
        if not task.is_whole:
            return self._means(request)
        values = self.traffic.aggregates(request.traffic, request.times, task.n_cells)
        return values[:, self._places] * self.unit[:, None]

    def _means(self, request: Request) -> FloatArray:
        """Return `true_values` of the vehicles that each channel sees.

        Without any of them the speed limit is the mean; unobserved channels hold these, too.
        """
        task = self.task
        sums = self.sums(request, self._zero)
        counts, limit = sums[..., 0].copy(), task.corridor.road.limits[task.channels.first]
        sums[..., 0] /= task.channels.length
        sums[..., 1] = np.where(counts == 0.0, limit, sums[..., 1] / np.maximum(counts, 1.0))
        sums *= self.unit[:, None]
        return sums


class Corrected(Printed):
    """The same as `Printed`, with the noise that the theorem cited there needs, per release."""

    void_reasons: ClassVar[tuple[str, ...]] = Printed.void_reasons[1:]

    def _noise_std(self, group: int) -> tuple[float, ...]:
        settings = self.task.settings
        return single_noise_std(self.sensitivity[group], settings.epsilon, settings.delta)


@dataclass(frozen=True)
class CappedSettings(PrivacySettings):
    """Settings of `Capped`.

    Attributes:
        unit: Unit of protection: ``trip``, a vehicle's whole trip, which is counted in its first
            ``cap`` observed seconds alone; ``event``, one second of a trip.
        cap: Observed seconds in which a vehicle is counted, for the unit ``trip``; one of the
            length of an episode leaves out none.
        adjacency: Difference of two adjacent records: ``replace`` or ``add_remove``.
        share: Part of the budget mu^2 for the density.

    Raises:
        ValueError: A field is out of range; the message names its path below ``privacy``.
    """

    default_boundary: ClassVar[BoundaryInputs] = "nominal"

    preset: Any = "capped"
    unit: Unit = "trip"
    cap: Annotated[int, Interval(1, 1_000_000)] = 64
    adjacency: Adjacency = "replace"
    share: Annotated[float, Interval(0.001, 0.999)] = 0.5

    @property
    def contribution_cap(self) -> int | None:
        """Observed seconds in which a vehicle is counted; None for all of them."""
        return self.cap if self.unit == "trip" else None

    def contributions(self, horizon: int) -> int:
        """Return the most seconds of ``horizon`` in which the protected unit can count."""
        return min(self.cap, horizon) if self.unit == "trip" else 1

    @property
    def protected(self) -> str:
        """Description of the protected data."""
        if self.unit == "trip":
            until = f"the first {self.cap} seconds in which it is observed, then no more"
            return f"one vehicle's whole trip (counted in {until})"
        return "one second of one vehicle's trip"


class Capped(GaussianRelease):
    """Density and centred flow of vehicles that count a bounded number of times.

    The guarantee holds for any query policy. The centred flow [veh/h] is the sum of v - v_0 over
    the vehicles that count, per length, with v clipped to [0, 2 v_0]: it changes by at most v_0 / l
    when a vehicle comes or goes. ``docs/privacy/proof.md`` has the proof. A vehicle's ledger has a
    budget of C contributions at a price of 1 each, in each group of channels.
    """

    settings_type: ClassVar[type[PrivacySettings]] = CappedSettings
    claims_guarantee: ClassVar[bool] = True
    needs_vehicles: ClassVar[bool] = True

    @classmethod
    def centre(cls, corridor: Corridor, settings: CappedSettings) -> float:
        """Return the middle of the speeds, which are clipped to the largest limit."""
        return middle_speed(corridor)

    def _terms(self) -> Terms:
        """Return terms on which a vehicle counts as often as the cap allows in each group."""
        task, cap = self.task, self.task.settings.contribution_cap
        return Terms(
            np.full(len(task.groups), math.inf if cap is None else float(cap)),
            clip=self.centre(task.corridor, task.settings),
            fastest=np.float32(task.corridor.geometry.largest_speed_limit),
        )

    def _sensitivity(self, group: int) -> Sensitivity:
        corridor, settings = self.task.corridor, self.task.settings
        return contribution_sensitivity(
            contributions=settings.contributions(self.task.horizon),
            adjacency=settings.adjacency,
            segment_length=min(corridor.geometry.segment_lengths),
            largest_speed=corridor.geometry.largest_speed_limit,
        )

    def _noise_std(self, group: int) -> tuple[float, ...]:
        settings, sensitivity = self.task.settings, self.sensitivity[group]
        noise = joint_noise_std(sensitivity, settings.epsilon, settings.delta, settings.share)
        factor = (1.0 + ROUNDING) / math.sqrt(self.task.shares[group])
        return tuple(factor * std for std in noise)

    @property
    def protects(self) -> str:
        """See `GaussianRelease.protects`."""
        settings = self.task.settings
        return self.task.protects(settings.protected, CHANGES[settings.adjacency])

    def _details(self) -> Mapping[str, Any]:
        settings = self.task.settings
        cap = {"cap": settings.cap} if settings.unit == "trip" else {}
        return {
            "unit": settings.unit, **cap, "adjacency": settings.adjacency, "share": settings.share,
        }  # fmt: skip

    def true_values(self, request: Request) -> FloatArray:
        """See `GaussianRelease.true_values`; unobserved channels hold zeros."""
        return self.sums(request, self._centre)

    def budgets_spent(self, episodes: IntArray) -> FloatArray:
        """See `ReleaseModel.budgets_spent`: contributions over their cap, by shares of groups."""
        cap = self.task.settings.contribution_cap
        counted = self.task.shares @ self.ledgers.paid[episodes].sum(axis=2).T
        spent: FloatArray = counted / cap if cap else np.zeros(len(episodes))
        return spent

    def private(self, episodes: IntArray, traffic: IntArray) -> Infos:
        """Return each vehicle's contributions, and the epsilon that it has spent.

        Lists, since records differ in their number of vehicles. ``exposures`` are contributions to
        queries; those to a second group of channels are ``sensor_exposures``.
        """
        counted = self.ledgers.of(episodes, self.traffic.n_vehicles[traffic])
        # A vehicle that has counted k times has spent the budget of a cap of k.
        cap = self.task.settings.contributions(self.task.horizon)
        spent = [self._account.epsilons(self.mu**2 @ steps / cap) for steps in counted]
        infos: Infos = {
            f"{prefix}exposures": object_array([steps[g].astype(int).tolist() for steps in counted])
            for g, prefix in zip(range(len(self.task.groups)), ("", "sensor_"), strict=False)
        }
        return {**infos, "individual_epsilon": object_array(spent)}
