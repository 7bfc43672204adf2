"""Recipes: how each learner is trained, as frozen dataclasses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

from agents.training.worlds import World
from dptse_env.config import EnvConfig
from dptse_env.release import RELEASE_MODELS
from dptse_env.sb3.plackett_luce import RULE
from dptse_env.utils.fields import inside, integer, non_negative, positive, require


@dataclass(frozen=True)
class RegressionRounds:
    """Rounds of regression of the estimate's squared errors (`agents.training.regression`).

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    rounds: int = 3
    """Number of rounds; 0 for none."""
    seconds: int = 700
    """Seconds simulated in every episode of a round."""
    interval: int = 2
    """Seconds between two samples of an episode."""
    batches: int = 2000
    """Minibatches of a round."""
    batch_size: int = 1024
    """Samples in a minibatch."""
    rate: float = 1e-3
    """Initial learning rate; it falls linearly to a twentieth."""
    max_grad_norm: float = 0.5
    """Norm to which longer gradients are clipped."""
    sharpness: float = 4.0
    """Factor from the logarithm of the expected squared error to the score."""
    age_bonus: float = 0.3
    """Bonus on that logarithm for every unit of the age channel, 6 s."""

    def __post_init__(self) -> None:
        """Check values."""
        integer("recipe.regression.rounds", self.rounds, 0)
        for name in ("seconds", "interval", "batches", "batch_size"):
            integer(f"recipe.regression.{name}", getattr(self, name), 1)
        for name in ("rate", "max_grad_norm", "sharpness"):
            positive(f"recipe.regression.{name}", getattr(self, name))
        non_negative("recipe.regression.age_bonus", self.age_bonus)


@dataclass(frozen=True)
class SwapRounds:
    """Rounds of policy iteration with measured swaps (`agents.training.policy_iteration`).

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    rounds: int = 8
    """Number of rounds; 0 for none."""
    episodes: int = 480
    """Episodes of a round, simulated at once."""
    seconds: int = 15
    """Seconds over which the effect of a swap is measured, and between two states of an episode."""
    trials: int = 3
    """Swaps tried in each state."""
    parts: int = 1
    """Parts of a round's episodes, for as many workers; numbers depend on it, since each part has
    draws of its own, and not on where it runs."""
    step: float = 25.0
    """Rise of a score, in the first round, for an expected gain of one mean one-second error."""
    final_step: float = 5.0
    """The same in the last round; it falls linearly, so that errors of the rounds average out."""
    price: float = 0.128
    """Penalty for the whole budget of a vehicle, in units of the mean one-second error."""
    batches: int = 600
    """Minibatches of a round's fit."""
    batch_size: int = 1024
    """Swaps in a minibatch."""
    rate: float = 5e-4
    """Initial learning rate of the fit; it falls to zero."""

    def __post_init__(self) -> None:
        """Check values."""
        integer("recipe.swaps.rounds", self.rounds, 0, 99)
        integer("recipe.swaps.episodes", self.episodes, 1, 9999)
        for name in ("seconds", "trials", "parts", "batches", "batch_size"):
            integer(f"recipe.swaps.{name}", getattr(self, name), 1)
        positive("recipe.swaps.step", self.step)
        positive("recipe.swaps.final_step", self.final_step)
        positive("recipe.swaps.rate", self.rate)
        non_negative("recipe.swaps.price", self.price)

    def step_of(self, index: int) -> float:
        """Return the step of a round, counted from 0."""
        fraction = index / max(self.rounds - 1, 1)
        return self.step + (self.final_step - self.step) * fraction

    def steps(self, world: World) -> int:
        """Return the seconds that a round simulates, in all episodes and their forks together."""
        seconds = world.part(self.episodes) * world.config.horizon_steps
        return seconds * (1 + 2 * (1 + self.trials))


@dataclass(frozen=True)
class Recipe(ABC):
    """Settings that all recipes share.

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    learner: ClassVar[str]
    action: ClassVar[str]
    default_steps: ClassVar[int]
    """Seconds of traffic to train for where the number is not given."""
    has_long_updates: ClassVar[bool]
    """Whether each update takes long enough to be validated and kept."""
    takes_many: ClassVar[bool] = False
    """Whether one network can learn from several environments."""

    n_envs: int = 128
    """Episodes simulated at once."""
    replicas: int = 4
    """Episodes in a group that shares traffic and noise (common random numbers)."""

    def __post_init__(self) -> None:
        """Check values."""
        for name in ("n_envs", "replicas"):
            integer(f"recipe.{name}", getattr(self, name), 1)
        divisible = self.n_envs % self.replicas == 0
        require(divisible, "recipe.n_envs", f"a multiple of replicas {self.replicas}", self.n_envs)

    @abstractmethod
    def check_steps(self, steps: int) -> None:
        """Refuse a number of seconds to train for that the recipe has no use for.

        Raises:
            ValueError: The number is out of range.
        """

    @abstractmethod
    def check_environment(self, config: EnvConfig) -> None:
        """Refuse an environment that the recipe cannot train in.

        Raises:
            ValueError: It cannot; the message names the setting.
        """

    @abstractmethod
    def n_updates(self, steps: int, actions_per_step: int) -> int:
        """Return the number of updates, or of rounds, in ``steps`` seconds of traffic."""

    @abstractmethod
    def steps_at(self, update: int, world: World, actions_per_step: int) -> int:
        """Return the seconds of traffic simulated in a world by the end of an update."""


@dataclass(frozen=True)
class PlackettLuceRecipe(Recipe):
    """`dptse_env.sb3.PlackettLucePolicy`: regression of errors, then rounds of swaps."""

    learner: ClassVar[str] = "plackett-luce"
    action: ClassVar[str] = "slots"
    default_steps: ClassVar[int] = 0
    has_long_updates: ClassVar[bool] = True
    takes_many: ClassVar[bool] = True

    width: int = 48
    """Features per segment of the scorer."""
    rule: dict[str, float] = field(default_factory=lambda: dict(RULE))
    """Initial weights of observation blocks in the scores."""
    regression: RegressionRounds = field(default_factory=RegressionRounds)
    """Rounds of regression."""
    swaps: SwapRounds = field(default_factory=SwapRounds)
    """Rounds of swaps after the regression."""

    def __post_init__(self) -> None:
        """Check values."""
        super().__post_init__()
        integer("recipe.width", self.width, 1)
        if not self.swaps.rounds and not self.regression.rounds:
            raise ValueError(
                "recipe.swaps.rounds must be an integer in 1..99 where recipe.regression.rounds "
                "is 0, got 0"
            )

    def check_steps(self, steps: int) -> None:
        """See `Recipe.check_steps`."""
        no_steps = steps == 0
        require(no_steps, "steps", f"0 for {self.learner}, which is trained in rounds", steps)

    def check_environment(self, config: EnvConfig) -> None:
        """See `Recipe.check_environment`; swaps choose the noise of a release."""
        preset = config.privacy.preset
        if self.swaps.rounds and not RELEASE_MODELS.find(preset).takes_noise:
            raise ValueError(
                f"recipe.swaps.rounds must be 0 under {RELEASE_MODELS.name_of(preset)!r}, whose "
                f"noise swaps cannot choose, got {self.swaps.rounds}; recipe:maskable trains under "
                "any release model"
            )

    def n_updates(self, steps: int, actions_per_step: int) -> int:
        """Return the number of rounds of swaps."""
        return self.swaps.rounds

    def steps_at(self, update: int, world: World, actions_per_step: int) -> int:
        """See `Recipe.steps_at`; the regression comes ahead of update 0."""
        episodes = world.part(self.n_envs, self.replicas)
        regression = self.regression.rounds * self.regression.seconds * episodes
        return regression + update * self.swaps.steps(world)


@dataclass(frozen=True)
class PPORecipe(Recipe):
    """PPO (Schulman et al., 2017) of a multi-layer perceptron on many episodes at once."""

    default_steps: ClassVar[int] = 2_000_000
    has_long_updates: ClassVar[bool] = False

    n_steps: int = 50
    """Actions in each episode between two updates."""
    batch_size: int = 1600
    """Actions in a minibatch."""
    n_epochs: int = 4
    """Passes over the actions of an update, at most."""
    learning_rate: float = 5e-4
    """Initial learning rate of Adam."""
    final_learning_rate: float = 5e-5
    """Final learning rate of Adam; it falls linearly."""
    gamma: float = 0.95
    """Discount of one second; for `sequential` its root is that of one action."""
    gae_lambda: float = 0.9
    """Parameter lambda of generalised advantage estimation, in the same way."""
    clip_range: float = 0.2
    """Range around 1 to which probability ratios are clipped."""
    target_kl: float = 0.03
    """An update ends early where the KL divergence exceeds this by half."""
    ent_coef: float = 0.0
    """Weight of the entropy."""
    vf_coef: float = 0.5
    """Weight of the value's loss."""
    max_grad_norm: float = 0.5
    """Norm to which longer gradients are clipped."""
    reward_scale: float = 0.5
    """Factor on rewards, so that discounted returns are of order one."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers, in separate networks for actions and value."""

    def __post_init__(self) -> None:
        """Check values."""
        super().__post_init__()
        for name in ("n_steps", "batch_size", "n_epochs"):
            integer(f"recipe.{name}", getattr(self, name), 1)
        for name in ("learning_rate", "clip_range", "target_kl", "max_grad_norm", "reward_scale"):
            positive(f"recipe.{name}", getattr(self, name))
        for name in ("final_learning_rate", "ent_coef", "vf_coef"):
            non_negative(f"recipe.{name}", getattr(self, name))
        inside("recipe.gamma", self.gamma, 0.0, 1.0)
        inside("recipe.gae_lambda", self.gae_lambda, 0.0, 1.0)

    @property
    def steps_per_update(self) -> int:
        """Actions between two updates, all episodes together."""
        return self.n_envs * self.n_steps

    def check_steps(self, steps: int) -> None:
        """See `Recipe.check_steps`."""
        integer("steps", steps, 1)

    def check_environment(self, config: EnvConfig) -> None:
        """See `Recipe.check_environment`; PPO trains in all of them."""

    def n_updates(self, steps: int, actions_per_step: int) -> int:
        """See `Recipe.n_updates`; the last update is a whole one."""
        return -(-steps * actions_per_step // self.steps_per_update)

    def steps_at(self, update: int, world: World, actions_per_step: int) -> int:
        """See `Recipe.steps_at`."""
        return update * self.steps_per_update // actions_per_step

    def schedule(self) -> Callable[[float], float]:
        """Return the learning rate as a function of the fraction of the training that is left."""
        first, last = self.learning_rate, self.final_learning_rate
        return lambda left: last + (first - last) * left


@dataclass(frozen=True)
class MaskablePPORecipe(PPORecipe):
    """MaskablePPO of sb3-contrib: segments are picked one by one, each at most once."""

    learner: ClassVar[str] = "maskable"
    action: ClassVar[str] = "sequential"

    n_steps: int = 250


@dataclass(frozen=True)
class ScoresRecipe(PPORecipe):
    """PPO on Gaussian scores, of which the highest are queried."""

    learner: ClassVar[str] = "scores"
    action: ClassVar[str] = "scores"


@dataclass(frozen=True)
class MaskRecipe(PPORecipe):
    """PPO on a flag for each segment; where too many are set, they are served in rotation."""

    learner: ClassVar[str] = "mask"
    action: ClassVar[str] = "mask"


RECIPES: dict[str, type[Recipe]] = {
    recipe.learner: recipe
    for recipe in (PlackettLuceRecipe, MaskablePPORecipe, ScoresRecipe, MaskRecipe)
}
"""Recipes by the name of the learner."""
