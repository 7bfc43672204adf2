"""How each learner is trained: frozen dataclasses, and the same as YAML for rl-zoo3."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

from dptse_env.sb3.policy import RULE
from dptse_env.validation import inside, integer, non_negative, positive, require


@dataclass(frozen=True)
class SwapRounds:
    """Rounds of policy improvement by measured swaps (`agents.training.policy_iteration`).

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    rounds: int = 8
    """How many; 0 for none."""
    episodes: int = 480
    """Episodes of a round, all at once."""
    seconds: int = 15
    """For how long twins are followed, and between two states of an episode."""
    trials: int = 3
    """Swaps tried in each state."""
    step: float = 25.0
    """By how much a score rises, in the first round, for an expected gain of a second's error."""
    final_step: float = 5.0
    """The same in the last round; it falls linearly, so that what rounds err by averages out."""
    price: float = 0.002
    """Of one vehicle's counting once, in seconds' errors."""
    batches: int = 600
    """Minibatches of a round's fit."""
    batch_size: int = 1024
    """Swaps in a minibatch."""
    rate: float = 5e-4
    """Learning rate of the fit at its start; it falls to nothing."""

    def __post_init__(self) -> None:
        """Check values."""
        integer("recipe.swaps.rounds", self.rounds, 0, 99)
        integer("recipe.swaps.episodes", self.episodes, 1, 9999)
        for name in ("seconds", "trials", "batches", "batch_size"):
            integer(f"recipe.swaps.{name}", getattr(self, name), 1)
        positive("recipe.swaps.step", self.step)
        positive("recipe.swaps.final_step", self.final_step)
        positive("recipe.swaps.rate", self.rate)
        non_negative("recipe.swaps.price", self.price)

    def step_of(self, turn: int) -> float:
        """Return the step of a round, counted from 0."""
        share = turn / max(self.rounds - 1, 1)
        return self.step + (self.final_step - self.step) * share

    def steps(self, horizon: int) -> int:
        """Seconds that a round simulates, all episodes and their twins together."""
        return self.episodes * horizon * (1 + 2 * (1 + self.trials))


NO_ROUNDS = SwapRounds(rounds=0)


@dataclass(frozen=True)
class Recipe:
    """What all recipes share: PPO (Schulman et al., 2017) on many episodes at once.

    Raises:
        ValueError: A value is out of range; the message names it.
    """

    learner: ClassVar[str]
    action: ClassVar[str]
    algorithm: ClassVar[str] = "ppo"
    picks: ClassVar[int] = 1  # actions that make one decision, with the environment's own bandwidth
    default_steps: ClassVar[int] = 2_000_000  # of PPO, where nobody says how many

    n_envs: int = 128
    """Episodes at once."""
    twins: int = 4
    """Episodes that share traffic and noise; each is compared with the others."""
    n_steps: int = 50
    """Actions in each episode between two updates."""
    batch_size: int = 1600
    """Actions in a minibatch."""
    n_epochs: int = 4
    """Passes over the actions of an update, at most."""
    learning_rate: float = 5e-4
    """Of Adam at the start."""
    final_learning_rate: float = 5e-5
    """Of Adam at the end; it falls linearly."""
    gamma: float = 0.95
    """Discount of one second; for `sequential` its root is that of one action."""
    gae_lambda: float = 0.9
    """Of generalised advantage estimation, in the same way."""
    clip_range: float = 0.2
    """Largest change of a probability ratio that is rewarded."""
    target_kl: float = 0.03
    """An update ends early where the policy has moved by half more than this."""
    ent_coef: float = 0.0
    """Weight of the entropy."""
    vf_coef: float = 0.5
    """Weight of the value's loss."""
    max_grad_norm: float = 0.5
    """Longer gradients are shortened."""
    shows_errors: bool = False
    """Whether the critic sees the true errors; the policy never does."""
    reward_scale: float = 0.5
    """Factor on rewards, so that discounted returns are of order one."""

    def __post_init__(self) -> None:
        """Check values."""
        for name in ("n_envs", "twins", "n_steps", "batch_size", "n_epochs"):
            integer(f"recipe.{name}", getattr(self, name), 1)
        for name in ("learning_rate", "clip_range", "target_kl", "max_grad_norm", "reward_scale"):
            positive(f"recipe.{name}", getattr(self, name))
        for name in ("final_learning_rate", "ent_coef", "vf_coef"):
            non_negative(f"recipe.{name}", getattr(self, name))
        inside("recipe.gamma", self.gamma, 0.0, 1.0)
        inside("recipe.gae_lambda", self.gae_lambda, 0.0, 1.0)
        whole = self.n_envs % self.twins == 0
        require(whole, "recipe.n_envs", f"a multiple of twins {self.twins}", self.n_envs)

    @property
    def steps_per_update(self) -> int:
        """Actions between two updates, all episodes together."""
        return self.n_envs * self.n_steps

    @property
    def pretraining_steps(self) -> int:
        """Seconds of traffic that a pretraining watches, all episodes together."""
        return 0

    @property
    def rounds(self) -> SwapRounds:
        """Rounds of swaps ahead of PPO."""
        return NO_ROUNDS

    def policy_keywords(self) -> dict[str, Any]:
        """Return what the policy is made of, beside its spaces and the road."""
        return {}

    def schedule(self) -> Callable[[float], float]:
        """Return the learning rate by the share of training that is left."""
        first, last = self.learning_rate, self.final_learning_rate
        return lambda left: last + (first - last) * left


@dataclass(frozen=True)
class PlackettLuceRecipe(Recipe):
    """`dptse_env.sb3.PlackettLucePolicy`: a pretraining, rounds of swaps, and PPO.

    PPO has not been seen to add to the two; `default_steps` leaves it out.
    """

    learner: ClassVar[str] = "plackett-luce"
    action: ClassVar[str] = "slots"
    default_steps: ClassVar[int] = 0

    learning_rate: float = 5e-5
    """Of the scorer at the start: its scores are steep, and larger steps undo what is learned."""
    final_learning_rate: float = 1e-5
    """Of the scorer at the end; it falls linearly."""
    shows_errors: bool = True
    """Whether the critic and the pretraining see the true errors; the policy never does."""
    width: int = 48
    """Features per segment of the scorer."""
    critic_width: int = 24
    """Features per segment of the critic."""
    critic_rate: float = 30.0
    """Learning rate of the critic over that of the scorer."""
    rule: dict[str, float] = field(default_factory=lambda: dict(RULE))
    """First weights of observation blocks in the scores."""
    pretraining_rounds: int = 3
    """Rounds of `agents.training.regression` ahead of PPO; 0 for none."""
    pretraining_seconds: int = 700
    """Seconds that every episode is watched in a round."""
    pretraining_every: int = 2
    """Seconds between two samples of an episode."""
    pretraining_batches: int = 2000
    """Minibatches of a round."""
    pretraining_batch_size: int = 1024
    """Samples in a minibatch of the pretraining."""
    pretraining_rate: float = 1e-3
    """Learning rate of the pretraining at its start; it falls to a twentieth."""
    sharpness: float = 4.0
    """Scores by the logarithm of the expected squared error."""
    age_bonus: float = 0.3
    """Added to that logarithm for every unit of the channel of ages, 6 s."""
    swaps: SwapRounds = field(default_factory=SwapRounds)
    """Rounds of swaps after the pretraining."""

    def __post_init__(self) -> None:
        """Check values."""
        super().__post_init__()
        for name in ("seconds", "every", "batches", "batch_size"):
            integer(f"recipe.pretraining_{name}", getattr(self, f"pretraining_{name}"), 1)
        integer("recipe.pretraining_rounds", self.pretraining_rounds, 0)
        positive("recipe.pretraining_rate", self.pretraining_rate)
        positive("recipe.critic_rate", self.critic_rate)
        positive("recipe.sharpness", self.sharpness)
        non_negative("recipe.age_bonus", self.age_bonus)
        if self.pretraining_rounds and not self.shows_errors:
            raise ValueError(
                "recipe.shows_errors must be True for a pretraining, which learns them"
            )

    @property
    def pretraining_steps(self) -> int:
        """See `Recipe.pretraining_steps`."""
        return self.pretraining_rounds * self.pretraining_seconds * self.n_envs

    @property
    def rounds(self) -> SwapRounds:
        """See `Recipe.rounds`."""
        return self.swaps

    def policy_keywords(self) -> dict[str, Any]:
        """See `Recipe.policy_keywords`."""
        critic = {"critic_width": self.critic_width, "critic_rate": self.critic_rate}
        return {"width": self.width, **critic, "rule": self.rule}


@dataclass(frozen=True)
class PerceptronRecipe(Recipe):
    """PPO of a multi-layer perceptron, separate for actions and value."""

    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers."""

    def policy_keywords(self) -> dict[str, Any]:
        """See `Recipe.policy_keywords`."""
        return {"net_arch": list(self.hidden)}


@dataclass(frozen=True)
class MaskablePPORecipe(PerceptronRecipe):
    """MaskablePPO of sb3-contrib: segments are picked one by one, each only once."""

    learner: ClassVar[str] = "maskable"
    action: ClassVar[str] = "sequential"
    algorithm: ClassVar[str] = "ppo_mask"
    picks: ClassVar[int] = 5

    n_steps: int = 250


@dataclass(frozen=True)
class ScoresRecipe(PerceptronRecipe):
    """Plain PPO: Gaussian scores, the highest are asked."""

    learner: ClassVar[str] = "scores"
    action: ClassVar[str] = "scores"


@dataclass(frozen=True)
class MaskRecipe(PerceptronRecipe):
    """Plain PPO: a flag for each segment by itself; too many are cut in rotation."""

    learner: ClassVar[str] = "mask"
    action: ClassVar[str] = "mask"


RECIPES: dict[str, type[Recipe]] = {
    recipe.learner: recipe
    for recipe in (PlackettLuceRecipe, MaskablePPORecipe, ScoresRecipe, MaskRecipe)
}
"""Recipes by the name of the learner."""
