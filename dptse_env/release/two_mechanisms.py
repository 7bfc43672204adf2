"""Queries that connected vehicles answer, and fixed sensors that see all: two mechanisms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dptse_env.estimators import Measurement
from dptse_env.model import MeasurementRows
from dptse_env.privacy import EpsilonTable, epsilon_of
from dptse_env.release.base import ReleaseModel, ReleaseRequest, ReleaseSetup
from dptse_env.release.detectors import DetectorErrors, Detectors
from dptse_env.release.queries import NO_OPTIONS
from dptse_env.release.report import PrivacyReport, in_order
from dptse_env.release.traffic_table import TrafficTable
from dptse_env.traffic import Penetration, Record
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.vector_info import Rows


@dataclass(frozen=True)
class PartSetup(ReleaseSetup):
    """Setup of a mechanism that releases some of the columns of a release.

    Attributes:
        whole: The setup of all columns.
        start: The first column of the part.
        stop: The first column after the part.
    """

    whole: ReleaseSetup | None = None
    start: int = 0
    stop: int = 0

    @property
    def _whole(self) -> ReleaseSetup:
        assert self.whole is not None
        return self.whole

    @cached_property
    def rows(self) -> MeasurementRows:
        """The rows among the part's columns."""
        rows = self._whole.rows
        part = slice(self.start, self.stop)
        return MeasurementRows(rows.first[part], rows.span[part], rows.n_segments)

    @cached_property
    def n_columns(self) -> int:
        """Columns of the part."""
        return self.stop - self.start

    @cached_property
    def always_observed(self) -> IntArray:
        """See `ReleaseSetup.always_observed`."""
        always = self._whole.always_observed
        return always[(always >= self.start) & (always < self.stop)] - self.start


class ConnectedTraffic(TrafficTable):
    """The traffic that connected vehicles report: their density, and their mean speeds."""

    def __init__(self, traffic: TrafficTable, penetration: Penetration) -> None:
        """Prepare a table for the traffic seeds of another; nothing is loaded."""
        super().__init__(traffic.corridor, traffic.traffic_seeds, traffic.library)
        self._penetration = penetration

    def record(self, index: int) -> Record:
        """Return the rows of the connected vehicles in the record of ``traffic_seeds[index]``."""
        record = super().record(index).vehicles_for("the keyword penetration")
        return self._penetration.reports(self.traffic_seeds[index], record)


class TwoMechanisms(ReleaseModel):
    """Two release models of one kind: of connected vehicles for queries, of all for fixed sensors.

    A query sums over the connected vehicles of its segments; a fixed sensor over all vehicles of
    its segment. The mechanisms share no ledger, since a fixed sensor cannot tell which vehicle is
    which: each has a part of the budget mu^2 for the trip of a vehicle. Their squared parameters
    add up to that of a connected vehicle (composition of Gaussian mechanisms); a vehicle that is
    not connected is seen by the fixed sensors alone and has their smaller parameter.

    Without fixed sensors the queries have the whole budget.

    Attributes:
        queries: Release model of the queries.
        sensors: Release model of the fixed sensors, and of boundary segments that are released;
            None without any.
    """

    def __init__(
        self,
        model: type[ReleaseModel],
        setup: ReleaseSetup,
        penetration: Penetration,
        detectors: Detectors,
    ) -> None:
        """Make both models; nothing is loaded."""
        super().__init__(setup)
        split = setup.queries.n_options
        has_sensors = setup.always_observed.size > 0
        self.takes_noise = model.takes_noise
        self._claims = model.claims_guarantee
        self._connected = ConnectedTraffic(setup.traffic, penetration)
        self._split = split if has_sensors else setup.n_columns

        no_options = replace(NO_OPTIONS, n_mainline=setup.corridor.n_mainline)

        def part(start: int, stop: int, traffic: TrafficTable, share: float) -> ReleaseModel:
            is_sensors = start > 0
            return model(
                PartSetup(
                    setup.name, setup.settings, traffic,
                    bandwidth=0 if is_sensors else setup.bandwidth,
                    horizon=setup.horizon, n_episodes=setup.n_episodes,
                    queries=no_options if is_sensors else setup.queries,
                    budget_share=share if self._claims else 1.0,
                    whole=setup, start=start, stop=stop,
                )
            )  # fmt: skip

        published = penetration.published_share
        share = detectors.part_of_budget(published) if has_sensors else 0.0
        self.queries = part(0, self._split, self._connected, 1.0 - share)
        self.sensors = None
        self._errors = None
        if has_sensors:
            self.sensors = part(self._split, setup.n_columns, setup.traffic, share)
            if not detectors.are_exact:
                self._errors = DetectorErrors(
                    detectors,
                    self._sensor_columns - self._split,
                    setup.lengths[self._sensor_columns],
                    setup.n_episodes,
                )

    @cached_property
    def _sensor_columns(self) -> IntArray:
        """Column of each fixed sensor, shape (F,)."""
        setup = self.setup
        return np.array(setup.queries.sensor_rows(setup.corridor), dtype=np.int64)

    @property
    def parts(self) -> tuple[ReleaseModel, ...]:
        """The models that there are."""
        return (self.queries,) if self.sensors is None else (self.queries, self.sensors)

    @property
    def sigma(self) -> FloatArray:
        """See `ReleaseModel.sigma`: those of a query, before it is divided by the share."""
        return self.queries.sigma

    @property
    def shared(self) -> tuple[Any, ...]:
        """Arrays and tables of both that depend on traffic alone."""
        arrays = [array for part in self.parts for array in (*part.shared, part.setup)]
        return (*arrays, self._connected)

    def load(self, index: int, record: Record) -> None:
        """See `ReleaseModel.load`; queries read the connected vehicles alone."""
        for _, reported in self._connected.load([index]):
            self.queries.load(index, reported)
        if self.sensors is not None:
            self.sensors.load(index, record)

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `ReleaseModel.reset`; each mechanism has streams of its own."""
        streams = list(zip(*(generator.spawn(3) for generator in generators), strict=True))
        self.queries.reset(episodes, streams[0])
        if self.sensors is not None:
            self.sensors.reset(episodes, streams[1])
        if self._errors is not None:
            self._errors.reset(episodes, streams[2])

    def release(self, request: ReleaseRequest) -> Measurement:
        """See `ReleaseModel.release`."""
        observed, split = request.observed, self._split
        queried = self.queries.release(request._replace(observed=observed[:, :split]))
        if self.sensors is None:
            return queried
        seen = observed[:, split:]
        if self._errors is not None:
            seen = seen.copy()
            seen[:, self._sensor_columns - split] &= ~self._errors.silent(request.episodes)
        sensed = self.sensors.release(request._replace(observed=seen))
        if self._errors is not None:
            flows = self.sensors.releases_flow
            sensed = self._errors.apply(request.episodes, sensed, releases_flow=flows)
        return Measurement(
            np.concatenate([queried.observed, sensed.observed], axis=1),
            np.concatenate([queried.values, sensed.values], axis=1),
            np.concatenate([queried.sigma, sensed.sigma], axis=1),
            sensed.centre,
        )

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `ReleaseModel.spent`: that of a connected vehicle, under both mechanisms."""
        squares = sum(part.spent(episodes, steps)[0] ** 2 for part in self.parts)
        return self._epsilons.bounds(np.sqrt(squares))

    @cached_property
    def _epsilons(self) -> EpsilonTable:
        return EpsilonTable(self._mu, self.setup.settings.delta)

    @cached_property
    def _mu(self) -> float:
        """Parameter of both mechanisms together."""
        return math.hypot(*(part.report().mu for part in self.parts))

    def report(self) -> PrivacyReport:
        """See `ReleaseModel.report`; it is that of a connected vehicle, under both mechanisms."""
        reports, settings = [part.report() for part in self.parts], self.setup.settings
        own, mu = reports[0], self._mu
        reasons = in_order(reason for report in reports for reason in report.void_reasons)
        epsilon = epsilon_of(mu, settings.delta)
        if epsilon > settings.epsilon * (1.0 + 1e-9):
            reasons = in_order({*reasons, "releases_not_composed"})
        protected = f"a connected vehicle: {own.protects}, under queries and fixed sensors together"
        details = {
            f"{name}_mu": report.mu
            for name, report in zip(("queries", "sensors"), reports, strict=False)
        }
        return replace(
            own,
            guarantee="none" if reasons else own.guarantee.replace(own.protects, protected),
            void_reasons=reasons,
            protects=protected,
            mu=mu,
            epsilon=epsilon,
            epsilon_strict=epsilon_of(mu, own.strict_delta),
            details={**own.details, **details},
        )

    def public_state(self, episodes: IntArray) -> tuple[FloatArray, FloatArray] | None:
        """See `ReleaseModel.public_state`, of the queries."""
        return self.queries.public_state(episodes)

    def public_info(self, episodes: IntArray) -> Rows:
        """See `ReleaseModel.public_info`, of the queries."""
        return self.queries.public_info(episodes)

    def give_noise(self, noise: FloatArray) -> None:
        """See `ReleaseModel.give_noise`."""
        self.queries.give_noise(noise[:, : self._split])
        if self.sensors is not None:
            self.sensors.give_noise(noise[:, self._split :])

    def budgets_spent(self, episodes: IntArray) -> FloatArray:
        """See `ReleaseModel.budgets_spent`: parts of the budget of a connected vehicle."""
        spent = sum(part.setup.budget_share * part.budgets_spent(episodes) for part in self.parts)
        return np.asarray(spent, dtype=np.float64)

    def private_info(self, episodes: IntArray, traffic: IntArray) -> Rows:
        """Return those of the queries, and those of the fixed sensors as ``sensor_<name>``."""
        infos = dict(self.queries.private_info(episodes, traffic))
        if self.sensors is not None:
            for name, rows in self.sensors.private_info(episodes, traffic).items():
                infos[f"sensor_{name}"] = rows
        return infos
