"""The plan of a training: algorithms with their tuned settings, environments, seeds."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import torch

from agents.environments import make_config, parse_env
from agents.play import Cell
from agents.seeds import TRAININGS, require_seeds
from dptse_env.config import TRAINING_SEEDS, VALIDATION_SEEDS, EnvConfig
from dptse_env.evaluation import WARM_UP
from dptse_env.parts import make_interface
from dptse_env.policies import read_policy
from dptse_env.release import RELEASE_MODELS
from dptse_env.sb3 import RoadPolicy
from dptse_env.utils.validation import (
    POSITIVE,
    Interval,
    checked_fields,
    from_mapping,
    integer,
    parse_json,
    positive,
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
class Algorithm:
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

    def fits(self, config: EnvConfig) -> bool:
        """Return whether it can choose the queries of an environment."""
        return config.queries.are_segments

    def check(self, worlds: Sequence[World]) -> None:
        """Refuse environments that it cannot train in.

        Raises:
            ValueError: It cannot; the message names the setting.
        """
        if self.replicas > 1 and any(w.config.privacy.noise == "secure" for w in worlds):
            raise ValueError(
                "algorithm.replicas must be 1 where privacy.noise is 'secure', which "
                f"is never drawn twice, got {self.replicas}"
            )


@dataclass(frozen=True)
class Regression:
    """The regression of the estimate's squared errors (`agents.training.regression`)."""

    rounds: Annotated[int, Interval(0, 99)] = 3
    """Times that episodes are played and the network is fitted; 0 for no regression."""
    seconds: Count = 700
    """Seconds simulated in every episode of a round."""
    interval: Count = 2
    """Seconds between two samples of an episode."""
    batches: Count = 1000
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
    episodes: Annotated[int, Interval(1, 9999)] = 160
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

    def step_of(self, done: float) -> float:
        """Return the step of a round, by the fraction of the way to the last round."""
        return self.step + (self.final_step - self.step) * done


@dataclass(frozen=True)
class PlackettLuceSettings(Algorithm):
    """`dptse_env.sb3.RoadPolicy`: a regression of errors, then rounds of swaps.

    One network can learn from several environments.
    """

    name: ClassVar[str] = "plackett-luce"
    action: ClassVar[str] = "slots"

    width: Count = 32
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
        super().check(worlds)
        with torch.random.fork_rng(devices=[]):
            self.make_policies(worlds)
        for world in worlds if self.swaps.rounds else ():
            queries, horizon = world.config.queries, world.config.horizon_steps
            preset, n = world.config.privacy.preset, queries.n_queries
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
class LearnerSettings(Algorithm):
    """Settings of the algorithms of stable-baselines3 and sb3-contrib.

    Their defaults hold for the rest. The defaults here are those of a perceptron, whose
    observations `VecNormalize` scales.
    """

    horizon: Count = 300
    """Longest episode [s]; at most half of a record. Episodes begin anywhere in their record."""
    policy: Literal["road", "mlp"] = "mlp"
    """`RoadPolicy`, whose weights all segments share, or a perceptron."""
    hidden: tuple[Count, ...] = (64, 64)
    """Units of a perceptron's hidden layers, in separate networks for actions and value."""
    learning_rate: Positive = 5e-4
    """Initial learning rate of Adam."""
    final_learning_rate: NonNegative = 5e-5
    """Final learning rate of Adam; it falls linearly."""
    gamma: Discount = 0.9
    """Discount of one second; where a decision takes several actions, its root is that of one."""
    batch_size: Count = 1024
    """Actions in a minibatch."""
    validations: Annotated[int, Interval(1, 9999)] = 24
    """Validations, each with a checkpoint, beside the one of the untrained policy."""

    def __post_init__(self) -> None:
        """Check values."""
        super().__post_init__()
        is_road = self.policy == "road"
        require(not is_road or self.name == PPOSettings.name, "algorithm.policy", "mlp", "road")

    def fits(self, config: EnvConfig) -> bool:
        """See `Algorithm`; a perceptron chooses among whatever there is."""
        return self.policy == "mlp" or super().fits(config)

    def check(self, worlds: Sequence[World]) -> None:
        """See `Algorithm`; statistics of observations are those of one environment."""
        super().check(worlds)
        if len(worlds) > 1:
            raise ValueError(f"env must be one environment for {self.name}, got {worlds[1]} too")

    def episode(self, config: EnvConfig) -> dict[str, Any]:
        """Return the keywords of the episodes that it trains on."""
        most = min(config.horizon_steps, config.corridor.conditions.duration // 2)
        return {"horizon": min(self.horizon, most), "random_start": True}

    def arguments(self, actions_per_step: int) -> dict[str, Any]:
        """Return the keyword arguments of the class that do not change in a training."""
        return {
            "batch_size": self.batch_size,
            "gamma": self.gamma ** (1 / actions_per_step),
        }


@dataclass(frozen=True)
class PPOSettings(LearnerSettings):
    """PPO (Schulman et al., 2017)."""

    name: ClassVar[str] = "ppo"
    action: ClassVar[str] = "slots"

    replicas: Count = 8
    """Episodes in a group that shares traffic and noise; advantages are compared within it."""
    n_steps: Count = 64
    """Seconds of each episode between two updates."""
    n_epochs: Count = 4
    """Passes over the actions of an update."""
    gae_lambda: Discount = 0.9
    """Parameter lambda of generalised advantage estimation, as ``gamma``."""
    ent_coef: NonNegative = 0.005
    """Initial weight of the entropy."""
    final_ent_coef: NonNegative = 0.005
    """Final weight of the entropy; it changes linearly."""

    def arguments(self, actions_per_step: int) -> dict[str, Any]:
        """See `LearnerSettings`."""
        return {
            **super().arguments(actions_per_step),
            "n_steps": self.n_steps * actions_per_step,
            "n_epochs": self.n_epochs,
            "gae_lambda": self.gae_lambda ** (1 / actions_per_step),
        }


@dataclass(frozen=True)
class MaskablePPOSettings(PPOSettings):
    """MaskablePPO: segments are picked one by one, each at most once."""

    name: ClassVar[str] = "maskable-ppo"
    action: ClassVar[str] = "sequential"


@dataclass(frozen=True)
class RecurrentPPOSettings(PPOSettings):
    """RecurrentPPO: an LSTM ahead of the hidden layers."""

    name: ClassVar[str] = "recurrent-ppo"

    lstm: Count = 64
    """Units of the LSTM, one for actions and one for the value."""


@dataclass(frozen=True)
class DQNSettings(LearnerSettings):
    """DQN (Mnih et al., 2015)."""

    name: ClassVar[str] = "dqn"
    action: ClassVar[str] = "sequential"

    replicas: Count = 1
    """Episodes in a group that shares traffic and noise."""
    buffer_size: Count = 200_000
    """Decisions in the replay buffer, which begins empty when a training goes on."""
    learning_starts: Count = 20_000
    """Decisions ahead of the first update."""
    train_freq: Count = 8
    """Seconds of each episode between two updates."""
    gradient_steps: Count = 4
    """Minibatches of an update."""
    target_update_interval: Count = 20_000
    """Decisions between two updates of the target network."""
    exploration: Annotated[float, Interval(0.0, 1.0, open_low=True)] = 0.2
    """Part of the training in which the rate of random actions falls, from 1."""
    final_exploration: Annotated[float, Interval(0.0, 1.0)] = 0.03
    """Rate of random actions after it."""

    def fits(self, config: EnvConfig) -> bool:
        """See `Algorithm`; values are of single queries, not of sets."""
        return config.queries.most_queries == 1

    def arguments(self, actions_per_step: int) -> dict[str, Any]:
        """See `LearnerSettings`."""
        same = (
            "buffer_size", "learning_starts", "train_freq", "gradient_steps",
            "target_update_interval",
        )  # fmt: skip
        return {
            **super().arguments(actions_per_step),
            **{name: getattr(self, name) for name in same},
        }


@dataclass(frozen=True)
class QRDQNSettings(DQNSettings):
    """QR-DQN (Dabney et al., 2018)."""

    name: ClassVar[str] = "qr-dqn"

    quantiles: Count = 25
    """Quantiles of the return of a query."""


ALGORITHMS: dict[str, Algorithm] = {
    each.name: each
    for each in (
        PPOSettings(),
        MaskablePPOSettings(),
        RecurrentPPOSettings(),
        DQNSettings(),
        QRDQNSettings(),
        PlackettLuceSettings(),
    )
}
"""Algorithms by name, with their settings.

Those of PPO with a perceptron were chosen on `ShortHighway-v0` with one query a second, where the
best rule errs by 95.3 (x 1000): 87.0 after eight minutes on one core, 96.5 without `VecNormalize`.
"""

ROAD = {"policy": "road", "learning_rate": 1e-3, "ent_coef": 0.01, "final_ent_coef": 0.0}
"""Settings of PPO with a `RoadPolicy`, its default, that differ from those of a perceptron.

On `PrivateHighway-v1` with one query a second, after 2.5 minutes: with the perceptron's settings
1.2 +- 2.1 % below the best rule, with these and `ReplicaBaseline` 2.7 +- 1.8 %, and 5.6 +- 1.9 %
after 17 minutes. On `ShortHighway-v0` 9.6 +- 1.0 % after five.
"""

LONG_ROAD = {"n_envs": 64, "horizon": 400, "n_steps": 32, "batch_size": 512, "n_epochs": 3}
"""Settings of PPO that differ on a road of `LONG` segments or more, whose seconds cost more.

On `LongHighway-v0` with two queries a second 4.3 +- 2.7 % below the best rule after eight minutes.
"""

LONG = 60
"""Segments of a long road."""


def parse_algorithm(text: str, n_segments: int) -> Algorithm:
    """Return an algorithm with its settings for a road.

    Args:
        text: ``name``, or ``name {JSON}`` of settings that differ.
        n_segments: Mainline segments of the road.

    Raises:
        ValueError: The name or a setting is unknown, or a value is out of range.
    """
    name, _, settings = text.partition(" ")
    require_name("algorithm", name, ALGORITHMS)
    tuned = ALGORITHMS[name]
    given = parse_json(settings, "algorithm") if settings.strip() else {}
    require(isinstance(given, dict), "algorithm", "a name and a JSON object", settings)
    if name == PPOSettings.name and given.get("policy") != "mlp":
        tuned = dataclasses.replace(tuned, **ROAD)  # type: ignore[arg-type]
    if isinstance(tuned, PPOSettings) and n_segments >= LONG:
        tuned = dataclasses.replace(tuned, **LONG_ROAD)  # type: ignore[arg-type]
    return from_mapping(type(tuned), given, "algorithm", tuned)


def fitting(config: EnvConfig) -> list[str]:
    """Return the algorithms that can choose the queries of an environment."""
    every = (PPOSettings.name, f'{PPOSettings.name} {{"policy": "mlp"}}', *list(ALGORITHMS)[1:])
    n_segments = config.corridor.geometry.n_mainline
    return [text for text in every if parse_algorithm(text, n_segments).fits(config)]


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
    seed: int
    traffic_seeds: tuple[int, ...]
    validation_seeds: tuple[int, ...]
    minutes: float | None = None
    steps: int | None = None
    initial: str | None = None

    def __post_init__(self) -> None:
        """Check values that need no environment."""
        integer("seed", self.seed, 0, TRAININGS - 1)
        require(len(self.envs) > 0, "env", "one or more environments", self.envs)
        require_seeds("train_seeds", self.traffic_seeds, TRAINING_SEEDS)
        require_seeds("validation_seeds", self.validation_seeds, VALIDATION_SEEDS)
        if self.minutes is not None:
            positive("minutes", self.minutes)
        if self.steps is not None:
            integer("steps", self.steps, 1)
        name = self.algorithm.name
        if isinstance(self.algorithm, LearnerSettings):
            if (self.minutes is None) == (self.steps is None):
                raise ValueError(
                    f"minutes or steps must be given for {name}, one of them, got "
                    f"{self.minutes} and {self.steps}"
                )
        elif self.steps is not None:
            raise ValueError(
                f"steps are not for {name}, which trains in rounds: give minutes, or set "
                f"algorithm.swaps.rounds"
            )
        is_road = isinstance(self.algorithm, LearnerSettings) and self.algorithm.policy == "road"
        if self.initial is not None:
            require(is_road, "initial", "left out but for ppo with a road policy", self.initial)
            saved = read_policy(self.initial).card["policy"]["class"]
            require(saved == RoadPolicy.__name__, "initial", "a saved RoadPolicy", saved)
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
            first = worlds[0].config if worlds else config
            share = first.corridor.geometry.n_mainline / config.corridor.geometry.n_mainline
            worlds.append(World(env, keywords, config, share))
            if not self.algorithm.fits(config):
                raise ValueError(
                    f"algorithm must be one of {', '.join(fitting(config))} where bandwidth is "
                    f"{config.bandwidth} and queries are {config.queries}, got "
                    f"{self.algorithm.name}"
                )
        self.algorithm.check(worlds)
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
