"""`Run`: a training in its folder: checkpoints, learning curve, validation, policies."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecNormalize

from agents.environments import heading, make_vector
from agents.figures import COLOURS, draw_rules, finish_figure, make_figure, save_figure
from agents.files import write_json
from agents.play import Cell, play
from agents.seeds import TRAINING_VALIDATION
from agents.training.plan import TrainingPlan
from agents.training.run_files import Row, TrainingFolder
from agents.training.settings import PlackettLuceSettings
from dptse_env.evaluation import evaluate
from dptse_env.policies import seed_ranges
from dptse_env.sb3 import ActingPolicy, save_policy
from dptse_env.traffic import Records
from dptse_env.utils.progress import make_bar
from dptse_env.utils.validation import read_json, require
from dptse_env.vector_env import SensorQueryVectorEnv

POLICY, BEST = "policy.safetensors", "best.safetensors"
"""The last policy, and the one of least error in validation."""

CURVE, RULES_FILE = "curve.png", "rules.json"

RULES = (
    "round-robin", "stale-variance", "largest-deviation", "speed-front", "expected-reduction",
)  # fmt: skip
"""Rules whose errors on validation traffic a training is shown beside."""


class Run(TrainingFolder):
    """The training of a policy.

    Attributes:
        plan: The plan.
        keywords: Further keywords of all environments that are trained in.
        bar: Shows how much of the training is done, and the last error beside the best rule's.
        rules: Errors of rules on validation traffic, by name.
    """

    def __init__(self, plan: TrainingPlan, folder: Path, records: Records) -> None:
        """Take a folder, and play the rules; see `TrainingFolder` and `train`."""
        super().__init__(folder, plan.content())
        self.plan = plan
        self.keywords: dict[str, Any] = {
            "records": records,
            "action": plan.algorithm.action,
            "traffic_seeds": list(plan.traffic_seeds),
        }
        self.rules = keep_rules(plan, folder, records)
        self._best = min(map(least, self.rows), default=np.inf)
        # The clock of the training starts when the rules have been played. It is that of the
        # processor, so that what else runs on a machine takes nothing from a training.
        self._begun = time.process_time() - (self.rows[-1]["seconds"] if self.rows else 0.0)
        look = "{l_bar}{bar}| {elapsed}<{remaining}{postfix}"
        # What was done before says nothing of the pace.
        before = round(100 * self.done(self.steps))
        self.bar = make_bar(100, desc="training", unit="%", bar_format=look, initial=before)

    @property
    def steps(self) -> int:
        """Seconds of traffic that were simulated up to the last row."""
        return int(self.rows[-1]["steps"]) if self.rows else 0

    def done(self, steps: int) -> float:
        """Return the fraction of the training that is done, by minutes, by steps or by rounds."""
        if self.plan.minutes is not None:
            return min((time.process_time() - self._begun) / (60.0 * self.plan.minutes), 1.0)
        if isinstance(self.plan.algorithm, PlackettLuceSettings):
            return len(self.rows) / (self.plan.algorithm.swaps.rounds + 1)
        assert self.plan.steps is not None
        return min(steps / self.plan.steps, 1.0)

    def show(self, steps: int) -> None:
        """Show how much of the training is done."""
        errors = dict([best_rule(self.rules)])
        if self.rows:
            errors["validation"] = least(self.rows[-1])
        self.bar.n = round(100 * self.done(steps))
        self.bar.set_postfix({name: f"{1000 * error:.1f}" for name, error in errors.items()})

    def add(self, steps: int, values: Row) -> None:
        """Add a row to the curve.

        Args:
            steps: Seconds of traffic that were simulated for it, all environments together.
            values: Further columns.
        """
        seconds = round(time.process_time() - self._begun, 1)
        row = {"update": len(self.rows), "steps": steps, "seconds": seconds, **values}
        self.append(row)
        self.show(steps)

    def validate(
        self, policies: Sequence[BasePolicy], steps: int, scaled: VecNormalize | None = None
    ) -> Row:
        """Return errors on validation traffic; save the first policy, as the best if it is.

        An error is minus the mean reward of a second after the warm-up: for the joint reward the
        normalised RMSE of density and speed together. Several environments count alike. Draws of
        torch are seeded, and its generator is left as found.

        Args:
            policies: Of the environments of the plan.
            steps: Seconds of traffic that they were trained for.
            scaled: Has the statistics of their observations.
        """
        row: Row = {"steps": steps}
        for column, deterministic in (("validation", True), ("validation_drawn", False)):
            errors = [
                self._error(env, policy, deterministic, scaled)
                for env, policy in zip(self._environments, policies, strict=True)
            ]
            row[column] = float(np.mean(errors))
            if len(errors) > 1:
                names = [f"{column} in {world}" for world in self.plan.worlds]
                row |= dict(zip(names, errors, strict=True))
        self._save(POLICY, policies[0], row, scaled)
        if least(row) < self._best:
            self._best = least(row)
            self._save(BEST, policies[0], row, scaled)
        return row

    def finish(self) -> None:
        """Write the curve, and draw it with the rules as lines."""
        self.write_curve()
        world = self.plan.worlds[0]
        headed = heading(world.env, world.keywords)
        title = f"{self.plan.algorithm.name}, validation: {headed}"
        save_figure(draw_curve(self.rows, self.rules), self.folder / CURVE, title)

    def _save(self, name: str, policy: BasePolicy, row: Row, scaled: VecNormalize | None) -> None:
        """Write a policy with the seconds of traffic and the errors of its row of the curve.

        It acts by its likeliest actions or draws them, whichever erred less.
        """
        plan, world = self.plan, self.plan.worlds[0]
        save_policy(
            self.folder / name,
            policy,
            world.config,
            env=world.env,
            keywords=world.keywords,
            training={
                "learner": plan.algorithm.name,
                "seed": plan.seed,
                "also": list(plan.envs[1:]),
                "steps": int(row["steps"]),
                "traffic seeds": seed_ranges(plan.traffic_seeds),
                "validation seeds": seed_ranges(plan.validation_seeds),
            },
            figures={key: row[key] for key in row if key.startswith("validation")},
            normalisation=scaled,
            deterministic=row["validation"] <= row["validation_drawn"],
        )

    @cached_property
    def _environments(self) -> list[SensorQueryVectorEnv]:
        seeds = list(self.plan.validation_seeds)
        keywords = {**self.keywords, "traffic_seeds": seeds}
        return [
            make_vector(world.env, len(seeds), {**world.keywords, **keywords})
            for world in self.plan.worlds
        ]

    def _error(
        self,
        env: SensorQueryVectorEnv,
        policy: BasePolicy,
        deterministic: bool,
        scaled: VecNormalize | None,
    ) -> float:
        acting = ActingPolicy(policy, env.interface, normalisation=scaled)
        seeds, noise = self.plan.validation_seeds, TRAINING_VALIDATION.start
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(noise)
            rows = evaluate(env, acting, seeds, noise, deterministic=deterministic)
        return -float(np.mean([row["reward"] for row in rows]))


def least(row: Row) -> float:
    """Return the smaller error of a row: of likeliest actions, or of drawn ones."""
    return min(row["validation"], row["validation_drawn"])


def best_rule(rules: Mapping[str, float]) -> tuple[str, float]:
    """Return the rule of least error, with its error."""
    return min(rules.items(), key=lambda each: each[1])


def keep_rules(plan: TrainingPlan, folder: Path, records: Records) -> dict[str, float]:
    """Return the errors of `RULES` on validation traffic, which are played once for a folder.

    A rule that does not suit an environment, such as one for single segments, is left out.

    Raises:
        ValueError: The folder's file of them is damaged.
    """
    path = folder / RULES_FILE
    if path.exists():
        kept: dict[str, float] = read_json(path)
        require(isinstance(kept, dict) and len(kept) > 0, str(path), "errors by rule", kept)
        return kept
    errors: dict[str, float] = {}
    with make_bar(len(RULES), desc="rules", unit="rule", leave=False) as bar:
        for rule in RULES:
            cells = [
                Cell(world.env, rule, world.keywords, noise_seed=TRAINING_VALIDATION.start)
                for world in plan.worlds
            ]
            if all(cell.misfit() is None for cell in cells):
                played = [play(cell, plan.validation_seeds, records) for cell in cells]
                errors[rule] = -float(np.mean([[row["reward"] for row in rows] for rows in played]))
            bar.update()
    write_json(path, errors)
    return errors


def draw_curve(rows: Sequence[Row], rules: Mapping[str, float]) -> Figure:
    """Draw errors on validation traffic over the seconds of traffic that were simulated."""
    figure = make_figure(6.4, 4.0)
    axis = figure.subplots()
    steps = [row["steps"] for row in rows]
    columns = (("validation", "likeliest actions"), ("validation_drawn", "drawn actions"))
    for (column, label), colour in zip(columns, COLOURS, strict=False):
        errors = [1000.0 * row[column] for row in rows]
        axis.plot(steps, errors, color=colour, label=label, marker=".")
    draw_rules(axis, {rule: 1000.0 * error for rule, error in rules.items()})
    # What an untrained policy takes for likeliest may err far more than anything else.
    shown = [1000.0 * each for each in (*rules.values(), *map(least, rows))]
    margin = 0.1 * (max(shown) - min(shown))
    axis.set_ylim(min(shown) - margin, max(shown) + margin)
    axis.set_xlabel("seconds of traffic", fontsize=9)
    axis.set_ylabel("error x 1000", fontsize=9)
    return finish_figure(figure)
