"""The release model `Paced`: prices from public predictions, paid from a ledger of each vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.privacy import (
    ROUNDING,
    Adjacency,
    EpsilonTable,
    epsilon_of,
    epsilons_of,
    mu_of,
    require_covered,
)
from dptse_env.release.model import ReleaseModel, middle_speed
from dptse_env.release.noise import Noise
from dptse_env.release.pacing import EventPacing, Pacing, TripPacing
from dptse_env.release.report import PrivacyReport
from dptse_env.release.settings import CHANGES, BoundaryInputs, PrivacySettings
from dptse_env.release.task import Request, Task
from dptse_env.release.vehicles import Ledgers, Terms, Traffic, require_exact_sums
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, kernel
from dptse_env.utils.validation import Interval
from dptse_env.utils.vector_info import Infos, object_array

PacedUnit = Literal["trip", "event"]
"""Unit of protection of the paced ledger: a complete trip, or a second of it."""


@dataclass(frozen=True)
class PacedSettings(PrivacySettings):
    """Settings of `Paced`.

    Attributes:
        unit: Unit of protection: ``trip``, all of a vehicle's trip that an episode covers;
            ``event``, one second of a trip.
        adjacency: Difference of two adjacent records: ``replace`` or ``add_remove``.
        clip: Largest deviation D of a speed from its centre that is released [km/h]; larger ones
            are clipped.
        ratio: Ratio r of the charge for a deviation of D and the charge for being counted; noise
            of flows has D / sqrt(r) times the deviation of that of counts. At most 1 for the
            adjacency ``replace``.

    Raises:
        ValueError: A field is out of range; the message names its path below ``privacy``.
    """

    default_boundary: ClassVar[BoundaryInputs] = "nominal"

    preset: Any = "paced"
    unit: PacedUnit = "trip"
    adjacency: Adjacency = "replace"
    clip: Annotated[float, Interval(1, 200)] = 25.0
    ratio: Annotated[float, Interval(0.01, 100)] = 1.0

    def __post_init__(self) -> None:
        """Check the fields, and that they are compatible."""
        super().__post_init__()
        if self.ratio > 1.0 and self.adjacency == "replace":
            raise ValueError(
                "privacy.ratio must be at most 1 for privacy.adjacency 'replace', where two "
                f"vehicles may deviate in opposite directions, got {self.ratio:g}"
            )

    @property
    def protected(self) -> str:
        """Description of the protected data."""
        return f"one vehicle's {'whole trip' if self.unit == 'trip' else 'second of a trip'}"


class Paced(ReleaseModel):
    """Counts and deviations of speeds, for which each vehicle pays from ledgers of its own.

    A vehicle on a queried segment pays for its own deviation from the speed that the estimator
    predicts there, as in `dptse_env.release.vehicles`; prices are those of a pacing
    (`dptse_env.release.pacing`). With mu the parameter of the guarantee of a group of channels, a
    vehicle has a budget of mu^2 / 2 there against its replacement by another, and of mu^2 against
    being added or removed; the mu^2 of the groups add up to that of all releases. The guarantee
    holds for any query policy, any estimator and any positive prices; ``docs/privacy/proof.md``
    proves it.

    Attributes:
        mu: Parameter of Gaussian differential privacy of each group, shape (groups,).
        budget: Budget of a vehicle in each group, of which ledgers keep back `ROUNDING`.
        ledgers: Charges that the vehicles have paid.
        pacing: Rule that sets the prices.
        noise: Standard normal noise.
        prices: Prices of the last release, shape (n, C); public, as the centres are.
    """

    settings_type: ClassVar[type[PrivacySettings]] = PacedSettings
    claims_guarantee: ClassVar[bool] = True
    needs_vehicles: ClassVar[bool] = True
    releases_sums: ClassVar[bool] = True
    has_prices: ClassVar[bool] = True
    knows_groups: ClassVar[bool] = True
    takes_noise: ClassVar[bool] = True

    @classmethod
    def centre(cls, corridor: Corridor, settings: PacedSettings) -> float:
        """Return the middle of the speeds; a release has a centre for each segment."""
        return middle_speed(corridor)

    def __init__(self, task: Task, traffic: Traffic) -> None:
        """Compute the budgets; nothing is loaded."""
        super().__init__(task, traffic)
        n, settings = task.n_episodes, task.settings
        self.mu: FloatArray = mu_of(settings.epsilon, settings.delta) * np.sqrt(task.shares)
        self._epsilons = EpsilonTable(math.hypot(*self.mu), settings.delta)
        # The counts of two vehicles on one segment cancel; deviations may be opposite.
        self._squares = 2.0 if settings.adjacency == "replace" else 1.0
        self._whole = self.mu**2
        self.budget = self._whole / self._squares
        terms = Terms(
            (1.0 - ROUNDING) * self.budget,
            ratio=settings.ratio,
            clip=settings.clip,
            fastest=np.float32(task.corridor.geometry.largest_speed_limit),
        )
        self.ledgers = Ledgers(task.channels, n, terms)
        pacing = EventPacing if settings.unit == "event" else TripPacing
        # A pacing that offers the whole budget at once stays below what ledgers hold back.
        self.pacing: Pacing = pacing(task, (1.0 - 2.0 * ROUNDING) * self.budget)
        self.noise = Noise(n, task.n_channels, settings.noise)
        self.prices = np.zeros((n, task.n_channels))
        # The largest payments that a vehicle can have made in each group.
        self._charged = np.zeros((n, len(task.groups)))
        self._accounts = Bundle(
            task.channels,
            _Accounts(
                settings.ratio, settings.unit == "event", task.n_cells, self.prices, self._charged
            ),
        )
        self._flow_noise = settings.clip / math.sqrt(settings.ratio)
        require_covered(task.horizon * int(task.covers.sum(axis=0).max()))
        # No vehicle pays a price above its budget.
        least = 1.0 / math.sqrt(self.budget.max())
        require_exact_sums(np.array([least, self._flow_noise * least]), settings.clip)
        road = task.corridor.road
        self._limits = road.limits[: road.n_segments]
        self._neighbours = road.beside[: task.n_cells - road.n_segments]
        self._fallback = np.zeros(n)
        self._refused = np.zeros((n, len(task.groups)), dtype=np.int64)

    @cached_property
    def _expected_std(self) -> FloatArray:
        """Deviations of the shortest segment's noise at the published demand, shape (groups, 2)."""
        corridor = self.task.corridor
        prices = self.pacing.expected_prices(np.array(corridor.geometry.speed_limits))
        count = 1.0 / np.sqrt(prices)
        std: FloatArray = np.stack([count, self._flow_noise * count], axis=-1)
        return std / min(corridor.geometry.segment_lengths)

    @property
    def sigma(self) -> FloatArray:
        """See `ReleaseModel.sigma`; at the published demand, of the shortest segment."""
        sigma: FloatArray = self._expected_std[0]
        return sigma

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `ReleaseModel.reset`; no vehicle has paid anything yet."""
        self.noise.reset(episodes, generators)
        self.ledgers.reset(episodes, self.traffic.n_vehicles)
        self.pacing.reset(episodes)
        for array in (self.prices, self._charged, self._fallback, self._refused):
            array[episodes] = 0

    def release(self, request: Request) -> Measurement:
        """See `ReleaseModel.release`."""
        task, episodes, observed = self.task, request.episodes, request.observed
        predicted, centre = self._predicted(request)
        prices = self.pacing.prices(episodes, observed, *predicted)
        sigma = np.empty((*prices.shape, 2))
        _charge(self._accounts, episodes, observed, prices, self._flow_noise, sigma)
        sums, self._refused[episodes] = self.collect(request, prices, centre, sigma)
        values = self.noise.added(episodes, sums, sigma, task.channels.length)
        sigma /= task.channels.length[:, None]
        return Measurement(observed, values, sigma, centre)

    def _predicted(self, request: Request) -> tuple[FloatArray, FloatArray]:
        """Return predicted densities and speeds (2, k, S), and speeds as centres (k, S + R).

        They are those of an empty free road where they are not finite.
        """
        prediction, task = request.prediction(), self.task
        predicted = np.empty((2, *prediction.density.shape))
        centre = np.empty((predicted.shape[1], task.n_cells))
        fallback = np.empty(len(centre))
        _centre(
            prediction.density, prediction.speed, self._limits, self._neighbours,
            task.corridor.geometry.largest_speed_limit, predicted, centre, fallback,
        )  # fmt: skip
        self._fallback[request.episodes] = fallback
        return predicted, centre

    def collect(
        self, request: Request, prices: FloatArray, centre: FloatArray, sigma: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Charge the vehicles of a second; return its true sums and refusals, see `Ledgers`."""
        if self.task.settings.unit == "event":  # every second has a budget of its own
            self.ledgers.reset(request.episodes)
        rows = self.traffic.vehicles(request.traffic, request.times)
        return self.ledgers.collect(request.episodes, request.observed, rows, prices, centre, sigma)

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `ReleaseModel.spent`.

        Squared distances are at most those of two vehicles that have paid the largest price of
        each second so far, within their budgets. Epsilon is rounded up to one of 256 levels of mu.
        """
        return self._losses(self._charged[episodes])

    def _losses(self, paid: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mu and epsilon of vehicles that have paid at most (vehicles, groups)."""
        squares = np.minimum((1.0 + ROUNDING) * self._squares * paid, self._whole)
        return self._epsilons.bounds(np.sqrt(squares.sum(axis=1)))

    def report(self) -> PrivacyReport:
        """See `ReleaseModel.report`."""
        task, settings, mu = self.task, self.task.settings, self._epsilons.mu
        protects = task.protects(settings.protected, CHANGES[settings.adjacency])
        return replace(
            super().report(),
            guarantee=settings.guarantee(mu, "count and flow", protects),
            void_reasons=(),
            protects=protects,
            mu=mu,
            epsilon=epsilon_of(mu, settings.delta),
            epsilons=epsilons_of(mu),
            assumptions={"budget": float(self.budget[0])},
            details={
                "unit": settings.unit,
                "adjacency": settings.adjacency,
                "clip": settings.clip,
                "ratio": settings.ratio,
                **task.group_reports(self.mu, self._expected_std),
            },
        )

    def public(self, episodes: IntArray) -> Infos:
        """Return prices and spent shares of the queries, and whether no prediction was finite.

        Prices (k, G) are those of the last second, 0 at first; spent shares are of shape
        (k, n_mainline); then ``centre_fallback`` is 1.
        """
        return {
            "prices": self.prices.take(episodes, 0)[:, : self.task.queries.n_queries],
            "spent_share": self.pacing.spent_share(episodes),
            "centre_fallback": self._fallback[episodes],
        }

    @property
    def flags(self) -> tuple[FloatArray, ...]:
        """See `ReleaseModel.flags`: whether no prediction was finite."""
        return (self._fallback,)

    def budgets_spent(self, episodes: IntArray) -> FloatArray:
        """See `ReleaseModel.budgets_spent`: payments over the budgets of all groups together."""
        if self.task.settings.unit == "event":
            return np.zeros(len(episodes))
        paid = self.ledgers.paid[episodes].sum(axis=(1, 2))
        spent: FloatArray = paid / self.budget.sum()
        return spent

    def private(self, episodes: IntArray, traffic: IntArray) -> Infos:
        """Return what each vehicle has paid over its budget, its epsilon, and refusals.

        The first two are lists, since records differ in their number of vehicles. ``ledgers`` are
        those of the queries; those of a second group of channels are ``sensor_ledgers``.
        """
        paid = self.ledgers.of(episodes, self.traffic.n_vehicles[traffic])
        infos: Infos = {
            f"{prefix}ledgers": object_array([(each[g] / self.budget[g]).tolist() for each in paid])
            for g, prefix in zip(range(self.budget.size), ("", "sensor_"), strict=False)
        }
        return {
            **infos,
            "individual_epsilon": object_array([self._losses(p.T)[1].tolist() for p in paid]),
            "n_refused": self._refused[episodes].sum(axis=1),
        }

    def give_noise(self, noise: FloatArray) -> None:
        """See `ReleaseModel.give_noise`."""
        self.noise.give(noise)


class _Accounts(NamedTuple):
    """Numbers of a release that are published."""

    ratio: float
    is_event: bool
    n_cells: int
    prices: FloatArray  # (n, C) of the last release
    charged: FloatArray  # (n, groups) the largest payments that a vehicle can have made


@kernel
def _centre(
    density: FloatArray,
    speed: FloatArray,
    limits: FloatArray,
    neighbours: IntArray,
    fastest: float,
    predicted: FloatArray,
    centre: FloatArray,
    fallback: FloatArray,
) -> None:
    """Write finite predictions, their speeds as centres, and whether some were not finite."""
    n_segments = limits.size
    for k in range(fallback.size):
        fallback[k] = 0.0
        for s in range(n_segments):
            rho, v = density[k, s], speed[k, s]
            if not (np.isfinite(rho) and np.isfinite(v)):
                rho, v = 0.0, limits[s]
                fallback[k] = 1.0
            predicted[0, k, s], predicted[1, k, s] = rho, v
            centre[k, s] = min(max(v, 0.0), fastest)
        for r in range(neighbours.size):
            centre[k, n_segments + r] = centre[k, neighbours[r]]


@kernel
def _charge(
    bundle: Bundle,
    episodes: IntArray,
    observed: BoolArray,
    prices: FloatArray,
    flow_noise: float,
    sigma: FloatArray,
) -> None:
    """Publish prices; add the largest payment that a vehicle can make to each group in a second.

    Write the deviations of the noise of both sums to `sigma`, shape (k, C, 2).
    """
    channels, accounts = bundle.parts
    paid = np.empty((accounts.charged.shape[1], accounts.n_cells))
    for k in range(episodes.size):
        paid[:] = 0.0
        for c in range(channels.first.size):
            price, first = prices[k, c], channels.first[c]
            accounts.prices[episodes[k], c] = price
            sigma[k, c, 0] = 1.0 / np.sqrt(price)
            sigma[k, c, 1] = flow_noise * sigma[k, c, 0]
            if observed[k, c]:
                for s in range(first, first + channels.span[c]):
                    paid[channels.group[c], s] += (1.0 + accounts.ratio) * price
        charged = accounts.charged[episodes[k]]
        for g in range(charged.size):
            largest = paid[g].max()
            charged[g] = max(charged[g], largest) if accounts.is_event else charged[g] + largest
