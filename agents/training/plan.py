"""`TrainingPlan`: everything that one training depends on."""

from __future__ import annotations

import dataclasses
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import version
from typing import Any

import gymnasium as gym

from agents.evaluation.episodes import WARM_UP
from agents.experiments.provenance import source_digest
from agents.experiments.seeds import TRAINING_VALIDATION, TRAININGS
from agents.training.recipes import Recipe
from dptse_env.config import TRAINING_SEEDS, VALIDATION_SEEDS, EnvConfig
from dptse_env.interface import QueryInterface
from dptse_env.validation import integer


@dataclass(frozen=True)
class TrainingPlan:
    """One learner on one environment with one training seed.

    Attributes:
        env: Environment id.
        recipe: How it is trained.
        seed: Seeds first weights, draws of actions, noise and the choice of traffic.
        steps: Seconds of traffic to train for by PPO, all episodes together, each with one
            decision; rounded up to whole updates. What else the recipe holds comes ahead of them.
        traffic_seeds: Traffic to train on.
        validation_seeds: Traffic to validate on.
        keywords: Of the environment, plain JSON; the recipe chooses the action encoding.
        validate_every: Updates of PPO between two validations; rounds of swaps are all validated.
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
    validate_every: int = 25
    checkpoint_every: int = 10

    def __post_init__(self) -> None:
        """Check values that need no environment."""
        integer("seed", self.seed, 0, TRAININGS - 1)
        integer("steps", self.steps, 0)
        for name in ("validate_every", "checkpoint_every"):
            integer(name, getattr(self, name), 1)
        recipe = self.recipe
        if not (self.steps or recipe.rounds.rounds or recipe.pretraining_steps):
            raise ValueError("steps must be an integer >= 1 where a recipe holds nothing but PPO")
        for path, seeds, allowed in (
            ("traffic", self.traffic_seeds, TRAINING_SEEDS),
            ("validation", self.validation_seeds, VALIDATION_SEEDS),
        ):
            strangers = [seed for seed in seeds if seed not in allowed]
            if strangers:
                raise ValueError(
                    f"{path} must hold seeds in {allowed[0]}..{allowed[-1]}, got {strangers[0]}"
                )
        for key in ("action", "traffic_seeds", "autoreset_mode"):
            if key in self.keywords:
                raise ValueError(f"keywords.{key} is chosen by the training, leave it out")

    @property
    def n_updates(self) -> int:
        """Updates in all: rounds of swaps, then those of PPO."""
        by_ppo = -(-self.steps * self.actions_per_step // self.recipe.steps_per_update)
        return self.recipe.rounds.rounds + by_ppo

    def steps_at(self, update: int) -> int:
        """Seconds of traffic simulated by the end of an update, what came ahead of it included."""
        recipe, rounds = self.recipe, self.recipe.rounds
        by_swaps = min(update, rounds.rounds) * rounds.steps(self.config.horizon_steps)
        by_ppo = max(update - rounds.rounds, 0) * recipe.steps_per_update // self.actions_per_step
        return recipe.pretraining_steps + by_swaps + by_ppo

    @cached_property
    def actions_per_step(self) -> int:
        """Actions that make one decision."""
        return QueryInterface.of(self.config).actions.actions_per_step

    @cached_property
    def config(self) -> EnvConfig:
        """The configuration of the environment.

        Raises:
            ValueError: A keyword is unknown or out of range.
        """
        made = gym.make(
            self.env,
            disable_env_checker=True,
            action=self.recipe.action,
            traffic_seeds=list(self.traffic_seeds),
            **self.keywords,
        )
        config: EnvConfig = made.unwrapped.config  # type: ignore[attr-defined]
        return config

    def provenance(self, commit: str | None) -> dict[str, Any]:
        """Return what `take_folder` compares and keeps, as plain JSON."""
        config = self.config
        libraries = ("gymnasium", "numba", "numpy", "stable-baselines3", "torch")
        whole = {
            "made_with": {
                "versions": {name: version(name) for name in ("dptse-env", "libsumo")},
                "env": self.env,
                "keywords": dict(self.keywords),
                "corridor": config.corridor.digest,
                "learner": self.recipe.learner,
                "recipe": dataclasses.asdict(self.recipe),
                "seed": self.seed,
                "steps": self.steps,
                "traffic_seeds": self.traffic_seeds,
                "validation_seeds": self.validation_seeds,
                "validation_noise": TRAINING_VALIDATION.start,
                "validate_every": self.validate_every,
                "warm_up": WARM_UP,
                "settings": {config.estimator: dataclasses.asdict(config.settings())},
            },
            "tuned": [],
            "sources": [source_digest()],
            "commit": commit,
            "machine": {
                "python": platform.python_version(),
                "platform": platform.platform(),
                **{name: version(name) for name in libraries},
            },
        }
        plain: dict[str, Any] = json.loads(json.dumps(whole))
        return plain
