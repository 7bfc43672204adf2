"""Tuning tasks: the configuration that estimator settings are tuned for, and their score.

The score is the mean reward of a second after the warm-up, as the environment gives it.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from agents.environments import make_config, quietly
from agents.play import Cell, play
from agents.policies import find_policy
from agents.search.space import Knob, search_space
from agents.seeds import TUNING
from dptse_env.config import TRAINING_SEEDS, EnvConfig, parse_seeds
from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.settings import settings_name
from dptse_env.evaluation import WARM_UP, Row
from dptse_env.model import ARZParameters
from dptse_env.traffic import Records
from dptse_env.utils.fields import integer, require


@dataclass(frozen=True)
class TuningTask:
    """The configuration that one set of settings is tuned for.

    Attributes:
        env: Environment id.
        estimator: Name of the estimator.
        parameters: ARZ parameters of its model, or the name of a set.
        privacy: Privacy preset.
        seeds: Traffic seeds, ``"first:stop"``, within `TRAINING_SEEDS`.
        keywords: Other keywords of the environment; a mapping ``privacy`` goes with the preset.
        schedule: Query schedule, or a saved policy: its ``.safetensors`` file or shipped name.
        noise_seed: Noise and estimators are seeded with this plus the traffic seed.
        records: Library of records, or its folder; None for the user's cache.
        with_noise_scale: Whether to search the scale of the noise of flows or speeds, too.
        with_demand: Whether to search demand states and the noise that goes with them, too.
        with_speed_cap: Whether to search the cap of reported speeds, too.
        variant: Ending of the set's name; empty for the set that is the default of its privacy
            preset.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: The estimator has nothing to tune, seeds are not for training, keywords hold
            another field, or the file is no saved policy.
    """

    env: str
    estimator: str
    parameters: str | ARZParameters
    privacy: str
    seeds: str
    keywords: Mapping[str, Any] = field(default_factory=dict)
    schedule: str = "paper"
    noise_seed: int = TUNING.start
    records: Records = None
    with_noise_scale: bool = False
    with_demand: bool = False
    with_speed_cap: bool = False
    variant: str = ""

    def __post_init__(self) -> None:
        """Check what needs no environment."""
        _ = self.space, find_policy(self.schedule)
        for name in ("estimator", "parameters", "traffic_seeds", "records", "action"):
            require(name not in self.keywords, f"keywords.{name}", "left out", name)
        privacy = self.keywords.get("privacy", {})
        require(isinstance(privacy, Mapping), "keywords.privacy", "a JSON object", privacy)
        if not set(self.traffic_seeds) <= set(TRAINING_SEEDS):
            raise ValueError(
                f"seeds must be training seeds, in {TRAINING_SEEDS.start}:{TRAINING_SEEDS.stop}, "
                f"got {self.seeds!r}"
            )
        first, last = TUNING.start, TUNING.stop - TRAINING_SEEDS.stop
        integer("noise_seed", self.noise_seed, first, last)
        if Path(self.name).name != self.name:
            raise ValueError(f"the ARZ parameters' name must be part of a file name: {self.name!r}")

    @property
    def space(self) -> dict[str, Knob]:
        """The search space, by path into the settings."""
        return search_space(
            self.estimator,
            self.with_noise_scale,
            self.with_demand,
            self.with_speed_cap,
        )

    @property
    def traffic_seeds(self) -> tuple[int, ...]:
        """The traffic seeds one by one."""
        return parse_seeds(self.seeds)

    @property
    def parameters_name(self) -> str:
        """Name of the ARZ parameters."""
        return self.parameters if isinstance(self.parameters, str) else self.parameters.name

    @property
    def name(self) -> str:
        """Name of the set."""
        return settings_name(self.estimator, self.parameters_name, self.privacy, self.variant)

    def cell(self, settings: EstimatorSettings | None = None) -> Cell:
        """Return what a trial plays; the environment's default settings if None."""
        keywords: dict[str, Any] = {
            **self.keywords,
            "estimator": self.estimator,
            "parameters": self.parameters,
            "privacy": {**self.keywords.get("privacy", {}), "preset": self.privacy},
        }
        if isinstance(self.parameters, ARZParameters):
            keywords["parameters"] = dataclasses.asdict(self.parameters)
        if settings is not None:
            keywords["estimator_settings"] = dataclasses.asdict(settings)
        return Cell(self.env, self.schedule, keywords, noise_seed=self.noise_seed)

    def config(self) -> EnvConfig:
        """Return the configuration of the environment, with its default settings.

        Raises:
            ValueError: A value is out of range.
        """
        with quietly():
            return make_config(self.env, self.cell().all_keywords)

    def identity(self) -> dict[str, Any]:
        """Return everything that two searches must share for their scores to be comparable."""
        config = self.config()
        cell: dict[str, Any] = json.loads(self.cell().id)
        return {
            **cell,
            "corridor": config.corridor.digest,
            "parameters": dataclasses.asdict(config.arz_parameters),
            "privacy": dataclasses.asdict(config.privacy),
            "bandwidth": config.bandwidth,
            "seeds": self.seeds,
            "warm_up": WARM_UP,
            "dptse-env": version("dptse-env"),
            "space": {path: repr(knob) for path, knob in self.space.items()},
        }


def score_episodes(
    task: TuningTask, settings: EstimatorSettings, traffic_seeds: Sequence[int]
) -> list[Row]:
    """Play an episode of a task on each traffic seed with given settings, as one batch."""
    return play(task.cell(settings), traffic_seeds, task.records)
