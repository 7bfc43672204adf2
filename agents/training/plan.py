"""`TrainingPlan`: everything that a training depends on."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from agents.environments import make_config, parse_env
from agents.play import Cell
from agents.seeds import TRAININGS, require_seeds
from agents.training.recipes import Recipe
from agents.training.worlds import World
from dptse_env.config import TRAINING_SEEDS, VALIDATION_SEEDS, EnvConfig
from dptse_env.parts import make_interface
from dptse_env.utils.fields import integer


@dataclass(frozen=True)
class TrainingPlan:
    """A recipe on an environment with a training seed.

    Attributes:
        env: Environment id.
        recipe: How it is trained.
        seed: Seeds the initial weights, draws of actions, noise and the choice of traffic.
        steps: Seconds of traffic to train for by PPO, all episodes together, each with one
            decision; rounded up to complete updates. 0 for a recipe that is trained in rounds.
        traffic_seeds: Traffic to train on.
        validation_seeds: Traffic to validate on.
        keywords: Of the environment, plain JSON; the recipe chooses the action encoding.
        also: Further environments to train and validate in, on the same traffic seeds, each an id
            or an id, a space and keywords as JSON. One network learns from all of them.
        validate_every: Updates of PPO between two validations; all rounds of swaps are validated.
        checkpoint_every: Updates of PPO between two checkpoints; every round leaves one.

    Raises:
        ValueError: A value is out of range, or a seed is not of its kind.
    """

    env: str
    recipe: Recipe
    seed: int
    steps: int
    traffic_seeds: tuple[int, ...]
    validation_seeds: tuple[int, ...]
    keywords: Mapping[str, Any] = field(default_factory=dict)
    also: tuple[str, ...] = ()
    validate_every: int = 25
    checkpoint_every: int = 10

    def __post_init__(self) -> None:
        """Check values that need no environment."""
        integer("seed", self.seed, 0, TRAININGS - 1)
        integer("steps", self.steps, 0)
        self.recipe.check_steps(self.steps)
        for name in ("validate_every", "checkpoint_every"):
            integer(name, getattr(self, name), 1)
        for path, seeds, allowed in (
            ("traffic", self.traffic_seeds, TRAINING_SEEDS),
            ("validation", self.validation_seeds, VALIDATION_SEEDS),
        ):
            require_seeds(path, seeds, allowed)
        for _, keywords in self._environments:
            for key in ("action", "traffic_seeds", "autoreset_mode"):
                if key in keywords:
                    raise ValueError(f"keywords.{key} is chosen by the training, leave it out")
        if self.also and not self.recipe.takes_many:
            raise ValueError(
                f"also must be empty for {self.recipe.learner}, whose network is tied to one "
                f"environment, got {self.also[0]!r}"
            )

    @property
    def _environments(self) -> list[tuple[str, Mapping[str, Any]]]:
        return [(self.env, self.keywords), *map(parse_env, self.also)]

    @property
    def n_updates(self) -> int:
        """Updates of PPO, or rounds of swaps."""
        return self.recipe.n_updates(self.steps, self.actions_per_step)

    def steps_at(self, update: int) -> int:
        """Return the seconds of traffic simulated by the end of an update, all of them counted."""
        per_step = self.actions_per_step
        return sum(self.recipe.steps_at(update, world, per_step) for world in self.worlds)

    def is_due(self, update: int, every: int) -> bool:
        """Return whether a task that is due ``every`` so many updates is due after this one."""
        is_last = update == self.n_updates
        return self.recipe.has_long_updates or update % every == 0 or is_last

    @cached_property
    def actions_per_step(self) -> int:
        """Actions that make one decision."""
        return make_interface(self.config).actions.actions_per_step

    @cached_property
    def config(self) -> EnvConfig:
        """The configuration of the first environment, which the policy is saved for.

        Raises:
            ValueError: As `worlds`.
        """
        return self.worlds[0].config

    @cached_property
    def worlds(self) -> tuple[World, ...]:
        """The environments to train in, that of the plan first.

        Raises:
            ValueError: A keyword is unknown or out of range, or the recipe cannot train there.
        """
        chosen = {"action": self.recipe.action, "traffic_seeds": list(self.traffic_seeds)}
        worlds: list[World] = []
        for env, keywords in self._environments:
            config = make_config(env, {**chosen, **keywords})
            self.recipe.check_environment(config)
            first = worlds[0].config if worlds else config
            share = first.corridor.n_mainline / config.corridor.n_mainline
            worlds.append(World(env, keywords, config, share))
        return tuple(worlds)

    def check(self) -> None:
        """Check the environments without playing, recording or compiling.

        Raises:
            ValueError: As `worlds`, or an estimator does not suit its road.
        """
        for world in self.worlds:
            Cell(world.env, "none", {**world.keywords, "action": self.recipe.action}).check()

    def content(self) -> dict[str, Any]:
        """Return what the numbers of the training depend on, as plain JSON."""
        content = dataclasses.asdict(self)
        del content["checkpoint_every"]
        content["learner"] = self.recipe.learner
        content["corridors"] = [world.config.corridor.digest for world in self.worlds]
        content["settings"] = [dataclasses.asdict(world.config.settings()) for world in self.worlds]
        plain: dict[str, Any] = json.loads(json.dumps(content))
        return plain
