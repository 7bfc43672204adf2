"""The plan of a training: an algorithm on environments, with seeds."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

import torch

from agents.environments import make_config, parse_env
from agents.play import Cell
from agents.seeds import TRAININGS, require_seeds
from agents.training.settings import (
    ALGORITHMS,
    Algorithm,
    Count,
    LearnerSettings,
    PlackettLuceSettings,
    Positive,
    parse_algorithm,
)
from agents.training.swaps import first_second
from dptse_env.config import TRAINING_SEEDS, VALIDATION_SEEDS, EnvConfig
from dptse_env.parts import make_interface
from dptse_env.policies import read_policy
from dptse_env.release import RELEASE_MODELS
from dptse_env.sb3 import RoadPolicy
from dptse_env.utils.validation import Interval, checked_fields, require


@dataclass(frozen=True)
class World:
    """An environment that a policy is trained in.

    Attributes:
        env: Environment id.
        keywords: Keywords of the environment, plain JSON, without those that the training chooses.
        config: Its configuration, with those.
        share: Its part of episodes and samples over that of the first environment: a road of more
            segments has as many fewer, since every segment of every second is a sample.
    """

    env: str
    keywords: Mapping[str, Any]
    config: EnvConfig = field(repr=False)
    share: float = 1.0

    def part(self, count: int, multiple: int = 1) -> int:
        """Return the world's part of a number, a multiple of another one and not zero."""
        return max(round(count * self.share / multiple), 1) * multiple

    def __str__(self) -> str:
        """Return the id, with the keywords after it if there are any."""
        return f"{self.env} {dict(self.keywords)}" if self.keywords else self.env


@dataclass(frozen=True)
class TrainingPlan:
    """An algorithm on environments with a training seed.

    Attributes:
        envs: Environments to train and validate in, each an id, or an id and keywords as JSON
            (`agents.environments.parse_env`). The policy is saved for the first one.
        algorithm: How it is trained; it chooses the action encoding.
        seed: Seeds the initial weights, draws of actions, noise and the choice of traffic.
        traffic_seeds: Traffic to train on.
        validation_seeds: Traffic to validate on.
        minutes: Time of the processor to train for, validations included; None where there are
            ``steps``, or where plackett-luce has a number of rounds.
        steps: Seconds of traffic to train for, all episodes together; not for plackett-luce.
        initial: Saved `RoadPolicy` to begin with, for PPO.

    Raises:
        ValueError: A value is out of range, or a seed is not of its kind.
    """

    envs: tuple[str, ...]
    algorithm: Algorithm
    seed: Annotated[int, Interval(0, TRAININGS - 1)]
    traffic_seeds: tuple[int, ...]
    validation_seeds: tuple[int, ...]
    minutes: Positive | None = None
    steps: Count | None = None
    initial: str | None = None

    def __post_init__(self) -> None:
        """Check values that need no environment."""
        checked_fields(self, "")
        require(len(self.envs) > 0, "env", "one or more environments", self.envs)
        require_seeds("train_seeds", self.traffic_seeds, TRAINING_SEEDS)
        require_seeds("validation_seeds", self.validation_seeds, VALIDATION_SEEDS)
        name, policy = self.algorithm.name, getattr(self.algorithm, "policy", "")
        if isinstance(self.algorithm, LearnerSettings):
            given, allowed = [self.minutes, self.steps], f"one of the two for {name}"
            require(None in given and given != [None, None], "minutes and steps", allowed, given)
        else:
            allowed = f"left out for {name}, which trains in rounds"
            require(self.steps is None, "steps", allowed, self.steps)
        if self.initial is not None:
            allowed = "left out but for ppo with a road policy"
            require(policy == "road", "initial", allowed, self.initial)
            saved = read_policy(self.initial).card["policy"]["class"]
            require(saved == RoadPolicy.__name__, "initial", "a saved RoadPolicy", saved)
        for _, keywords in map(parse_env, self.envs):
            for key in ("action", "traffic_seeds", "records", "autoreset_mode"):
                if key in keywords:
                    raise ValueError(f"env: {key} is chosen by the training, leave it out")

    @cached_property
    def actions_per_step(self) -> int:
        """Actions that make one decision."""
        return make_interface(self.worlds[0].config).actions.actions_per_step

    @cached_property
    def worlds(self) -> tuple[World, ...]:
        """The environments to train in.

        Raises:
            ValueError: A keyword is unknown or out of range, or the algorithm cannot train there.
        """
        chosen = {"action": self.algorithm.action, "traffic_seeds": list(self.traffic_seeds)}
        worlds: list[World] = []
        for env, keywords in map(parse_env, self.envs):
            config = make_config(env, {**chosen, **keywords})
            first = worlds[0].config if worlds else config
            share = first.corridor.geometry.n_mainline / config.corridor.geometry.n_mainline
            worlds.append(World(env, keywords, config, share))
            _check(self.algorithm, config)
        if isinstance(self.algorithm, PlackettLuceSettings):
            with torch.random.fork_rng(devices=[]):
                make_policies(self.algorithm, worlds)
        elif len(worlds) > 1:
            name = self.algorithm.name
            raise ValueError(f"env must be one environment for {name}, got {worlds[1]} too")
        return tuple(worlds)

    def check(self) -> None:
        """Check the environments without playing, recording or compiling.

        Raises:
            ValueError: As `worlds`, or an estimator does not suit its road.
        """
        for world in self.worlds:
            keywords = {**world.keywords, "action": self.algorithm.action}
            Cell(world.env, self.initial or "none", keywords, transferred=True).check()

    def content(self) -> dict[str, Any]:
        """Return what the numbers of the training depend on, as plain JSON."""
        content = dataclasses.asdict(self)
        content["algorithm"] = {"name": self.algorithm.name, **content["algorithm"]}
        if self.initial is not None:
            content["initial"] = read_policy(self.initial).identity
        content["corridors"] = [world.config.corridor.digest for world in self.worlds]
        content["settings"] = [dataclasses.asdict(world.config.settings()) for world in self.worlds]
        plain: dict[str, Any] = json.loads(json.dumps(content))
        return plain


def fitting(config: EnvConfig) -> list[str]:
    """Return the algorithms that can choose the queries of an environment."""
    every = ("ppo", 'ppo {"policy": "mlp"}', *list(ALGORITHMS)[1:])
    n_segments = config.corridor.geometry.n_mainline
    return [text for text in every if parse_algorithm(text, n_segments).fits(config)]


def _check(algorithm: Algorithm, config: EnvConfig) -> None:
    """Refuse an environment that an algorithm cannot train in.

    Raises:
        ValueError: See above; the message names the setting.
    """
    queries, horizon, name = config.queries, config.horizon_steps, algorithm.name
    if not algorithm.fits(config):
        where = f"where bandwidth is {config.bandwidth} and queries are {queries}"
        raise ValueError(
            f"algorithm must be one of {', '.join(fitting(config))} {where}, got {name}"
        )
    if config.privacy.noise == "secure":
        allowed = "1 where privacy.noise is 'secure', which is never drawn twice"
        require(algorithm.replicas == 1, "algorithm.replicas", allowed, algorithm.replicas)
    if isinstance(algorithm, PlackettLuceSettings) and algorithm.swaps.rounds:
        preset, n, swaps = config.privacy.preset, queries.n_queries, algorithm.swaps
        least = first_second(horizon) + 2 * swaps.seconds - 1
        where = f"where algorithm.swaps.rounds is {swaps.rounds}"
        name, model = RELEASE_MODELS.name_of(preset), RELEASE_MODELS.find(preset)
        require(model.takes_noise, "privacy.preset", f"one whose noise can be set {where}", name)
        require(queries.most_queries < n, "bandwidth", f"below {n} {where}", queries.bandwidth)
        require(horizon >= least, "horizon", f"{least} s or more {where}", horizon)
        require(config.query_every == 1, "query_every", f"1 {where}", config.query_every)


def make_policies(algorithm: PlackettLuceSettings, worlds: Sequence[World]) -> list[RoadPolicy]:
    """Return an untrained policy for each of the worlds; they have one network in common.

    Raises:
        ValueError: Observations have other channels than those of the first world.
    """
    policies = [RoadPolicy.from_config(worlds[0].config, width=algorithm.width)]
    for world in worlds[1:]:
        try:
            policies.append(policies[0].sharing(world.config))
        except ValueError as problem:
            raise ValueError(f"env: {world}: {problem}") from problem
    return policies
