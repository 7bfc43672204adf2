r"""Train a query policy in a folder, and go on there after an interruption.

dptse train --env dptse_env:dptse/ShortHighway-v0 \
    --steps 40000 --train-seeds 0:8 --validation-seeds 1000:1004

It writes best.safetensors and policy.safetensors (the policy best in validation, and the last),
progress.csv and curve.png (the learning curve, beside rules), plan.json (the settings) and
checkpoint.pt. The same command goes on from the last checkpoint; plackett-luce with a number of
rounds comes to the same numbers.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from agents.environments import make_config, parse_env
from agents.files import check_plan
from agents.training.plan import TrainingPlan
from agents.training.run import BEST, RULES_FILE, best_rule, least
from agents.training.run_files import read_progress
from agents.training.settings import PlackettLuceSettings, parse_algorithm
from agents.training.training import train, train_all
from dptse_env.config import parse_seeds
from dptse_env.evaluation import WARM_UP
from dptse_env.utils.validation import read_json
from scripts.cli import Command, Environments, Machines, Output, TrainSeeds, ValidationSeeds

MINUTES = 10.0
"""Time of a training where nothing else is given, but for plackett-luce."""


@dataclass(frozen=True, kw_only=True)
class Args(Output, Machines, ValidationSeeds, TrainSeeds, Environments, Command):
    """Train a query policy."""

    env: tuple[str, ...] = ("dptse_env:dptse/ShortHighway-v0",)
    """Environments, each an id or 'ID {JSON}' with keywords; plackett-luce takes several."""
    algorithm: str = "ppo"
    """ppo, maskable-ppo, recurrent-ppo, dqn, qr-dqn or plackett-luce, or 'NAME {JSON}' with
    settings that differ."""
    minutes: float | None = None
    """Time of the processor to train for, 10 by default; plackett-luce has a number of rounds."""
    steps: int | None = None
    """Seconds of traffic to train for, all episodes together, in place of minutes."""
    initial: str | None = None
    """Saved policy for ppo to begin with, such as one by plackett-luce."""
    seed: str = "0"
    """Training seed, or first:stop for several, each in a folder of its own in the output."""
    train_seeds: str = "0:256"
    validation_seeds: str = "1000:1024"
    output: Path = Path("results/training")


def make_plans(args: Args) -> dict[Path, TrainingPlan]:
    """Return the plans that the arguments describe, by their folders.

    Raises:
        FileNotFoundError: There is no such policy to begin with.
        ValueError: An argument is out of range.
    """
    seeds, minutes = parse_seeds(args.seed, "seed"), args.minutes
    roads = [make_config(*parse_env(env)).corridor for env in args.env[:1]]
    n_segments = roads[0].geometry.n_mainline if roads else 0
    algorithm = parse_algorithm(args.algorithm, n_segments)
    if minutes is None and args.steps is None and not isinstance(algorithm, PlackettLuceSettings):
        minutes = MINUTES
    return {
        args.output if len(seeds) == 1 else args.output / str(seed): TrainingPlan(
            args.env,
            algorithm,
            seed,
            parse_seeds(args.train_seeds, "train_seeds"),
            parse_seeds(args.validation_seeds, "validation_seeds"),
            minutes,
            args.steps,
            args.initial,
        )
        for seed in seeds
    }


def main(args: Args) -> None:
    """Record missing traffic, train, and print the errors of the best policies in validation."""
    torch.set_num_threads(1)
    plans = make_plans(args)
    plan = next(iter(plans.values()))
    plan.check()
    for folder, each in plans.items():
        check_plan(folder, each.content())
    executor = args.start_executor()
    for world in plan.worlds:
        args.library(world.config.corridor, (*plan.traffic_seeds, *plan.validation_seeds))
    if len(plans) > 1 or args.executor != "local":
        train_all(plans, executor, records=args.records)
    else:
        train(plan, args.output, records=args.records)
    found: dict[str, Any] = {"trainings": [result(folder) for folder in plans]}
    lines = [in_words(**each) for each in found["trainings"]]
    if len(plan.envs) == 1:
        policies = [str(folder / BEST) for folder in plans]
        words = ["dptse", "evaluate", "--env", plan.envs[0], "--policies", *policies]
        words += ["round-robin", "--reference", found["trainings"][0]["best_rule"]]
        found["next"] = shlex.join(words)
        lines.append(f"compare with rules on unseen traffic: {found['next']}")
    args.answer(found, *lines)


def result(folder: Path) -> dict[str, Any]:
    """Return the best policy of a training, its error in validation, and the best rule's."""
    rule, other = best_rule(read_json(folder / RULES_FILE))
    errors = [least(row) for row in read_progress(folder)]
    return {
        "policy": str(folder / BEST), "error": min(errors), "validations": len(errors),
        "best_rule": rule, "rule_error": other,
    }  # fmt: skip


def in_words(policy: str, error: float, validations: int, best_rule: str, rule_error: float) -> str:
    """Return a `result` as a line of text."""
    share = 100.0 * (1.0 - error / rule_error)
    side = "below" if share >= 0 else "above"
    return (
        f"{policy}: error x 1000 {1000 * error:.1f}, the least of {validations} validations, "
        f"{abs(share):.1f} % {side} the best rule there, {best_rule} ({1000 * rule_error:.1f}), "
        f"without the first {WARM_UP} s"
    )
