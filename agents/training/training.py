"""`Training`: runs a plan in a folder, and continues there after an interruption."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from agents.executors import THIS_PROCESS, AnyExecutor
from agents.training.learner import Learner
from agents.training.plackett_luce import PlackettLuceLearner
from agents.training.plan import TrainingPlan
from agents.training.ppo import PPOLearner
from agents.training.recipes import PlackettLuceRecipe, PPORecipe
from agents.training.run_files import (
    Row,
    keep_plan,
    read_checkpoint,
    read_progress,
    write_checkpoint,
    write_progress,
)
from agents.training.validation import Validation
from dptse_env.parts import make_interface
from dptse_env.sb3.saved import ActingPolicy, save_policy
from dptse_env.traffic import Records

POLICY, BEST = "policy.safetensors", "best.safetensors"


Watcher = Callable[[Row], None]
"""Receives every row of the learning curve as it comes."""


class Training:
    """A plan in a folder: a learner, its learning curve, validation and checkpoints.

    After every update the complete state is at hand (`agents.training.learner`). A checkpoint
    holds it, so that a training that was killed continues to the same numbers as if it had not
    been, on the same machine with the same number of torch's threads.

    Attributes:
        plan: The plan.
        folder: The folder.
        learner: The policy and the way in which it is trained.
        rows: The learning curve so far.
    """

    def __init__(
        self,
        plan: TrainingPlan,
        folder: Path,
        *,
        records: Records = None,
        executor: AnyExecutor = THIS_PROCESS,
        watchers: tuple[Watcher, ...] = (),
        progress: Callable[[str, float], None] = lambda stage, fraction: None,
    ) -> None:
        """Take the folder and restore its state.

        Args:
            plan: The plan.
            folder: The folder; made if it is missing.
            records: Library of records, or its folder; None for the user's cache.
            executor: Runs the parts of a round of swaps, where there are several.
            watchers: Receive every row, those read from the folder first.
            progress: Called between two rows with the name of a stage and the fraction of it that
                is done.

        Raises:
            ValueError: The folder belongs to another plan, or its checkpoint is damaged.
            OSError: The folder cannot be written.
        """
        self.plan, self.folder, self._watchers = plan, folder, watchers
        checkpoint = read_checkpoint(folder)  # may refuse the folder, which then stays as it is
        keep_plan(folder, plan.content())
        training = {"records": records, "traffic_seeds": list(plan.traffic_seeds)}
        self.learner = _make_learner(plan, training, progress, executor)
        chosen = {"records": records, "action": plan.recipe.action}
        self._validations = [
            (
                str(world),
                ActingPolicy(policy, make_interface(world.config)),
                Validation(world.env, {**world.keywords, **chosen}, plan.validation_seeds),
            )
            for world, policy in zip(plan.worlds, self.learner.policies, strict=True)
        ]
        self.rows: list[Row] = []
        self._seconds, self._best = 0.0, float("inf")
        self._errors: dict[str, dict[str, float]] = {}
        if checkpoint is not None:
            self._resume(checkpoint)

    @property
    def update(self) -> int:
        """Number of updates, or of rounds, that are done."""
        return self.learner.update

    @property
    def is_finished(self) -> bool:
        """True if all updates are done."""
        return self.update >= self.plan.n_updates

    def run(self) -> None:
        """Train until the end of the plan; leave the policy beside the checkpoint.

        Raises:
            OSError: The disk is full or cannot be written; the last checkpoint stays.
        """
        self.learner.train(self._record)
        self._save(POLICY, self.rows[-1])

    def _record(self, seconds: float, values: Row) -> None:
        """Record a finished round or update."""
        update, plan = self.update, self.plan
        self._seconds += seconds
        row: Row = {"update": update, "steps": plan.steps_at(update)}
        row |= {"seconds": round(self._seconds, 1), **values}
        if plan.is_due(update, plan.validate_every):
            self._validate(row)
        self.rows.append(row)
        for watcher in self._watchers:
            watcher(row)
        if plan.is_due(update, plan.checkpoint_every):
            self._keep()

    def _validate(self, row: Row) -> None:
        for name, deterministic in (("validation", True), ("validation_drawn", False)):
            self._errors[name] = {
                world: float(validation.errors(acting, deterministic=deterministic).mean())
                for world, acting, validation in self._validations
            }
            row[name] = sum(self._errors[name].values()) / len(self._errors[name])
        if row["validation"] < self._best:
            self._best = row["validation"]
            self._save(BEST, row)

    def _save(self, name: str, row: Row) -> None:
        plan, n = self.plan, len(self.plan.validation_seeds)
        figures: dict[str, float] = {}
        for key, kind in (("validation", "deterministic"), ("validation_drawn", "drawn")):
            figures[f"error on {n} validation episodes, {kind}"] = row[key]
            if plan.also:
                for world, error in self._errors.get(key, {}).items():
                    figures[f"error in {world}, {kind}"] = error
        save_policy(
            self.folder / name,
            self.learner.policy,
            plan.config,
            env=plan.env,
            keywords=plan.keywords,
            training={
                "learner": plan.recipe.learner,
                "seed": plan.seed,
                **({"also": list(plan.also)} if plan.also else {}),
                "steps": int(row["steps"]),
                "traffic seeds": _range(plan.traffic_seeds),
                "validation seeds": _range(plan.validation_seeds),
            },
            figures=figures,
        )

    def _keep(self) -> None:
        """Write learning curve and checkpoint."""
        write_progress(self.folder, self.rows)
        learner, generator = self.learner.state(), torch.get_rng_state()
        content = {
            "update": self.update, "best": self._best, "torch": generator, "errors": self._errors
        }  # fmt: skip
        write_checkpoint(self.folder, {**content, "learner": learner})

    def _resume(self, kept: Mapping[str, Any]) -> None:
        """Restore the state of a checkpoint and the learning curve up to it."""
        self.rows = [row for row in read_progress(self.folder) if row["update"] <= kept["update"]]
        self._best, self._seconds = kept["best"], self.rows[-1]["seconds"]
        self._errors = kept["errors"]
        self.learner.restore(kept["learner"])
        torch.set_rng_state(kept["torch"])
        for row in self.rows:
            for watcher in self._watchers:
                watcher(row)


def _make_learner(
    plan: TrainingPlan,
    keywords: Mapping[str, Any],
    progress: Callable[[str, float], None],
    executor: AnyExecutor,
) -> Learner:
    """Make the learner of the plan's recipe; ``keywords`` are further ones of its environments."""
    recipe = plan.recipe
    if isinstance(recipe, PlackettLuceRecipe):
        return PlackettLuceLearner(plan, recipe, keywords, progress, executor)
    assert isinstance(recipe, PPORecipe)
    return PPOLearner(plan, recipe, keywords)


def _range(seeds: tuple[int, ...]) -> str:
    contiguous = seeds == tuple(range(seeds[0], seeds[0] + len(seeds)))
    return f"{seeds[0]}..{seeds[-1]}" if contiguous else ", ".join(map(str, seeds))
