"""The plan of a training: algorithms with their settings, environments, seeds.

An algorithm is a frozen dataclass of settings here, an entry in `ALGORITHMS`, and the function that
trains by it, an entry in `agents.training.training.TRAINERS`.
"""

from __future__ import annotations

import dataclasses
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, ClassVar

import torch

from agents.environments import make_config, parse_env
from agents.play import Cell
from agents.seeds import TRAININGS, require_seeds
from dptse_env.config import TRAINING_SEEDS, VALIDATION_SEEDS, EnvConfig
from dptse_env.evaluation import WARM_UP
from dptse_env.parts import make_interface
from dptse_env.release import RELEASE_MODELS
from dptse_env.sb3 import RoadPolicy
from dptse_env.utils.fields import (
    POSITIVE,
    Interval,
    checked_fields,
    from_mapping,
    integer,
    parse_json,
    require,
    require_name,
)

Count = Annotated[int, Interval(1, math.inf)]
Positive = Annotated[float, POSITIVE]
NonNegative = Annotated[float, Interval(0.0, math.inf, open_high=True)]
Discount = Annotated[float, Interval(0.0, 1.0, open_low=True, open_high=True)]


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
class Algorithm(ABC):
    """Settings that all algorithms share.

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    name: ClassVar[str]
    action: ClassVar[str]
    """Encoding of the actions."""

    n_envs: Count = 128
    """Episodes simulated at once."""
    replicas: Count = 4
    """Episodes in a group that shares traffic and noise (common random numbers)."""

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "algorithm")
        divisible = self.n_envs % self.replicas == 0
        allowed = f"a multiple of replicas {self.replicas}"
        require(divisible, "algorithm.n_envs", allowed, self.n_envs)

    @property
    @abstractmethod
    def n_updates(self) -> int:
        """Number of updates, or of rounds."""

    @abstractmethod
    def check(self, worlds: Sequence[World]) -> None:
        """Refuse environments that it cannot train in.

        Raises:
            ValueError: It cannot; the message names the setting.
        """


@dataclass(frozen=True)
class Regression:
    """The regression of the estimate's squared errors (`agents.training.regression`)."""

    rounds: Annotated[int, Interval(0, 99)] = 3
    """Times that episodes are played and the network is fitted; 0 for no regression."""
    seconds: Count = 700
    """Seconds simulated in every episode of a round."""
    interval: Count = 2
    """Seconds between two samples of an episode."""
    batches: Count = 2000
    """Minibatches of a round."""
    batch_size: Count = 1024
    """Samples in a minibatch."""
    rate: Positive = 1e-3
    """Initial learning rate; it falls linearly to a twentieth."""
    max_grad_norm: Positive = 0.5
    """Norm to which longer gradients are clipped."""
    sharpness: Positive = 4.0
    """Factor from the logarithm of the expected squared error to the score."""
    age_bonus: NonNegative = 0.3
    """Bonus on that logarithm for every unit of the age channel, 6 s."""

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "algorithm.regression")


@dataclass(frozen=True)
class SwapRounds:
    """Rounds of policy iteration with measured swaps (`agents.training.swaps`)."""

    rounds: Annotated[int, Interval(0, 99)] = 8
    """Number of rounds; 0 for none."""
    episodes: Annotated[int, Interval(1, 9999)] = 480
    """Episodes of a round, simulated at once."""
    seconds: Count = 15
    """Seconds over which the effect of a swap is measured, and between two states of an episode."""
    trials: Count = 3
    """Swaps tried in each state."""
    step: Positive = 25.0
    """Rise of a score, in the first round, for an expected gain of one mean one-second error."""
    final_step: Positive = 5.0
    """The same in the last round; it falls linearly, so that errors of the rounds average out."""
    price: NonNegative = 0.128
    """Penalty for the whole budget of a vehicle, in units of the mean one-second error."""
    batches: Count = 600
    """Minibatches of a round's fit."""
    batch_size: Count = 1024
    """Swaps in a minibatch."""
    rate: Positive = 5e-4
    """Initial learning rate of the fit; it falls to zero."""

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "algorithm.swaps")

    def step_of(self, index: int) -> float:
        """Return the step of a round, counted from 0."""
        return self.step + (self.final_step - self.step) * index / max(self.rounds - 1, 1)


@dataclass(frozen=True)
class PlackettLuceSettings(Algorithm):
    """`dptse_env.sb3.RoadPolicy`: a regression of errors, then rounds of swaps.

    One network can learn from several environments.
    """

    name: ClassVar[str] = "plackett-luce"
    action: ClassVar[str] = "slots"

    width: Count = 48
    """Features per segment of the scorer."""
    regression: Regression = field(default_factory=Regression)
    """The regression, which is round 0 of the training."""
    swaps: SwapRounds = field(default_factory=SwapRounds)
    """Rounds of swaps after the regression."""

    def __post_init__(self) -> None:
        """Check values."""
        super().__post_init__()
        some = self.swaps.rounds > 0 or self.regression.rounds > 0
        require(some, "algorithm.swaps.rounds", "above 0 where regression.rounds is 0", 0)

    @property
    def n_updates(self) -> int:
        """See `Algorithm`."""
        return self.swaps.rounds

    def make_policies(self, worlds: Sequence[World]) -> list[RoadPolicy]:
        """Return an untrained policy for each of the worlds; they have one network in common.

        Raises:
            ValueError: Observations have other channels than those of the first world.
        """
        policies = [RoadPolicy.from_config(worlds[0].config, width=self.width)]
        for world in worlds[1:]:
            try:
                policies.append(policies[0].sharing(world.config))
            except ValueError as problem:
                raise ValueError(f"env: {world}: {problem}") from problem
        return policies

    def check(self, worlds: Sequence[World]) -> None:
        """See `Algorithm`; swaps choose the noise of a release."""
        with torch.random.fork_rng(devices=[]):
            self.make_policies(worlds)
        for world in worlds if self.swaps.rounds else ():
            queries, horizon = world.config.queries, world.config.horizon_steps
            preset, n = world.config.privacy.preset, queries.n_options
            least = first_second(horizon) + 2 * self.swaps.seconds - 1
            where = f"where algorithm.swaps.rounds is {self.swaps.rounds}"
            name, model = RELEASE_MODELS.name_of(preset), RELEASE_MODELS.find(preset)
            noise = f"one whose noise can be set {where}"
            require(model.takes_noise, "privacy.preset", noise, name)
            require(queries.most_queries < n, "bandwidth", f"below {n} {where}", queries.bandwidth)
            require(horizon >= least, "horizon", f"{least} s or more {where}", horizon)


def first_second(horizon: int) -> int:
    """Return the earliest second of an episode of ``horizon`` seconds in which swaps are tried."""
    return min(WARM_UP, horizon // 4)


@dataclass(frozen=True)
class PPOSettings(Algorithm):
    """PPO (Schulman et al., 2017) of stable-baselines3, whose defaults hold for the rest."""

    name: ClassVar[str] = "ppo"
    action: ClassVar[str] = "slots"

    replicas: Count = 8
    """Episodes in a group that shares traffic and noise; advantages are compared within it."""
    steps: Count = 2_000_000
    """Seconds of traffic to train for, all episodes together, each with one decision; rounded up to
    whole updates."""
    n_steps: Count = 64
    """Seconds of each episode between two updates."""
    batch_size: Count = 1024
    """Actions in a minibatch."""
    n_epochs: Count = 4
    """Passes over the actions of an update."""
    learning_rate: Positive = 5e-4
    """Initial learning rate of Adam."""
    final_learning_rate: NonNegative = 5e-5
    """Final learning rate of Adam; it falls linearly."""
    gamma: Discount = 0.9
    """Discount of one second; where a decision takes several actions, its root is that of one."""
    gae_lambda: Discount = 0.9
    """Parameter lambda of generalised advantage estimation, in the same way."""
    ent_coef: NonNegative = 0.005
    """Weight of the entropy."""
    hidden: tuple[Count, ...] = (64, 64)
    """Units of the hidden layers, in separate networks for actions and value."""
    validate_every: Count = 20
    """Updates between two validations, each with a checkpoint."""

    @property
    def n_updates(self) -> int:
        """See `Algorithm`."""
        return -(-self.steps // (self.n_envs * self.n_steps))

    def check(self, worlds: Sequence[World]) -> None:
        """See `Algorithm`; a perceptron is tied to one environment."""
        if len(worlds) > 1:
            raise ValueError(f"env must be one environment for {self.name}, got {worlds[1]} too")


@dataclass(frozen=True)
class MaskablePPOSettings(PPOSettings):
    """MaskablePPO of sb3-contrib: segments are picked one by one, each at most once."""

    name: ClassVar[str] = "maskable-ppo"
    action: ClassVar[str] = "sequential"


ALGORITHMS: dict[str, Algorithm] = {
    each.name: each for each in (PlackettLuceSettings(), PPOSettings(), MaskablePPOSettings())
}
"""Algorithms by name, with their tuned settings."""


def parse_algorithm(text: str) -> Algorithm:
    """Return the algorithm given as ``name`` or ``name {JSON}`` of settings that differ.

    Raises:
        ValueError: The name or a setting is unknown, or a value is out of range.
    """
    name, _, settings = text.partition(" ")
    require_name("algorithm", name, ALGORITHMS)
    tuned = ALGORITHMS[name]
    given = parse_json(settings, "algorithm") if settings.strip() else {}
    return from_mapping(type(tuned), given, "algorithm", tuned)


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

    Raises:
        ValueError: A value is out of range, or a seed is not of its kind.
    """

    envs: tuple[str, ...]
    algorithm: Algorithm
    seed: int
    traffic_seeds: tuple[int, ...]
    validation_seeds: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check values that need no environment."""
        integer("seed", self.seed, 0, TRAININGS - 1)
        require(len(self.envs) > 0, "env", "one or more environments", self.envs)
        require_seeds("traffic", self.traffic_seeds, TRAINING_SEEDS)
        require_seeds("validation", self.validation_seeds, VALIDATION_SEEDS)
        for _, keywords in map(parse_env, self.envs):
            for key in ("action", "traffic_seeds", "autoreset_mode"):
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
            allowed = f"above {WARM_UP} s, the warm-up of a validation"
            require(config.horizon_steps > WARM_UP, "horizon", allowed, config.horizon_steps)
            first = worlds[0].config if worlds else config
            share = first.corridor.n_mainline / config.corridor.n_mainline
            worlds.append(World(env, keywords, config, share))
        self.algorithm.check(worlds)
        return tuple(worlds)

    def check(self) -> None:
        """Check the environments without playing, recording or compiling.

        Raises:
            ValueError: As `worlds`, or an estimator does not suit its road.
        """
        for world in self.worlds:
            Cell(world.env, "none", {**world.keywords, "action": self.algorithm.action}).check()

    def content(self) -> dict[str, Any]:
        """Return what the numbers of the training depend on, as plain JSON."""
        content = dataclasses.asdict(self)
        content["algorithm"] = {"name": self.algorithm.name, **content["algorithm"]}
        content["corridors"] = [world.config.corridor.digest for world in self.worlds]
        content["settings"] = [dataclasses.asdict(world.config.settings()) for world in self.worlds]
        plain: dict[str, Any] = json.loads(json.dumps(content))
        return plain
