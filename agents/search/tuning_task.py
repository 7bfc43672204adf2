"""What a set of estimator settings is tuned for, and how settings are scored.

Settings are paid what a user of the environment is paid: the mean reward of a second, after the
warm-up.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym

from agents.evaluation.episodes import WARM_UP, EpisodeScore, Policy, run_episode
from agents.evaluation.policies import Saved
from agents.experiments.seeds import TUNING
from agents.search.space import Knob, search_space
from dptse_env.config import TRAINING_SEEDS, EnvConfig, parse_seeds
from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.tuning import settings_name
from dptse_env.model import ARZParameters
from dptse_env.schedules import make_schedule
from dptse_env.validation import integer


@dataclass(frozen=True)
class TuningTask:
    """What one set is tuned for.

    Attributes:
        env: Environment id.
        estimator: Name of the estimator.
        parameters: ARZ parameters of its model, or the name of a set.
        privacy: Privacy preset.
        epsilon: Privacy parameter epsilon.
        delta: Privacy parameter delta.
        bandwidth: Most segments to query a second; the environment's own if None.
        seeds: Traffic seeds, ``"first:stop"``, within `TRAINING_SEEDS`.
        schedule: Query schedule, or the ``.zip`` file of a saved policy.
        noise_seed: Noise and estimators are seeded with this plus the traffic seed.
        records: Folder of the record cache; the user's cache if None.
        with_noise_scale: Whether to search the scale of the measurements' noise, too.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: The estimator has nothing to tune, seeds are not for training, or the file is no
            saved policy.
    """

    env: str
    estimator: str
    parameters: str | ARZParameters
    privacy: str
    epsilon: float
    delta: float
    bandwidth: int | None
    seeds: str
    schedule: str = "paper"
    noise_seed: int = TUNING.start
    records: str | None = None
    with_noise_scale: bool = False

    def __post_init__(self) -> None:
        """Check what needs no environment."""
        _ = self.space, self.saved
        if not set(self.traffic_seeds) <= set(TRAINING_SEEDS):
            raise ValueError(
                f"seeds must be training seeds, in {TRAINING_SEEDS.start}:{TRAINING_SEEDS.stop}, "
                f"got {self.seeds!r}"
            )
        first, last = TUNING.start, TUNING.stop - TRAINING_SEEDS.stop
        integer("noise_seed", self.noise_seed, first, last)
        if Path(self.name).name != self.name:
            raise ValueError(f"the ARZ parameters' name must be part of a file name: {self.name!r}")

    @cached_property
    def saved(self) -> Saved | None:
        """The saved policy that queries; None for a schedule."""
        return Saved.of(self.schedule) if self.schedule.endswith(".zip") else None

    @property
    def space(self) -> dict[str, Knob]:
        """What is searched, by path into the settings."""
        return search_space(self.estimator, self.with_noise_scale)

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
        return settings_name(self.estimator, self.parameters_name, self.privacy)

    def make(self, settings: EstimatorSettings | None = None) -> gym.Env[Any, Any]:
        """Make the environment; with the settings that it would choose itself if None."""
        parameters = self.parameters
        if isinstance(parameters, ARZParameters):
            parameters = dataclasses.asdict(parameters)  # type: ignore[assignment]
        keywords: dict[str, Any] = {
            "estimator": self.estimator,
            "parameters": parameters,
            "privacy": self.privacy,
            "epsilon": self.epsilon,
            "delta": self.delta,
            "traffic_seeds": self.seeds,
            "records": self.records,
        }
        if self.bandwidth is not None:
            keywords["bandwidth"] = self.bandwidth
        if self.saved is not None:
            keywords["action"] = self.saved.action
        if settings is not None:
            keywords["estimator_settings"] = dataclasses.asdict(settings)
        return gym.make(self.env, **keywords)

    def policy(self, env: gym.Env[Any, Any]) -> Policy:
        """Bind the schedule or the saved policy to an environment.

        Raises:
            ValueError: There is no such schedule, or it does not suit the environment.
        """
        if self.saved is None:
            return make_schedule(self.schedule, env)
        return self.saved.load(env)

    def config(self) -> EnvConfig:
        """Return the configuration of the environment, with its present settings.

        Raises:
            ValueError: A value is out of range.
        """
        env = self.make()
        self.policy(env)
        config: EnvConfig = env.unwrapped.config  # type: ignore[attr-defined]
        return config

    def identity(self) -> dict[str, Any]:
        """Return everything that scores of two studies must share to be compared."""
        config = self.config()
        return {
            "env": self.env,
            "corridor": config.corridor.digest,
            "estimator": self.estimator,
            "parameters": dataclasses.asdict(config.model().parameters),
            "privacy": dataclasses.asdict(config.privacy),
            "bandwidth": config.bandwidth,
            "schedule": self.schedule if self.saved is None else self.saved.sha256,
            "seeds": self.seeds,
            "noise_seed": self.noise_seed,
            "warm_up": WARM_UP,
            "dptse-env": version("dptse-env"),
            "space": {path: repr(knob) for path, knob in self.space.items()},
        }


def score_episode(task: TuningTask, settings: EstimatorSettings, traffic_seed: int) -> EpisodeScore:
    """Run one episode of a task with given settings."""
    env = task.make(settings)
    noise = task.noise_seed + traffic_seed
    return run_episode(env, task.policy(env), traffic_seed=traffic_seed, seed=noise)
