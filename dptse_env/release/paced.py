"""The release model `Paced`: prices from public predictions, paid from a ledger of each vehicle."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.privacy import EpsilonTable, epsilon_of, mu_of
from dptse_env.release.base import ReleaseModel, ReleaseRequest, ReleaseSetup
from dptse_env.release.ledgers import Columns, Ledgers, Sums
from dptse_env.release.noise import NoiseStreams, grid_of
from dptse_env.release.pacing import (
    PACINGS,
    EventPacing,
    PacingSetup,
    PublicStep,
    check_prices,
)
from dptse_env.release.queries import QueryOptions
from dptse_env.release.report import STRICT_DELTA, PrivacyReport
from dptse_env.release.settings import PacedSettings, PrivacySettings
from dptse_env.release.vehicle_table import VehicleTable
from dptse_env.traffic import Corridor, Record
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.vector_info import Rows, object_array

ROUNDING = 1e-9
"""Part of the budget that is kept back for rounding errors of ledgers."""


class Paced(ReleaseModel):
    """Counts and deviations of speeds, for which each vehicle pays from a ledger of its own.

    A vehicle on a queried segment pays for its own deviation from the speed that the estimator
    predicts there, as in `dptse_env.release.ledgers`; prices are those of a pacing
    (`dptse_env.release.pacing`). With mu the parameter of the guarantee, a vehicle has a budget of
    mu^2 / 2 against its replacement by another, and of mu^2 against being added or removed. The
    guarantee holds for any query policy, any estimator and any pacing: ``docs/privacy.md`` has the
    proof.

    Attributes:
        mu: Parameter of Gaussian differential privacy of all releases together.
        budget: Budget of a vehicle, a part of which ledgers keep back for rounding.
        ledgers: Charges that the vehicles have paid.
        pacing: Rule that sets the prices.
        noise: Standard normal noise.
        prices: Prices of the last release, shape (n, C); public, as the centres are.
        centres: Centres of the last release [km/h], of the segments and of the boundary segments
            if they are released, shape (n, places).
    """

    settings_type: ClassVar[type[PrivacySettings]] = PacedSettings
    claims_guarantee: ClassVar[bool] = True
    needs_vehicles: ClassVar[bool] = True
    releases_sums: ClassVar[bool] = True
    has_prices: ClassVar[bool] = True
    takes_noise: bool = True

    @classmethod
    def flow_centre(cls, corridor: Corridor, settings: PacedSettings) -> float | None:
        """Return half of the largest speed limit; a release has a centre for each segment."""
        return 0.5 * corridor.largest_speed_limit

    def __init__(self, setup: ReleaseSetup) -> None:
        """Compute the budget; nothing is loaded."""
        super().__init__(setup)
        assert isinstance(setup.settings, PacedSettings)
        self._settings = settings = setup.settings
        corridor, n = setup.corridor, setup.n_episodes
        self.mu = mu_of(settings.epsilon, settings.delta) * math.sqrt(setup.budget_share)
        self._epsilons = EpsilonTable(self.mu, settings.delta)
        self._squares = 2.0 if settings.adjacency == "replace" else 1.0
        self.budget = self.mu**2 / self._squares
        first, span, places = setup.places, setup.spans, setup.n_places
        level = np.ones(setup.n_columns)
        level[: setup.queries.n_options] = setup.queries.level
        self.ledgers = Ledgers(
            Columns(first, span, places),
            VehicleTable(
                len(setup.traffic.traffic_seeds),
                corridor.duration + 1,
                corridor.largest_speed_limit,
            ),
            n,
            budget=(1.0 - ROUNDING) * self.budget,
            clip=settings.clip,
            ratio=settings.ratio,
        )
        # A pacing that offers the whole budget at once stays below what ledgers hold back.
        offered = (1.0 - 2.0 * ROUNDING) * self.budget
        made_for = PacingSetup(
            corridor, offered, settings.pace, settings.ratio, first, span, level,
            setup.always_observed, _coverage(setup.queries), places, n,
        )  # fmt: skip
        pacing = EventPacing if settings.unit == "event" else PACINGS.find(settings.pacing)
        self.pacing = pacing(made_for)
        self.noise = NoiseStreams(n, setup.n_columns)
        self.prices = np.zeros((n, setup.n_columns))
        self.centres = np.zeros((n, places))
        self._charged = np.zeros(n)  # largest payments that a vehicle can have made
        self._fallback = np.zeros(n)
        self._refused = np.zeros(n, dtype=np.int64)

    @cached_property
    def sigma(self) -> FloatArray:
        """Deviations of the shortest segment's noise at the published demand, shape (2,)."""
        corridor = self.setup.corridor
        price = self.pacing.expected_price(np.array(corridor.speed_limits))
        shortest = min(corridor.segment_lengths)
        sigma: FloatArray = self._deviations(np.array([[price]]))[0, 0] / shortest
        return sigma

    def _deviations(self, prices: FloatArray) -> FloatArray:
        """Return the deviations of the noise of both sums, shape (k, C, 2), at prices (k, C)."""
        settings = self._settings
        count = 1.0 / np.sqrt(prices)
        return np.stack([count, settings.clip / math.sqrt(settings.ratio) * count], axis=-1)

    @property
    def shared(self) -> tuple[AnyArray, ...]:
        """The vehicles of all traffic."""
        return self.ledgers.vehicles.arrays

    def load(self, index: int, record: Record) -> None:
        """Read the vehicles of a record."""
        user = f"the release model {self.setup.name!r}"
        self.ledgers.load(index, record.vehicles_for(user))

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `ReleaseModel.reset`; no vehicle has paid anything yet."""
        self.noise.reset(episodes, generators)
        self.ledgers.reset(episodes)
        self.pacing.reset(episodes)
        for array in (self.prices, self.centres, self._charged, self._fallback):
            array[episodes] = 0.0
        self._refused[episodes] = 0

    def release(self, request: ReleaseRequest) -> Measurement:
        """See `ReleaseModel.release`."""
        episodes, prediction = request.episodes, request.prediction()
        density, speed = self._public(request, prediction.density, prediction.speed)
        step = PublicStep(episodes, request.observed, density, speed)
        prices = check_prices(self.pacing.prices(step), request.observed.shape)
        fastest = self.setup.corridor.largest_speed_limit
        centre = self.setup.at_places(np.clip(speed, 0.0, fastest))
        self.prices[episodes], self.centres[episodes] = prices, centre
        self._charge(episodes, request.observed, prices)
        sums = self.collect(request, prices, centre)
        self._refused[episodes] = sums.refused
        return self._published(request, sums, prices, centre)

    def _public(
        self, request: ReleaseRequest, density: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return predicted densities and speeds; empty free road where they are not finite."""
        finite = np.isfinite(density) & np.isfinite(speed)
        self._fallback[request.episodes] = ~finite.all(axis=1)
        if finite.all():
            return density, speed
        nominal = np.array(self.setup.corridor.speed_limits)
        return np.where(finite, density, 0.0), np.where(finite, speed, nominal)

    def _charge(self, episodes: IntArray, observed: BoolArray, prices: FloatArray) -> None:
        """Add the largest payment that a vehicle can make in this second."""
        paid = np.where(observed, (1.0 + self._settings.ratio) * prices, 0.0)
        if self.ledgers.are_single:
            largest = paid.max(axis=1)
        else:
            largest = (paid @ self.ledgers.covers).max(axis=1)
        if self._settings.unit == "event":
            self._charged[episodes] = np.maximum(self._charged[episodes], largest)
        else:
            self._charged[episodes] += largest

    def collect(self, request: ReleaseRequest, prices: FloatArray, centre: FloatArray) -> Sums:
        """Return the true sums of a second, and charge the vehicles.

        For the unit ``event`` every second has a budget of its own.
        """
        if self._settings.unit == "event":
            self.ledgers.reset(request.episodes)
        return self.ledgers.collect(
            request.episodes, request.traffic, request.times, request.observed, prices, centre
        )

    def _published(
        self, request: ReleaseRequest, sums: Sums, prices: FloatArray, centre: FloatArray
    ) -> Measurement:
        """Add noise, round to the grid, and divide by the lengths of the queries."""
        deviations = self._deviations(prices)
        values = self.noise.next(request.episodes)
        values *= deviations
        values[..., 0] += sums.counts
        values[..., 1] += sums.deviations
        grid = grid_of(deviations)
        values /= grid
        np.rint(values, out=values)
        values *= grid
        lengths = self.setup.lengths[:, None]
        values /= lengths
        return self.measurement(request, values, deviations / lengths, centre)

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `ReleaseModel.spent`.

        Squared distances are at most those of two vehicles that have paid the largest price of
        each second so far, within the budget. Epsilon is rounded up to one of 256 levels of mu.
        """
        return self._losses(self._charged[episodes])

    def _losses(self, paid: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mu and epsilon of vehicles that have paid these amounts at most."""
        return self._epsilons.bounds(np.sqrt(self._squares * paid))

    def report(self) -> PrivacyReport:
        """See `ReleaseModel.report`."""
        settings, mu = self._settings, self.mu
        return replace(
            super().report(),
            guarantee=settings.guarantee("count and flow", settings.protected),
            void_reasons=(),
            protects=settings.protected,
            mu=mu,
            epsilon=epsilon_of(mu, settings.delta),
            epsilon_strict=epsilon_of(mu, STRICT_DELTA),
            assumptions={"budget": self.budget},
            details={
                "unit": settings.unit,
                "adjacency": settings.adjacency,
                "pace": settings.pace,
                "clip": settings.clip,
                "ratio": settings.ratio,
            },
        )

    def public_state(self, episodes: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `ReleaseModel.public_state`; prices are those of the last second, 0 at first."""
        n_options = self.setup.queries.n_options
        return self.prices[episodes, :n_options], self.pacing.tracer(episodes)

    def public_info(self, episodes: IntArray) -> Rows:
        """Return whether centres fell back to nominal speeds, since no prediction was finite."""
        return {"centre_fallback": self._fallback[episodes].copy()}

    def give_noise(self, noise: FloatArray) -> None:
        """See `ReleaseModel.give_noise`."""
        self.noise.give(noise)

    def budgets_spent(self, episodes: IntArray) -> FloatArray:
        """See `ReleaseModel.budgets_spent`: payments over the budget."""
        if self._settings.unit == "event":
            return np.zeros(len(episodes))
        paid: FloatArray = self.ledgers.paid[episodes].sum(axis=1)
        return paid / self.budget

    def private_info(self, episodes: IntArray, traffic: IntArray) -> Rows:
        """Return what each vehicle has paid, the epsilon that it has spent, and refusals.

        ``ledgers`` are payments over the budget. The first two are lists, since records differ in
        their number of vehicles and Gymnasium stacks arrays of equal shape only.
        """
        paid = [
            self.ledgers.paid_by(episode, index)
            for episode, index in zip(episodes, traffic, strict=True)
        ]
        return {
            "ledgers": object_array([(ledger / self.budget).tolist() for ledger in paid]),
            "individual_epsilon": object_array([self._losses(row)[1].tolist() for row in paid]),
            "n_refused": self._refused[episodes].copy(),
        }


def _coverage(options: QueryOptions) -> float:
    """Return the share of the mainline that a step's queries cover if all options are alike."""
    if options.n_options == 0:
        return 0.0
    bought = options.bandwidth * float(np.mean(options.span / options.cost))
    return min(bought / options.n_mainline, 1.0)
