"""Plan of the study of estimators: its cells, and the traffic of each world."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from agents.environments import make_config, quietly
from agents.experiments.cells import Design
from agents.studies.estimators.cell import DEFAULT_WEIGHTS, LEARNED, LINEAR, EstimatorCell
from agents.studies.estimators.worlds import ELSEWHERE, GUARANTEES, MAIN, WORLDS, World
from dptse_env.config import EnvConfig, parse_seeds
from dptse_env.estimators.learned.weights import SavedNetwork, member_for, read_network
from dptse_env.schedules import OBSERVATION_SCHEDULES
from dptse_env.utils.validation import require_name

OWN = "largest-deviation"
"""The schedule on the deviations that the estimator reports."""
WITH_POLICY = ("capped",)
"""Worlds whose observations the shipped query policy knows."""


@dataclass(frozen=True)
class EstimatorDesign(Design[EstimatorCell]):
    """The cells of the study.

    Attributes:
        seeds: Test traffic seeds of `MAIN` and `GUARANTEES`, first:stop.
        elsewhere_seeds: Those of `ELSEWHERE`.
        schedule: Base schedule.
        schedules: Schedules that quick estimators meet in `MAIN`.
        policy: Query policy that ships with the package.
        quick_estimators: Estimators that meet every schedule.
        slow_estimators: Estimators that meet the base schedule and the first of `schedules` only.
        moved_estimators: Estimators that are run in `ELSEWHERE`.
        weights: Network that counts as the estimator.
        networks: Networks of other training seeds.
        fit_seeds: Training traffic seeds on which linear stacks are fitted.
        worlds: Names of the worlds that are run; none stands for all of them, or with ``corridor``
            for those that are no roads of their own.
    """

    seeds: str = "2000:2064"
    elsewhere_seeds: str = "2000:2024"
    schedule: str = "round-robin"
    schedules: tuple[str, ...] = ("paper", "round-robin", "oldest-first", "stale-variance", OWN)
    policy: str = "private-highway"
    quick_estimators: tuple[str, ...] = ("ekf", "random_walk", "blend", LINEAR, LEARNED)
    slow_estimators: tuple[str, ...] = ("ukf", "enkf", "mhe")
    moved_estimators: tuple[str, ...] = ("ekf", "random_walk", LEARNED)
    weights: str = DEFAULT_WEIGHTS
    networks: tuple[str, ...] = ()
    fit_seeds: str = "0:32"
    worlds: tuple[str, ...] = ()

    def check(self) -> None:
        """See `Design.check`; unknown worlds and schedules are refused as well."""
        super().check()
        for world in self.run_worlds:
            require_name("worlds", world, WORLDS)
            if self.corridor is not None and world in ELSEWHERE:
                raise ValueError(
                    f"worlds must be of {', '.join({**MAIN, **GUARANTEES})} where a corridor is "
                    f"given, got {world!r}"
                )
        for schedule in self.schedules:
            require_name("schedules", schedule, OBSERVATION_SCHEDULES)
        if self.schedule not in self.schedules:
            raise ValueError(
                f"schedules must hold the base schedule {self.schedule!r}, got {self.schedules}"
            )

    @property
    def run_worlds(self) -> tuple[str, ...]:
        """Names of the worlds that are run."""
        return self.worlds or tuple(WORLDS if self.corridor is None else {**MAIN, **GUARANTEES})

    @property
    def main(self) -> dict[str, World]:
        """The worlds in which every estimator meets every schedule."""
        return {name: MAIN[name] for name in MAIN if name in self.run_worlds}

    @property
    def guarantees(self) -> dict[str, World]:
        """Worlds of other actions and guarantees under ``paced``."""
        return {name: GUARANTEES[name] for name in GUARANTEES if name in self.run_worlds}

    @property
    def elsewhere(self) -> dict[str, World]:
        """Worlds that differ from `PrivateHighway-v1` in one thing."""
        return {name: ELSEWHERE[name] for name in ELSEWHERE if name in self.run_worlds}

    def quick(self) -> EstimatorDesign:
        """Return a design of few cells on few seeds."""
        return dataclasses.replace(
            self,
            seeds=self.first_seeds(3),
            elsewhere_seeds=self.first_seeds(2),
            schedules=("paper", "round-robin", OWN),
            quick_estimators=("ekf", "random_walk", LINEAR, LEARNED),
            slow_estimators=("ukf",),
            fit_seeds="0:2",
        )

    def seeds_of(self, cell: EstimatorCell) -> tuple[int, ...]:
        """Return the traffic seeds of a cell."""
        return parse_seeds(self.elsewhere_seeds if cell.world in ELSEWHERE else self.seeds)

    def cell(
        self, world: str, estimator: str = LEARNED, schedule: str = "", weights: str = ""
    ) -> EstimatorCell:
        """Return a cell; the base schedule and the base network unless others are given."""
        own = (weights or self.weights) if estimator == LEARNED else ""
        return EstimatorCell(world, estimator, schedule or self.schedule, own)

    def schedules_of(self, world: str) -> tuple[str, ...]:
        """Return the schedules of a main world."""
        knows = world in WITH_POLICY and self.corridor is None
        return (*self.schedules, *((self.policy,) if knows else ()))

    def all_cells(self) -> Iterator[EstimatorCell]:
        """See `Design.all_cells`."""
        for world in self.main:
            for pair in itertools.product(self.quick_estimators, self.schedules_of(world)):
                yield self.cell(world, *pair)
            for estimator in self.slow_estimators:
                for schedule in dict.fromkeys((self.schedules[0], self.schedule)):
                    yield self.cell(world, estimator, schedule)
        for world in self.guarantees:
            for estimator in (*self.quick_estimators, *self.slow_estimators):
                yield self.cell(world, estimator)
        for world in (*self.main, *self.guarantees):
            for network in self.networks:
                yield self.cell(world, weights=network)
        if "capped" in self.run_worlds:
            for network in self.networks:
                yield self.cell("capped", schedule=OWN, weights=network)
        for world, estimator in itertools.product(self.elsewhere, self.moved_estimators):
            yield self.cell(world, estimator)

    @cached_property
    def configs(self) -> list[EnvConfig]:
        """See `Design.configs`."""
        self.check()
        self.saved_networks()
        with quietly():
            return [self.config(cell) for cell in self.cells()]

    def keywords(self, cell: EstimatorCell, fit: str = "") -> dict[str, Any]:
        """See `Design.keywords`; with a file of fitted stacks."""
        return cell.on(self.road, fit)

    def config(self, cell: EstimatorCell) -> EnvConfig:
        """Return the configuration of a cell.

        Raises:
            ValueError: A value is out of range.
        """
        seeds = {"traffic_seeds": list(self.seeds_of(cell))}
        return make_config(cell.place.env, {**self.keywords(cell), **seeds})

    @property
    def all_networks(self) -> Sequence[str]:
        """The base network, and those of other training seeds."""
        return (self.weights, *self.networks)

    def saved_networks(self) -> dict[str, SavedNetwork]:
        """Return the networks by name or file, both members of a pair.

        Raises:
            ValueError: There is no such network.
        """
        members = (member_for(each, flows) for each in self.all_networks for flows in (True, False))
        return {name: read_network(name) for name in members}

    @property
    def fitted_worlds(self) -> list[str]:
        """Worlds with a linear stack."""
        return [
            world for world in WORLDS
            if any((each.world, each.estimator) == (world, LINEAR) for each in self.cells())
        ]  # fmt: skip
