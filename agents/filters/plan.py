"""Plan of the training of a recurrent network: rounds of scenarios, and passes over them.

The plan decides all numbers of a training, and stands on the card of the weights.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np

from agents.environments import PRIVATE, make_config, parse_env, quietly
from agents.filters.highways import (
    CONVOYS,
    HEADWAYS,
    KINDS,
    LANES,
    LENGTHS,
    LIMITS,
    LORRIES,
    LORRY_SPEEDS,
    QUEUE_LORRIES,
    draw_highway,
)
from agents.filters.highways import Kind as HighwayKind
from agents.filters.scenarios import (
    CONNECTED,
    EPSILONS,
    MECHANISMS,
    NONE,
    Kind,
    Scenario,
    ScenarioRanges,
)
from agents.filters.sections import SEGMENTS, Section
from agents.play import Cell
from agents.seeds import TUNING, require_seeds
from dptse_env.config import TRAINING_SEEDS, VALIDATION_SEEDS
from dptse_env.estimators.recurrent import FORMAT, read_weights
from dptse_env.estimators.recurrent_kernels import FEATURES
from dptse_env.utils.validation import Interval, checked_fields, integer, require
from dptse_env.versions import versions_with


@dataclass(frozen=True)
class Round:
    """Scenarios that are collected with one estimator, and passes over them.

    Attributes:
        estimator: The estimator that is played: a name, or `OWN` for the network with its weights
            at the beginning of the round. Centres and prices of ``paced`` and the schedules on
            deviations follow it.
        scenarios: Number of scenarios; those of earlier rounds are dropped.
        passes: Number of passes, each over a batch of episodes drawn at random.
    """

    estimator: str
    scenarios: Annotated[int, Interval(1, 10_000)]
    passes: Annotated[int, Interval(1, 1_000_000)]

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "rounds")


OWN = "own"
"""The network that is trained, as the estimator of a round."""


def played_by(weights: Path) -> dict[str, Any]:
    """Return the keywords of an environment whose estimator has the weights of a file."""
    settings = {"recurrent": {"weights": str(weights.resolve())}}
    return {"estimator": "recurrent", "estimator_settings": settings}


VALIDATION: dict[Kind, tuple[str, ...]] = {
    "flows": (
        f'{PRIVATE} {{"bandwidth": 5}}',
        f'{PRIVATE} {{"bandwidth": 5, "privacy": "capped"}}',
        'dptse_env:dptse/LongHighway-v0 {"bandwidth": 8, "horizon": 600}',
    ),
    "speeds": (
        "dptse_env:dptse/PaperHighway-v0",
        'dptse_env:dptse/PaperHighway-v0 {"privacy": "corrected"}',
    ),
}
"""Environments to validate in."""
ON_SECTIONS: dict[Kind, dict[str, Any]] = {
    "flows": {"preset": "paced", "boundary_inputs": "nominal"},
    "speeds": {"preset": "corrected", "epsilon": 1.0},
}
"""Release models on the sections to validate on."""


@dataclass(frozen=True)
class FilterPlan:
    """Everything that decides the numbers of a training.

    Attributes:
        kind: What is released beside densities, flows or speeds.
        seed: Training seed: scenarios, first weights, order.
        traffic_seeds: Traffic seeds to train on.
        validation_seeds: Traffic seeds to validate on.
        rounds: Rounds, one after the other.
        validation_envs: Environments to validate in, as ``ID`` or ``ID {JSON}``.
        validation_highways: Numbers (first, stop) of the highways to validate on, of every kind,
            with a section of each.
        ranges: Ranges that scenarios are drawn from.
        width: Width of the hidden state.
        windows: Windows of a section, or traffic seeds of another scenario.
        episodes: Episodes of a batch, which mixes scenarios on any roads.
        seconds: Length of an episode [s].
        learning_rate: First learning rate of Adam; it falls along a cosine.
        checkpoint_every: Passes between checkpoints.
        initial: Weights that the training begins with, a name or a file; None to draw them at
            random.
        teacher: Share of the loss on ordinary roads that is the distance from the estimates of a
            teacher, where its card has such roads.
        teacher_weights: Weights of the teacher, a name or a file; the initial ones if None.

    Raises:
        ValueError: A value is out of range.
    """

    kind: Kind
    seed: Annotated[int, Interval(0, 2**31)]
    traffic_seeds: tuple[int, ...]
    validation_seeds: tuple[int, ...]
    rounds: tuple[Round, ...]
    validation_envs: tuple[str, ...] = ()
    validation_highways: tuple[int, int] = (1000, 1006)
    ranges: ScenarioRanges = field(default_factory=ScenarioRanges)
    width: Annotated[int, Interval(1, 512)] = 64
    windows: Annotated[int, Interval(1, 24)] = 16
    episodes: Annotated[int, Interval(1, 10_000)] = 32
    seconds: Annotated[int, Interval(1, 600)] = 400
    learning_rate: Annotated[float, Interval(0, 1, open_low=True)] = 4e-3
    checkpoint_every: Annotated[int, Interval(1, 1_000_000)] = 64
    initial: str | None = None
    teacher: Annotated[float, Interval(0, 1)] = 0.0
    teacher_weights: str | None = None

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "")
        if not self.validation_envs:
            object.__setattr__(self, "validation_envs", VALIDATION[self.kind])
        require_seeds("train_seeds", self.traffic_seeds, TRAINING_SEEDS)
        require_seeds("validation_seeds", self.validation_seeds, VALIDATION_SEEDS)
        integer("windows", self.windows, 1, len(self.traffic_seeds))
        first, stop = self.validation_highways
        apart = (
            0 <= first <= stop and not self.ranges.highways[0] <= first < self.ranges.highways[1]
        )
        allowed = f"first and last number outside of {self.ranges.highways}"
        require(apart, "validation_highways", allowed, self.validation_highways)
        if not self.rounds or (self.initial is None and self.rounds[0].estimator == OWN):
            raise ValueError(
                "rounds must begin with one of another estimator where no initial weights are "
                "given, since the network knows nothing yet"
            )
        if self.teacher_weights is None:
            object.__setattr__(self, "teacher_weights", self.initial)
        taught = self.teacher_weights is not None or self.teacher == 0.0
        require(taught, "teacher", "0 without weights that teach", self.teacher)
        if self.initial is not None:
            width = read_weights(self.initial).weights.width
            allowed = f"that of the initial weights, {width}"
            require(self.width == width, "width", allowed, self.width)

    @property
    def n_passes(self) -> int:
        """Number of passes of all rounds."""
        return sum(each.passes for each in self.rounds)

    def scenarios(self, index: int) -> list[Scenario]:
        """Return the scenarios of a round, always the same ones, those on sections first."""
        rng = np.random.default_rng([self.seed, index])
        n = self.rounds[index].scenarios
        on_sections, first = round(self.ranges.sections * n), TUNING.start
        return [
            dataclasses.replace(
                self.ranges.draw(
                    rng, self.kind, self.traffic_seeds, self.windows, self.seconds, k < on_sections
                ),
                noise_seed=first + 10_000 * (index * n + k),
            )
            for k in range(n)
        ]

    def rate(self, done: int) -> float:
        """Return the learning rate after `done` passes."""
        return self.learning_rate * 0.5 * (1.0 + math.cos(math.pi * done / self.n_passes))

    def settings(self) -> dict[str, Any]:
        """Return the plan as plain JSON."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        if self.initial is not None:
            plain["initial_sha256"] = read_weights(self.initial).card["sha256"]
        return plain

    def validation_sections(self) -> list[Section]:
        """Return the sections to validate on."""
        found = []
        for kind in KINDS if self.ranges.free > 0.0 else KINDS[:1]:
            for k, number in enumerate(range(*self.validation_highways)):
                most = draw_highway(number, kind).corridor.geometry.n_mainline - 2
                segments = min(8 + 2 * (k % 6), most)
                calibrated = k % 2 == 1
                found.append(
                    Section(number, segments, 4, self.seconds, kind=kind, calibrated=calibrated)
                )
        return found

    def highways(self) -> list[tuple[HighwayKind, int]]:
        """Return the highways to train and to validate on, by kind and number."""
        kinds = KINDS if self.ranges.free > 0.0 else KINDS[:1]
        ranges = (self.ranges.highways, self.validation_highways)
        return [(k, number) for k in kinds for each in ranges for number in range(*each)]

    def validation_cells(
        self, roads: Sequence[Path] = (), estimator: Mapping[str, Any] = MappingProxyType({})
    ) -> list[Cell]:
        """Return the cells of a validation.

        Args:
            roads: Road files of `validation_sections`.
            estimator: Keywords of an estimator in place of the environments'.
        """
        options: dict[str, Any] = {"noise_seed": TUNING.start, "watchers": ("honesty",)}
        cells = [
            Cell(env, "round-robin", {**keywords, **estimator}, **options)
            for env, keywords in map(parse_env, self.validation_envs)
        ]
        for road in roads:
            keywords = {"corridor": str(road), "bandwidth": 2, "privacy": ON_SECTIONS[self.kind]}
            seeds = tuple(range(4))
            cell = Cell(PRIVATE, "round-robin", {**keywords, **estimator}, seeds=seeds, **options)
            cells.append(cell)
        return cells

    def card(self, done: int, name: str) -> dict[str, Any]:
        """Return the card of the weights after `done` passes, with the ranges of their training."""
        ranges = self.ranges
        roads = [make_config(*parse_env(each)).corridor for each in ranges.envs]
        found: dict[str, list[float]] = {
            "n_mainline": [float(road.geometry.n_mainline) for road in roads],
            "segment_length": [
                length for road in roads for length in road.geometry.segment_lengths
            ],
            "speed_limit": [limit for road in roads for limit in road.geometry.speed_limits],
            "lanes": [float(count) for road in roads for count in road.geometry.segment_lanes],
            "span": [1.0, *(float(span) for spans in ranges.spans for span in spans)],
            "flows": [float(self.kind == "flows")],
            "own_parameters": [0.0, float(ranges.sections > 0.0)],
            "epsilon": [EPSILONS[0], NONE],
            "connected": [CONNECTED[0], 1.0] if ranges.connected > 0.0 else [1.0],
            "slow_share": [0.0],
            "headway": [
                each.conditions.drivers.headway
                for each in roads
                if each.conditions.drivers.headway is not None
            ],
        }
        if ranges.sections > 0.0:
            found["n_mainline"] += SEGMENTS
            found["segment_length"] += LENGTHS
            found["speed_limit"] += LIMITS
            found["lanes"] += LANES
            found["slow_share"] += LORRIES if ranges.free > 0.0 else QUEUE_LORRIES
            found["slow_speed"] = [CONVOYS[0], LORRY_SPEEDS[1]] if ranges.free > 0.0 else [90.0]
            found["headway"] += [each for pair in HEADWAYS.values() for each in pair]
        return {
            "name": name,
            "format": FORMAT,
            "channels": list(FEATURES),
            "ranges": {key: [min(values), max(values)] for key, values in found.items() if values},
            "training": {
                "plan": self.settings(),
                "passes": done,
                "versions": versions_with("torch", "numpy"),
            },
        }

    def check(self) -> None:
        """Check environments, schedules and estimators without playing, recording or compiling.

        Raises:
            ValueError: One is unknown, or does not suit a road.
        """
        estimators = [each.estimator for each in self.rounds if each.estimator != OWN]
        cells = self.validation_cells()
        for env, keywords in map(parse_env, self.ranges.envs):
            cells += [Cell(env, schedule, keywords) for schedule in self.ranges.schedules]
            cells += [
                Cell(env, "none", {**keywords, "privacy": mechanism, "estimator": estimator})
                for mechanism, estimator in product(MECHANISMS[self.kind], estimators)
            ]
        with quietly():
            for cell in cells:
                cell.check()
            for env in self.ranges.envs:
                most = make_config(*parse_env(env)).corridor.conditions.duration
                allowed = f"at most {most} s, the length of a record of {env}"
                require(self.seconds <= most, "plan.seconds", allowed, self.seconds)
