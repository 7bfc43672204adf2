"""Hyperparameters of the algorithms that train policies, as `hyperparameters.toml` has them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from dptse_env.config import EnvConfig
from dptse_env.utils.validation import (
    POSITIVE,
    Interval,
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
