"""The plan of a training: algorithms with their tuned settings, environments, seeds."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
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
    parse_json,
    read_toml,
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
    """Hyperparameters of all algorithms; ``hyperparameters.toml`` has values and what they are.

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    name: ClassVar[str]
    action: ClassVar[str]
    """Encoding of the actions."""

    n_envs: Count
    replicas: Count

    def __post_init__(self) -> None:
        """Check what `from_mapping` does not."""
        divisible, allowed = self.n_envs % self.replicas == 0, f"a multiple of {self.replicas}"
        require(divisible, "algorithm.n_envs", f"{allowed} replicas", self.n_envs)

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

    rounds: Annotated[int, Interval(0, 99)]
    seconds: Count
    interval: Count
    batches: Count
    batch_size: Count
    rate: Positive
    max_grad_norm: Positive
    sharpness: Positive
    age_bonus: NonNegative


@dataclass(frozen=True)
class SwapRounds:
    """Rounds of policy iteration with measured swaps (`agents.training.swaps`)."""

    rounds: Annotated[int, Interval(0, 99)]
    episodes: Annotated[int, Interval(1, 9999)]
    seconds: Count
    trials: Count
    step: Positive
    final_step: Positive
    price: NonNegative
    batches: Count
    batch_size: Count
    rate: Positive

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

    width: Count
    regression: Regression
    swaps: SwapRounds

    def __post_init__(self) -> None:
        """Check what `from_mapping` does not."""
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
    """Hyperparameters of the algorithms of stable-baselines3 and sb3-contrib."""

    horizon: Count
    policy: Literal["road", "mlp"]
    hidden: tuple[Count, ...]
    learning_rate: Positive
    final_learning_rate: NonNegative
    gamma: Discount
    batch_size: Count
    validations: Annotated[int, Interval(1, 9999)]

    def __post_init__(self) -> None:
        """Check what `from_mapping` does not."""
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


@dataclass(frozen=True)
class PPOSettings(LearnerSettings):
    """PPO (Schulman et al., 2017)."""

    name: ClassVar[str] = "ppo"
    action: ClassVar[str] = "slots"

    n_steps: Count
    n_epochs: Count
    gae_lambda: Discount
    ent_coef: NonNegative
    final_ent_coef: NonNegative


@dataclass(frozen=True)
class MaskablePPOSettings(PPOSettings):
    """MaskablePPO: segments are picked one by one, each at most once."""

    name: ClassVar[str] = "maskable-ppo"
    action: ClassVar[str] = "sequential"


@dataclass(frozen=True)
class RecurrentPPOSettings(PPOSettings):
    """RecurrentPPO: an LSTM ahead of the hidden layers."""

    name: ClassVar[str] = "recurrent-ppo"

    lstm: Count


@dataclass(frozen=True)
class DQNSettings(LearnerSettings):
    """DQN (Mnih et al., 2015)."""

    name: ClassVar[str] = "dqn"
    action: ClassVar[str] = "sequential"

    buffer_size: Count
    learning_starts: Count
    train_freq: Count
    gradient_steps: Count
    target_update_interval: Count
    exploration: Annotated[float, Interval(0.0, 1.0, open_low=True)]
    final_exploration: Annotated[float, Interval(0.0, 1.0)]

    def fits(self, config: EnvConfig) -> bool:
        """See `Algorithm`; values are of single queries, not of sets."""
        return config.queries.most_queries == 1


@dataclass(frozen=True)
class QRDQNSettings(DQNSettings):
    """QR-DQN (Dabney et al., 2018)."""

    name: ClassVar[str] = "qr-dqn"

    quantiles: Count


ALGORITHMS: dict[str, type[Algorithm]] = {
    each.name: each
    for each in (
        PPOSettings,
        MaskablePPOSettings,
        RecurrentPPOSettings,
        DQNSettings,
        QRDQNSettings,
        PlackettLuceSettings,
    )
}
"""Classes of hyperparameters by the name of the algorithm."""

TABLE = Path(__file__).with_name("hyperparameters.toml")
"""Their values."""


def parse_algorithm(text: str, n_segments: int) -> Algorithm:
    """Return an algorithm with its hyperparameters for a road.

    Args:
        text: ``name``, or ``name {JSON}`` of values that differ from the table's.
        n_segments: Mainline segments of the road.

    Raises:
        ValueError: The name or a hyperparameter is unknown, or a value is out of range.
    """
    name, _, settings = text.partition(" ")
    require_name("algorithm", name, ALGORITHMS)
    given = parse_json(settings, "algorithm") if settings.strip() else {}
    require(isinstance(given, dict), "algorithm", "a name and a JSON object", settings)
    tables = read_toml(TABLE, "table of hyperparameters")
    values = tables[name]
    values = {**tables[values.pop("like", name)], **values}
    on_long, with_road = values.pop("long", {"segments": math.inf}), values.pop("road", {})
    if given.get("policy", values.get("policy")) == "road":
        values |= with_road
    if n_segments >= on_long.pop("segments"):
        values |= on_long
    tuned = from_mapping(ALGORITHMS[name], values, "algorithm")
    return from_mapping(ALGORITHMS[name], given, "algorithm", tuned)


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
