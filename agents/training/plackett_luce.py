"""`PlackettLuceLearner`: rounds of regression, then rounds of swaps."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch

from agents.environments import make_vector
from agents.executors import AnyExecutor
from agents.seeds import training_seed
from agents.training.episodes import make_episodes
from agents.training.learner import Record
from agents.training.plan import TrainingPlan
from agents.training.policy_iteration import collect_swaps, raise_scores
from agents.training.recipes import PlackettLuceRecipe
from agents.training.regression import Practice, regress
from agents.training.swap_parts import collect_parts, untrained
from agents.training.swaps import Swaps
from agents.training.worlds import World
from dptse_env.sb3 import PlackettLucePolicy
from dptse_env.vector_env import SensorQueryVectorEnv


class PlackettLuceLearner:
    """Trains a `PlackettLucePolicy`; see `agents.training.learner.Learner`."""

    def __init__(
        self,
        plan: TrainingPlan,
        recipe: PlackettLuceRecipe,
        keywords: Mapping[str, Any],
        progress: Callable[[str, float], None],
        executor: AnyExecutor,
    ) -> None:
        """Make an untrained policy; ``keywords`` are further ones of all environments."""
        self._plan, self._recipe, self._keywords = plan, recipe, keywords
        self._progress, self._executor = progress, executor
        self._rounds, self._is_begun = 0, False
        torch.manual_seed(plan.seed)
        self.policy = untrained(plan.worlds[0], recipe)
        others = [_sharing(self.policy, world) for world in plan.worlds[1:]]
        self.policies = (self.policy, *others)
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
        recipe, seed = self._recipe, self._plan.seed
        if not recipe.regression.rounds:
            return
        practice = []
        for world, policy in zip(self._plan.worlds, self.policies, strict=True):
            keywords = {**world.keywords, **self._keywords}
            n_envs = world.part(recipe.n_envs, recipe.replicas)
            episodes = make_episodes(world.env, keywords, recipe, seed, n_envs=n_envs)
            batch_size = world.part(recipe.regression.batch_size)
            practice.append(Practice(policy, episodes, batch_size))
        regress(practice, recipe.regression, partial(self._progress, "regression"))

    def _swap(self, record: Record) -> None:
        """Do the rounds of swaps that are left, in episodes whose memory is freed afterwards."""
        settings = self._recipe.swaps
        environments = self._environments() if settings.parts == 1 else []
        while self._rounds < settings.rounds:
            start = time.perf_counter()
            tried = self._try(environments)
            step, progress = settings.step_of(self._rounds), partial(self._progress, "fit")
            raise_scores(self.policies, tried, settings, step, progress)
            self._rounds += 1
            error = sum(float(swaps.error.mean()) for swaps in tried) / len(tried)
            record(time.perf_counter() - start, {"error": error})

    def _environments(self) -> list[SensorQueryVectorEnv]:
        """Make an environment of a round's episodes for each world."""
        return [
            make_vector(
                world.env,
                world.part(self._recipe.swaps.episodes),
                {**world.keywords, **self._keywords, "action": self._recipe.action},
            )
            for world in self._plan.worlds
        ]

    def _try(self, environments: Sequence[SensorQueryVectorEnv]) -> list[Swaps]:
        """Return the swaps of a round in each world: tried here, or in parts on the executor."""
        plan, recipe = self._plan, self._recipe
        if recipe.swaps.parts == 1:
            return [
                collect_swaps(policy, env, recipe.swaps, self._rounds, plan.seed, self._progress)
                for policy, env in zip(self.policies, environments, strict=True)
            ]
        return collect_parts(
            plan.worlds,
            self.policies,
            recipe,
            self._keywords,
            seed=plan.seed,
            index=self._rounds,
            executor=self._executor,
            progress=partial(self._progress, "swaps"),
        )


def _sharing(policy: PlackettLucePolicy, world: World) -> PlackettLucePolicy:
    """Return a policy for a world with the weights of another one.

    Raises:
        ValueError: The world's observations have other channels.
    """
    try:
        return policy.sharing(world.config)
    except ValueError as problem:
        raise ValueError(f"also: {world}: {problem}") from problem
