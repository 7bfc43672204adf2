"""`PlackettLuceLearner`: rounds of regression, then rounds of swaps."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch

from agents.evaluation.environments import make_vector
from agents.experiments.seeds import training_seed
from agents.training.episodes import make_episodes
from agents.training.learner import Record
from agents.training.plan import TrainingPlan
from agents.training.policy_iteration import collect_swaps, raise_scores
from agents.training.recipes import PlackettLuceRecipe
from agents.training.regression import regress
from dptse_env.parts import make_interface
from dptse_env.sb3 import PlackettLucePolicy, RoadChannels


class PlackettLuceLearner:
    """Trains a `PlackettLucePolicy`; see `agents.training.learner.Learner`."""

    def __init__(
        self,
        plan: TrainingPlan,
        recipe: PlackettLuceRecipe,
        keywords: Mapping[str, Any],
        progress: Callable[[str, float], None],
    ) -> None:
        """Make an untrained policy; ``keywords`` are those of the environments."""
        self._plan, self._recipe, self._keywords = plan, recipe, keywords
        self._progress = progress
        self._rounds, self._is_begun = 0, False
        interface = make_interface(plan.config)
        torch.manual_seed(plan.seed)
        self.policy = PlackettLucePolicy(
            interface.observations.space,
            interface.actions.space,
            road=RoadChannels.from_config(plan.config),
            width=recipe.width,
            rule=recipe.rule,
        )
        # Draws of the training must not depend on how many weights were drawn before them.
        torch.manual_seed(training_seed(plan.seed))

    @property
    def update(self) -> int:
        """Number of rounds of swaps that are done."""
        return self._rounds

    def train(self, record: Record) -> None:
        """See `Learner`."""
        start = time.perf_counter()
        if not self._is_begun:
            self._regress()
            record(time.perf_counter() - start, {})
        if self._rounds < self._recipe.swaps.rounds:
            self._swap(record)

    def state(self) -> dict[str, Any]:
        """See `Learner`."""
        return {"rounds": self._rounds, "policy": self.policy.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """See `Learner`."""
        self._rounds, self._is_begun = state["rounds"], True
        self.policy.load_state_dict(state["policy"])

    def _regress(self) -> None:
        """Do the rounds of regression, in episodes whose memory is freed afterwards."""
        plan, recipe = self._plan, self._recipe
        if recipe.regression.rounds:
            episodes = make_episodes(plan.env, self._keywords, recipe, plan.seed)
            progress = partial(self._progress, "regression")
            regress(self.policy, episodes, recipe.regression, progress)

    def _swap(self, record: Record) -> None:
        """Do the rounds of swaps that are left, in episodes whose memory is freed afterwards."""
        plan, settings = self._plan, self._recipe.swaps
        keywords = {**self._keywords, "action": self._recipe.action}
        env = make_vector(plan.env, settings.episodes, keywords)
        while self._rounds < settings.rounds:
            start = time.perf_counter()
            swaps = collect_swaps(
                self.policy, env, settings, self._rounds, plan.seed, self._progress
            )
            step, progress = settings.step_of(self._rounds), partial(self._progress, "fit")
            raise_scores(self.policy, swaps, settings, step, progress)
            self._rounds += 1
            record(time.perf_counter() - start, {"error": float(swaps.error.mean())})
