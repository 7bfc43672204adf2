"""`Run`: a training in its folder: checkpoints, learning curve, validation, policies."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy

from agents.environments import make_vector
from agents.seeds import TRAINING_VALIDATION
from agents.training.plan import TrainingPlan
from agents.training.run_files import (
    Row,
    keep_plan,
    read_checkpoint,
    write_checkpoint,
    write_progress,
)
from dptse_env.evaluation import evaluate
from dptse_env.parts import make_interface
from dptse_env.sb3.saved import ActingPolicy, save_policy
from dptse_env.traffic import Records
from dptse_env.vector_env import SensorQueryVectorEnv

POLICY, BEST = "policy.safetensors", "best.safetensors"
"""The last policy, and the one of least error in validation."""

Watcher = Callable[[Row], None]
"""Receives every row of the learning curve as it comes."""

Progress = Callable[[str, float], None]
"""Called between two rows with the name of a stage and the fraction of it that is done."""


class Run:
    """A training in its folder. A checkpoint has the curve up to it, so that the two agree.

    Attributes:
        plan: The plan.
        rows: The learning curve so far.
        checkpoint: What `keep` was given last, by an earlier process; None where there was none.
        keywords: Further keywords of all environments that are trained in.
        progress: Told of stages.
    """

    def __init__(
        self,
        plan: TrainingPlan,
        folder: Path,
        records: Records,
        watchers: Sequence[Watcher],
        progress: Progress,
    ) -> None:
        """Take the folder, and read what it has; the arguments are those of `train`.

        Raises:
            ValueError: The folder belongs to another plan, or its checkpoint is damaged.
            OSError: The folder cannot be written.
        """
        content = plan.content()
        self.checkpoint = read_checkpoint(folder)  # may refuse it; nothing is written then
        keep_plan(folder, content)
        self.plan, self.progress = plan, progress
        self.keywords: dict[str, Any] = {
            "records": records,
            "action": plan.algorithm.action,
            "traffic_seeds": list(plan.traffic_seeds),
        }
        self._folder, self._watchers = folder, watchers
        self.rows: list[Row] = []
        for row in self.checkpoint["rows"] if self.checkpoint else ():
            self._append(row)
        known = [row["validation"] for row in self.rows if "validation" in row]
        self._best = min(known, default=np.inf)
        self._begun = time.perf_counter() - (self.rows[-1]["seconds"] if self.rows else 0.0)

    def add(self, update: int, steps: int, values: Row) -> None:
        """Add a row to the curve.

        Args:
            update: Number of updates, or of rounds, that are done.
            steps: Seconds of traffic that were simulated for them, all environments together.
            values: Further columns.
        """
        seconds = round(time.perf_counter() - self._begun, 1)
        self._append({"update": update, "steps": steps, "seconds": seconds, **values})

    def validate(self, policies: Sequence[BasePolicy], steps: int) -> Row:
        """Return errors on validation traffic; save the first policy where they are the least yet.

        An error is minus the mean reward of a second after the warm-up: for the joint reward the
        normalised RMSE of density and speed together. Several environments count alike. Draws of
        torch are seeded, and its generator is left as found.
        """
        row: Row = {"steps": steps}
        for column, deterministic in (("validation", True), ("validation_drawn", False)):
            errors = [
                self._error(env, policy, deterministic)
                for env, policy in zip(self._environments, policies, strict=True)
            ]
            row[column] = float(np.mean(errors))
            if len(errors) > 1:
                names = [f"{column} in {world}" for world in self.plan.worlds]
                row |= dict(zip(names, errors, strict=True))
        if row["validation"] < self._best:
            self._best = row["validation"]
            self.save(BEST, policies[0], row)
        return row

    def keep(self, **content: Any) -> None:
        """Write a checkpoint of tensors, numbers and strings, and the curve.

        Raises:
            OSError: The disk is full or cannot be written; the last checkpoint stays.
        """
        write_checkpoint(self._folder, {"rows": self.rows, **content})
        write_progress(self._folder, self.rows)

    def save(self, name: str, policy: BasePolicy, row: Row) -> None:
        """Write a policy with the seconds of traffic and the errors of its row of the curve."""
        plan, world = self.plan, self.plan.worlds[0]
        save_policy(
            self._folder / name,
            policy,
            world.config,
            env=world.env,
            keywords=world.keywords,
            training={
                "learner": plan.algorithm.name,
                "seed": plan.seed,
                "also": list(plan.envs[1:]),
                "steps": int(row["steps"]),
                "traffic seeds": _range(plan.traffic_seeds),
                "validation seeds": _range(plan.validation_seeds),
            },
            figures={key: row[key] for key in row if key.startswith("validation")},
        )

    def _append(self, row: Row) -> None:
        self.rows.append(row)
        for watcher in self._watchers:
            watcher(row)

    @cached_property
    def _environments(self) -> list[SensorQueryVectorEnv]:
        seeds = list(self.plan.validation_seeds)
        keywords = {**self.keywords, "traffic_seeds": seeds}
        return [
            make_vector(world.env, len(seeds), {**world.keywords, **keywords})
            for world in self.plan.worlds
        ]

    def _error(self, env: SensorQueryVectorEnv, policy: BasePolicy, deterministic: bool) -> float:
        acting = ActingPolicy(policy, make_interface(env.config))
        seeds, noise = self.plan.validation_seeds, TRAINING_VALIDATION.start
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(noise)
            rows = evaluate(env, acting, seeds, noise, deterministic=deterministic)
        return -float(np.mean([row["reward"] for row in rows]))


def _range(seeds: tuple[int, ...]) -> str:
    contiguous = seeds == tuple(range(seeds[0], seeds[0] + len(seeds)))
    return f"{seeds[0]}..{seeds[-1]}" if contiguous else ", ".join(map(str, seeds))
