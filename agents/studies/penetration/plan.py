"""Plan of the study of penetration."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from agents.experiments.cells import Design
from agents.studies.penetration.cell import (
    COUNT,
    DETECTORS,
    ESTIMATED,
    FACTORS,
    FUSED,
    GUARANTEED,
    HEALTHY,
    MISREPORTING,
    MIXED,
    PACED,
    PRINTED,
    QUERIES,
    RELEASES,
    REPORTED,
    TESTED,
    TRUCK_SHARE,
    TRUCKS,
    UNKNOWN,
    UNKNOWN_SHARES,
    WHOLE,
    WITHOUT,
    PenetrationCell,
)
from dptse_env.schedules import COVARIANCE_SCHEDULES
from dptse_env.utils.validation import require_name

NOTHING = "none"
"""The schedule of detectors alone."""
WITH_COVARIANCE = "ekf"
"""The estimator whose covariance some schedules read."""


@dataclass(frozen=True)
class PenetrationDesign(Design[PenetrationCell]):
    """The cells of the study.

    Attributes:
        seeds: Test traffic seeds, first:stop.
        schedule: Query schedule where schedules are not compared.
        env: Environment id.
        releases: Release models.
        estimators: Estimators.
        shares: Shares p of connected vehicles, ascending.
        base_share: The share at which arms are compared and sensors fail.
        detectors: Segments on which detectors stand.
        bandwidth: Segments that are queried a second.
        policies: Query schedules that are ranked, under ``paced``.
        policy_shares: Shares at which they are.
        policy_estimators: Estimators with which they are.
        fault_estimators: Estimators that meet faults, under ``paper`` and ``paced``.
        report_estimators: Estimators that are given densities from spacings and neighbours, and
            traffic with trucks.
    """

    schedule: str = "round-robin"
    env: str = "dptse_env:dptse/PrivateHighway-v1"
    releases: tuple[str, ...] = RELEASES
    estimators: tuple[str, ...] = ("ekf", "ukf", "enkf", "mhe", "recurrent", "random_walk")
    shares: tuple[float, ...] = (0.01, 0.03, 0.1, 0.3, 1.0)
    base_share: float = 0.1
    detectors: tuple[int, ...] = (3, 7, 11)
    bandwidth: int = 5
    policies: tuple[str, ...] = (
        "round-robin", "paper", "oldest-first", "largest-variance", "inflated-trace", "static",
    )  # fmt: skip
    policy_shares: tuple[float, ...] = (0.03, 0.1, 0.3, 1.0)
    policy_estimators: tuple[str, ...] = ("ekf", "recurrent")
    fault_estimators: tuple[str, ...] = ("ekf", "ukf", "enkf", "mhe", "recurrent")
    report_estimators: tuple[str, ...] = ("ekf", "enkf", "recurrent")

    def check(self) -> None:
        """See `Design.check`."""
        super().check()
        if self.corridor is not None:
            raise ValueError(f"corridor is part of this study, leave it out; got {self.corridor!r}")
        for release in self.releases:
            require_name("releases", release, RELEASES)
        if list(self.shares) != sorted(set(self.shares)) or self.base_share not in self.shares:
            raise ValueError(
                f"shares must ascend and hold base_share {self.base_share:g}, got {self.shares}"
            )
        if self.schedule not in self.policies:
            raise ValueError(f"policies must hold {self.schedule!r}, got {self.policies}")

    def quick(self) -> PenetrationDesign:
        """Return a design of few cells on few seeds."""
        return dataclasses.replace(
            self,
            seeds=self.first_seeds(3),
            releases=(PRINTED, PACED),
            estimators=("ekf", "recurrent"),
            shares=(self.base_share, 1.0),
            policy_shares=(self.base_share,),
            fault_estimators=("ekf",),
            report_estimators=("ekf",),
        )

    def fused(self, release: str, estimator: str, share: float | None = None) -> PenetrationCell:
        """Return the cell of both kinds of sensors, at the base share unless another is given."""
        p = self.base_share if share is None else share
        return PenetrationCell(release, estimator, FUSED, p, self.schedule)

    def queries(self, release: str, estimator: str, share: float) -> PenetrationCell:
        """Return the cell of queries alone."""
        return PenetrationCell(release, estimator, QUERIES, share, self.schedule)

    def alone(self, release: str, estimator: str, arm: str = WHOLE) -> PenetrationCell:
        """Return the cell of detectors alone, which no share changes.

        They have the whole budget, or that which they have beside queries; without a guarantee
        there is no budget, and the two are one cell.
        """
        arm = arm if release in GUARANTEED else DETECTORS
        return PenetrationCell(release, estimator, arm, self.base_share, NOTHING)

    def chosen(self, estimator: str, share: float, policy: str) -> PenetrationCell:
        """Return the cell of a schedule that is ranked."""
        return PenetrationCell(PACED, estimator, FUSED, share, policy)

    def unknown(self, release: str, estimator: str, fusion: str = "") -> PenetrationCell:
        """Return the cell of an unknown share; its middle is published."""
        share = sum(UNKNOWN_SHARES) / 2.0
        return PenetrationCell(
            release, estimator, FUSED, share, self.schedule, UNKNOWN, fusion=fusion
        )

    def reported(self, release: str, estimator: str, share: float, source: str) -> PenetrationCell:
        """Return the cell of both kinds of sensors with densities from a source."""
        return dataclasses.replace(self.fused(release, estimator, share), density_from=source)

    def classes(self, release: str, estimator: str, world: str, source: str) -> PenetrationCell:
        """Return the cell of traffic with trucks, of queries alone."""
        base = self.queries(release, estimator, TRUCK_SHARE)
        return dataclasses.replace(base, world=world, density_from=source)

    def faulty(
        self, release: str, estimator: str, worlds: tuple[str, ...], fusion: str = ""
    ) -> list[PenetrationCell]:
        """Return the cells of some faults, of each detector in turn where detectors fail."""
        base = dataclasses.replace(self.fused(release, estimator), fusion=fusion)
        return [
            dataclasses.replace(base, world=world, detector=k)
            for world in worlds
            for k in (range(len(self.detectors)) if world in (*FACTORS, WITHOUT) else (-1,))
        ]

    def policies_of(self, estimator: str) -> list[str]:
        """Return the schedules that suit an estimator."""
        return [
            policy
            for policy in self.policies
            if estimator == WITH_COVARIANCE or policy not in COVARIANCE_SCHEDULES
        ]

    @property
    def printed_and_paced(self) -> list[str]:
        """The release models under which shares are unknown and sensors fail."""
        return [release for release in (PRINTED, PACED) if release in self.releases]

    def all_cells(self) -> Iterator[PenetrationCell]:
        """See `Design.all_cells`."""
        for pair in itertools.product(self.releases, self.estimators):
            for share in self.shares:
                yield self.fused(*pair, share)
                yield self.queries(*pair, share)
            yield self.alone(*pair, DETECTORS)
            yield self.alone(*pair, WHOLE)
        for pair in itertools.product(self.releases, self.report_estimators):
            for share, source in itertools.product(self.shares, REPORTED):
                yield self.reported(*pair, share, source)
        for pair in itertools.product(self.printed_and_paced, self.report_estimators):
            for world, source in itertools.product((MIXED, TRUCKS), (COUNT, *REPORTED)):
                yield self.classes(*pair, world, source)
        if PACED in self.releases:
            for estimator, share in itertools.product(self.policy_estimators, self.policy_shares):
                for policy in self.policies_of(estimator):
                    yield self.chosen(estimator, share, policy)
        for pair in itertools.product(self.printed_and_paced, self.estimators):
            yield self.unknown(*pair)
            yield self.unknown(*pair, ESTIMATED)
        for pair in itertools.product(self.printed_and_paced, self.fault_estimators):
            for fusion in ("", TESTED):
                yield from self.faulty(*pair, (HEALTHY, *FACTORS, MISREPORTING), fusion)
            yield from self.faulty(*pair, (WITHOUT,))

    def keywords(self, cell: PenetrationCell) -> dict[str, Any]:
        """See `Design.keywords`."""
        road = cell.detectors(self.detectors)
        return {**cell.keywords, **road, "bandwidth": self.bandwidth}
