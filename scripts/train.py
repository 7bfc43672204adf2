"""Train a query policy in a folder, and go on there after an interruption.

dptse train --env dptse_env:dptse/ShortHighway-v0 --algorithm 'ppo {"steps": 40000}' --traffic 0:8

The folder gets best.safetensors and policy.safetensors (the policy best in validation, and the
last), progress.csv (the learning curve), plan.json (the settings) and checkpoint.pt. The same
command goes on from the last checkpoint, plackett-luce to the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from agents.training.plan import TrainingPlan, parse_algorithm
from agents.training.run import BEST, POLICY
from agents.training.run_files import Row, check_plan, read_progress
from agents.training.training import train, train_all
from dptse_env.config import parse_seeds
from dptse_env.utils.fields import integer
from scripts.cli import Machines
from scripts.training_bar import Bar, watched


@dataclass(frozen=True)
class Args(Machines):
    """Train a query policy."""

    env: tuple[str, ...] = ("dptse_env:dptse/PrivateHighway-v1",)
    """Environments, each an id or 'id {JSON}' with keywords; plackett-luce takes several."""
    algorithm: str = "plackett-luce"
    """plackett-luce, ppo or maskable-ppo, or 'name {JSON}' with settings that differ."""
    seeds: str = "0"
    """Training seed, or first:stop for several, each in a folder of its own in the output."""
    traffic: str = "0:256"
    """Traffic seeds to train on, first:stop, of 0 to 999."""
    validation: str = "1000:1024"
    """Traffic seeds to validate on, first:stop, of 1000 to 1999."""
    threads: int = 1
    """Threads of torch; numbers depend on it in the last digits."""
    output: Path = Path("results/training")
    """Folder of the training."""


def make_plans(args: Args) -> dict[Path, TrainingPlan]:
    """Return the plans that the arguments describe, by their folders.

    Raises:
        ValueError: An argument is out of range.
    """
    seeds = parse_seeds(args.seeds)
    return {
        args.output if len(seeds) == 1 else args.output / str(seed): TrainingPlan(
            args.env,
            parse_algorithm(args.algorithm),
            seed,
            parse_seeds(args.traffic, "traffic"),
            parse_seeds(args.validation, "validation"),
        )
        for seed in seeds
    }


def main(args: Args) -> None:
    """Record missing traffic, train, and print the errors of the last policies in validation."""
    torch.set_num_threads(integer("threads", args.threads, 1))
    plans = make_plans(args)
    plan = next(iter(plans.values()))
    plan.check()
    for folder, each in plans.items():
        check_plan(folder, each.content())
    executor = args.start_executor()
    for world in plan.worlds:
        args.library(world.config.corridor, (*plan.traffic_seeds, *plan.validation_seeds))
    if len(plans) > 1:
        train_all(plans, executor, records=args.records, threads=args.threads)
    else:
        bar = Bar("update", ("error", "validation"), plan.algorithm.n_updates, unit="update")
        with watched(bar, args.output) as watchers:
            train(plan, args.output, records=args.records, watchers=watchers, progress=bar.show)
    for folder in plans:
        print(f"{folder}: {summary(read_progress(folder))}; {POLICY} and {BEST}")


def summary(rows: list[Row]) -> str:
    """Return the errors in validation at the end of a learning curve, and the least, in words."""
    last, least = rows[-1], min(row["validation"] for row in rows if "validation" in row)
    return (
        f"error x 1000 in validation {1000 * last['validation']:.1f}, drawn "
        f"{1000 * last['validation_drawn']:.1f}, best {1000 * least:.1f}"
    )
