"""Plan of the training of a recurrent network: rounds of scenarios, and passes over them.

The plan decides all numbers of a training, and says on the card of the network what it was.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np

from agents.environments import make_config, parse_env, quietly
from agents.filters.scenarios import Scenario, ScenarioRanges
from agents.play import Cell
from agents.seeds import TUNING, require_seeds
from dptse_env.config import TRAINING_SEEDS, VALIDATION_SEEDS
from dptse_env.estimators.recurrent import FORMAT, read_network
from dptse_env.estimators.recurrent_kernels import CHANNELS
from dptse_env.parts import make_task
from dptse_env.utils.fields import Interval, checked_fields, integer, require


@dataclass(frozen=True)
class Round:
    """Scenarios that are collected with one estimator, and passes over them.

    Attributes:
        estimator: The estimator that is played: a name, or `OWN` for the network itself, as it
            stands when the round begins. Centres and prices of ``paced`` and the schedules on
            deviations follow it.
        scenarios: Number of scenarios; those of earlier rounds are dropped.
        passes: Number of passes over a batch of episodes, each drawn at random.
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
    """Return the keywords of an environment whose estimator is a network, given as a file."""
    settings = {"weights": str(weights.resolve()), "outside": True}
    return {"estimator": "recurrent", "estimator_settings": {"recurrent": settings}}


@dataclass(frozen=True)
class FilterPlan:
    """Everything that decides the numbers of a training.

    Attributes:
        seed: Training seed: scenarios, first weights, order.
        traffic_seeds: Traffic seeds to train on.
        validation_seeds: Traffic seeds to validate on.
        validation_envs: Environments to validate in, as ``ID`` or ``ID {JSON}``.
        ranges: Ranges that scenarios are drawn from.
        rounds: Rounds, one after the other.
        width: Width of the hidden state.
        episodes: Episodes of a scenario, and of a batch, which mixes the scenarios of a road.
        window: Seconds over which gradients are propagated.
        learning_rate: Of Adam at the beginning; it falls along a cosine.
        likelihood: Weight of the likelihood in the loss.
        prediction: Weight of the loss of predictions.
        clip_norm: Largest norm of a gradient.
        checkpoint_every: Passes between checkpoints.
        initial: Network whose weights the training begins with, a name or a file; None for weights
            drawn at random.

    Raises:
        ValueError: A value is out of range.
    """

    seed: Annotated[int, Interval(0, 2**31)]
    traffic_seeds: tuple[int, ...]
    validation_seeds: tuple[int, ...]
    validation_envs: tuple[str, ...] = (
        'dptse_env:dptse/PrivateHighway-v1 {"privacy": "capped"}',
        "dptse_env:dptse/PrivateHighway-v1",
        "dptse_env:dptse/PaperHighway-v0",
    )
    ranges: ScenarioRanges = field(default_factory=ScenarioRanges)
    rounds: tuple[Round, ...] = (
        Round("ekf", 72, 200),
        Round(OWN, 72, 300),
        Round(OWN, 72, 400),
    )
    width: Annotated[int, Interval(1, 512)] = 64
    episodes: int = 32
    window: Annotated[int, Interval(1, 10_000)] = 50
    learning_rate: Annotated[float, Interval(0, 1, open_low=True)] = 4e-3
    likelihood: Annotated[float, Interval(0, 1)] = 0.03
    prediction: Annotated[float, Interval(0, 10)] = 0.3
    clip_norm: Annotated[float, Interval(0, 1e6, open_low=True)] = 1.0
    checkpoint_every: Annotated[int, Interval(1, 1_000_000)] = 20
    initial: str | None = None

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "")
        require_seeds("traffic", self.traffic_seeds, TRAINING_SEEDS)
        require_seeds("validation", self.validation_seeds, VALIDATION_SEEDS)
        integer("episodes", self.episodes, 1, len(self.traffic_seeds))
        if not self.rounds or (self.initial is None and self.rounds[0].estimator == OWN):
            raise ValueError(
                "rounds must begin with one of another estimator where no initial network is "
                "given, since the network knows nothing yet"
            )
        if self.initial is not None:
            width = read_network(self.initial).network.width
            allowed = f"that of the initial network, {width}"
            require(self.width == width, "width", allowed, self.width)

    @property
    def n_passes(self) -> int:
        """Number of passes of all rounds."""
        return sum(each.passes for each in self.rounds)

    def scenarios(self, index: int) -> list[Scenario]:
        """Return the scenarios of a round; the same ones whenever it is called."""
        rng = np.random.default_rng([self.seed, index])
        traffic, n = self.traffic_seeds, self.rounds[index].scenarios
        drawn = [self.ranges.draw(rng, traffic, self.episodes) for _ in range(n)]
        first = TUNING.start
        return [
            dataclasses.replace(scenario, noise_seed=first + 10_000 * (index * n + k))
            for k, scenario in enumerate(drawn)
        ]

    def rate(self, done: int) -> float:
        """Return the learning rate after `done` passes."""
        return self.learning_rate * 0.5 * (1.0 + math.cos(math.pi * done / self.n_passes))

    def settings(self) -> dict[str, Any]:
        """Return the plan as plain JSON."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        if self.initial is not None:
            plain["initial_sha256"] = read_network(self.initial).card["sha256"]
        return plain

    def validation_cells(self, estimator: Mapping[str, Any] = MappingProxyType({})) -> list[Cell]:
        """Return the cells of a validation, of the environments' estimators or of another one."""
        options: dict[str, Any] = {"noise_seed": TUNING.start, "watchers": ("honesty",)}
        return [
            Cell(env, "round-robin", {**keywords, **estimator}, **options)
            for env, keywords in map(parse_env, self.validation_envs)
        ]

    def card(self, done: int, name: str) -> dict[str, Any]:
        """Return the card of a network after `done` passes: what it was trained on."""
        ranges = self.ranges
        configs = [
            make_config(env, {**keywords, "privacy": mechanism})
            for env, keywords in map(parse_env, ranges.envs)
            for mechanism in ranges.mechanisms
        ]
        roads = [config.corridor for config in configs]
        found: dict[str, list[float]] = {
            "n_mainline": [road.n_mainline for road in roads],
            "segment_length": [length for road in roads for length in road.segment_lengths],
            "speed_limit": [limit for road in roads for limit in road.speed_limits],
            "lanes": [float(count) for road in roads for count in road.segment_lanes],
            "span": [1.0, *(float(span) for spans in ranges.spans for span in spans)],
            "flows": [float(make_task(config).releases_flow) for config in configs],
        }
        return {
            "name": name,
            "format": FORMAT,
            "channels": list(CHANNELS),
            "ranges": {key: [min(values), max(values)] for key, values in found.items()},
            "training": {
                "plan": self.settings(),
                "passes": done,
                "versions": {each: version(each) for each in ("dptse-env", "torch", "numpy")},
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
                for mechanism, estimator in product(self.ranges.mechanisms, estimators)
            ]
        with quietly():
            for cell in cells:
                cell.check()
