"""Plan of the study of choices."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from agents.environments import make_config, quietly
from agents.evaluation.episodes import check_test_seeds
from agents.experiments.cells import Design
from agents.policies import SavedPolicy, read_saved_policy
from agents.studies.choices.cell import (
    CAPPED,
    EKF,
    ESTIMATORS,
    HIGHWAY,
    LONG,
    OTHER_TRAFFIC,
    OWN_TRAFFIC,
    PACED,
    RECURRENT,
    ChoiceCell,
)
from dptse_env.config import EnvConfig, parse_seeds

ORACLE, GAIN = "oracle-error", "oracle-gain"
REFERENCE = "paper"
EPSILON = 5.0


class World(NamedTuple):
    """What a curve over bandwidths is about."""

    road: str
    release: str
    estimator: str
    traffic: str = OWN_TRAFFIC
    epsilon: float = EPSILON
    span: int = 1

    @property
    def label(self) -> str:
        """Its name in tables."""
        return f"`{self.release}`, {'EKF' if self.estimator == EKF else 'recurrent'}"


@dataclass(frozen=True)
class ChoiceDesign(Design[ChoiceCell]):
    """The cells of the study.

    Attributes:
        seeds: Test traffic seeds of the short road, first:stop.
        long_seeds: Those of the long road.
        schedule: The schedule that all gains are measured against.
        rule_ekf: The rule for the EKF, chosen on other traffic.
        rule_recurrent: The rule for the recurrent network, chosen on other traffic.
        capped: Learned policies for ``capped``, saved ones, one for each training seed.
        paced: Those for ``paced``.
        bandwidths: Of the short road.
        long_bandwidths: Of the long road; none to leave it out.
        base_bandwidth: Bandwidth of the short road at which epsilon and traffic are varied.
        epsilons: Values of epsilon on the short road, the base value among them.
        joint_bandwidth: Bandwidth of the cells of everything taken together.
        joint_epsilons: Values of epsilon there, with sums over two neighbours.
    """

    seeds: str = "2600:2632"
    long_seeds: str = "2600:2608"
    schedule: str = "round-robin"
    rule_ekf: str = "speed-front"
    rule_recurrent: str = "expected-reduction"
    capped: tuple[str, ...] = ()
    paced: tuple[str, ...] = ()
    bandwidths: tuple[int, ...] = (1, 2, 3, 5, 8, 12)
    long_bandwidths: tuple[int, ...] = (2, 4, 8, 24)
    base_bandwidth: int = 2
    epsilons: tuple[float, ...] = (0.5, 1.0, EPSILON, 20.0)
    joint_bandwidth: int = 5
    joint_epsilons: tuple[float, ...] = (EPSILON, 1.0, 0.25)

    def check(self) -> None:
        """See `Design.check`."""
        super().check()
        check_test_seeds(parse_seeds(self.long_seeds), "long_seeds")
        if self.corridor is not None:
            raise ValueError(f"corridor is part of this study, leave it out; got {self.corridor!r}")
        if self.base_bandwidth not in self.bandwidths or EPSILON not in self.epsilons:
            raise ValueError(
                f"bandwidths must hold {self.base_bandwidth} and epsilons {EPSILON:g}, got "
                f"{self.bandwidths} and {self.epsilons}"
            )

    def quick(self) -> ChoiceDesign:
        """Return a design of few cells on few seeds."""
        return dataclasses.replace(
            self,
            seeds=self.first_seeds(3),
            long_seeds=self.first_seeds(2),
            bandwidths=(2, 5),
            long_bandwidths=(2,),
            epsilons=(1.0, EPSILON),
            capped=self.capped[:1],
            paced=self.paced[:1],
        )

    @property
    def worlds(self) -> list[World]:
        """The worlds of the map, the short road first; roads without bandwidths are left out."""
        worlds = [
            *(World(HIGHWAY, release, each) for release in (PACED, CAPPED) for each in ESTIMATORS),
            *(World(LONG, PACED, each) for each in ESTIMATORS),
            World(LONG, CAPPED, RECURRENT),  # the EKF has no settings for it
        ]
        return [world for world in worlds if self.bandwidths_of(world)]

    def bandwidths_of(self, world: World) -> tuple[int, ...]:
        """Return the bandwidths of a world's curve."""
        return self.bandwidths if world.road == HIGHWAY else self.long_bandwidths

    def varied(self, world: World) -> list[World]:
        """Return a world of the short road at every epsilon, then under other traffic."""
        return [
            *(world._replace(epsilon=each) for each in self.epsilons),
            world._replace(traffic=OTHER_TRAFFIC),
        ]

    @property
    def together(self) -> list[World]:
        """Worlds in which release, estimator and queries are taken together, on the short road."""
        base = World(HIGHWAY, PACED, RECURRENT)
        sums = [base._replace(epsilon=each, span=2) for each in self.joint_epsilons]
        return [World(HIGHWAY, CAPPED, EKF), base, *sums]

    def learned(self, world: World) -> tuple[str, ...]:
        """Return the learned policies of a world."""
        return self.capped if world.release == CAPPED else self.paced

    def rule(self, world: World) -> str:
        """Return the rule of a world."""
        return self.rule_ekf if world.estimator == EKF else self.rule_recurrent

    def bounds(self, world: World) -> tuple[str, ...]:
        """Return the oracles of a world; trying every segment takes too long on the long road."""
        return (ORACLE, GAIN) if world.road == HIGHWAY else (ORACLE,)

    def policies(self, world: World) -> list[str]:
        """Return all policies of a world."""
        rules = [self.schedule, REFERENCE, self.rule(world), *self.bounds(world)]
        return list(dict.fromkeys([*rules, *self.learned(world)]))

    def cell(self, world: World, bandwidth: int, policy: str) -> ChoiceCell:
        """Return a cell."""
        road, release, estimator, traffic, epsilon, span = world
        return ChoiceCell(road, traffic, release, estimator, epsilon, span, bandwidth, policy)

    def all_cells(self) -> Iterator[ChoiceCell]:
        """See `Design.all_cells`."""
        for world in self.worlds:
            places = [(world, bandwidth) for bandwidth in self.bandwidths_of(world)]
            if world.road == HIGHWAY:
                places += [(each, self.base_bandwidth) for each in self.varied(world)]
            for place, bandwidth in places:
                for policy in self.policies(world):
                    yield self.cell(place, bandwidth, policy)
        for world in self.together:
            for policy in (REFERENCE, self.schedule, self.rule(world)):
                yield self.cell(world, self.joint_bandwidth, policy)

    def seeds_of(self, cell: ChoiceCell) -> tuple[int, ...]:
        """See `Design.seeds_of`."""
        return parse_seeds(self.long_seeds) if cell.road == LONG else self.traffic_seeds

    def config(self, cell: ChoiceCell) -> EnvConfig:
        """Return the configuration of a cell.

        Raises:
            ValueError: A value is out of range.
        """
        return make_config(cell.env, {**cell.keywords, "traffic_seeds": list(self.seeds_of(cell))})

    @cached_property
    def configs(self) -> list[EnvConfig]:
        """See `Design.configs`."""
        self.check()
        with quietly():
            return [self.config(cell) for cell in self.cells()]

    def saved_policies(self) -> Sequence[SavedPolicy]:
        """Return all learned policies.

        Raises:
            FileNotFoundError: A file is missing.
            ValueError: A file is not a saved policy.
        """
        return [read_saved_policy(each) for each in (*self.capped, *self.paced)]
