"""Train a query policy in a folder.

python scripts/train.py --seed 0 --output results/training/pl-0
python scripts/train.py --seeds 0:5 --workers 2 --output results/training/pl
python scripts/train.py --steps 2000000 --output results/training/maskable-0 recipe:maskable

The folder gets plan.json (the settings), progress.csv (the learning curve), checkpoint.pt,
best.safetensors and policy.safetensors (the policy best in validation, and the last). After an
interruption, or a kill, the same command continues from the last checkpoint to the same numbers;
other arguments need another folder.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro

from agents.environments import parse_env
from agents.training.plan import TrainingPlan
from agents.training.recipes import MaskablePPORecipe, MaskRecipe, PlackettLuceRecipe, ScoresRecipe
from agents.training.run_files import Row, check_plan, read_progress
from agents.training.several_seeds import train_all
from agents.training.training import BEST, POLICY, Training
from dptse_env.config import parse_seeds
from dptse_env.utils.fields import integer
from scripts.cli import Environment, Machines
from scripts.training_bar import Bar, watched

AnyRecipe = (
    Annotated[PlackettLuceRecipe, tyro.conf.subcommand("plackett-luce")]
    | Annotated[MaskablePPORecipe, tyro.conf.subcommand("maskable")]
    | Annotated[ScoresRecipe, tyro.conf.subcommand("scores")]
    | Annotated[MaskRecipe, tyro.conf.subcommand("mask")]
)


@dataclass(frozen=True)
class Args(Environment, Machines):
    """Train a query policy."""

    env: str = "dptse_env:dptse/PrivateHighway-v0"
    """Environment id."""
    seed: int = 0
    """Training seed."""
    seeds: str | None = None
    """Training seeds, first:stop, in place of one: trainings run at once, each in a
    folder of its own in the output, named by its seed."""
    steps: int | None = None
    """Seconds of traffic to train for by PPO, all episodes together, each with one decision;
    2,000,000 if not given. The recipe plackett-luce is trained in rounds and takes none."""
    traffic: str = "0:256"
    """Traffic seeds to train on, first:stop; training seeds only."""
    validation: str = "1000:1024"
    """Traffic seeds to validate on, first:stop; validation seeds only."""
    also: tuple[str, ...] = ()
    """Further environments to train one network in, on the same traffic seeds, each an id or an id,
    a space and keywords as JSON: 'dptse_env:dptse/LongHighway-v0 {"bandwidth": 4}'. For
    plackett-luce."""
    validate_every: int = 25
    """Updates of PPO between two validations."""
    checkpoint_every: int = 10
    """Updates of PPO between two checkpoints."""
    threads: int = 1
    """Threads of torch; numbers depend on it in the last digits."""
    tensorboard: bool = True
    """Write the learning curve for TensorBoard, too, where that is installed."""
    output: Path = Path("results/training")
    """Folder of the training."""
    recipe: AnyRecipe = field(default_factory=PlackettLuceRecipe)
    """Recipe of the training."""


def make_plan(args: Args, seed: int) -> TrainingPlan:
    """Return the plan that the arguments describe, with a training seed.

    Raises:
        ValueError: An argument is out of range.
    """
    env, keywords = parse_env(args.env)
    return TrainingPlan(
        env=env,
        recipe=args.recipe,
        seed=seed,
        steps=args.recipe.default_steps if args.steps is None else args.steps,
        traffic_seeds=parse_seeds(args.traffic, "traffic"),
        validation_seeds=parse_seeds(args.validation, "validation"),
        keywords=keywords,
        also=args.also,
        validate_every=args.validate_every,
        checkpoint_every=args.checkpoint_every,
    )


def summary(row: Row) -> str:
    """Return the errors in validation of a row of the learning curve, in words."""
    errors = row["validation"], row["validation_drawn"]
    return "error in validation {:.4f} deterministic, {:.4f} drawn".format(*errors)


def main(args: Args) -> None:
    """Record missing traffic, train, and leave the policy."""
    torch.set_num_threads(integer("threads", args.threads, 1))
    if args.seeds is None:
        plans = {args.output: make_plan(args, args.seed)}
    else:
        plans = {args.output / str(each): make_plan(args, each) for each in parse_seeds(args.seeds)}
    plan = next(iter(plans.values()))
    plan.check()
    for folder, each in plans.items():
        check_plan(folder, each.content())
    executor = args.start_executor()
    for world in plan.worlds:
        seeds = (*plan.traffic_seeds, *plan.validation_seeds)
        args.library(world.config.corridor, seeds)
    if args.seeds is not None:
        train_all(plans, executor, records=args.records, threads=args.threads)
        for folder in plans:
            print(f"{folder}: {summary(read_progress(folder)[-1])}")
        return
    total = plan.steps_at(plan.n_updates)
    bar = Bar("steps", ("error", "validation"), total, unit="step", unit_scale=True)
    with watched(bar, args.output, args.tensorboard) as watchers:
        training = Training(
            plan,
            args.output,
            records=args.records,
            executor=executor,
            watchers=watchers,
            progress=bar.show,
        )
        training.run()
    print(f"{summary(training.rows[-1])}; {args.output}/{POLICY} and {BEST}")
