r"""Train a query policy in a folder, and go on there after an interruption.

dptse train --env dptse_env:dptse/ShortHighway-v0 --keywords '{"bandwidth": 1}' \
    --steps 40000 --traffic 0:8 --validation 1000:1004

It writes best.safetensors and policy.safetensors (the policy best in validation, and the last),
progress.csv and curve.png (the learning curve, beside rules), plan.json (the settings) and
checkpoint.pt. The same command goes on from the last checkpoint; plackett-luce with a number of
rounds comes to the same numbers.
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from agents.environments import make_config, parse_env
from agents.training.run import BEST, RULES_FILE, least
from agents.training.run_files import Row, check_plan, read_progress
from agents.training.settings import PlackettLuceSettings, TrainingPlan, parse_algorithm
from agents.training.training import train, train_all
from dptse_env.config import parse_seeds
from dptse_env.utils.validation import integer, parse_json, read_json, require
from scripts.cli import Machines

MINUTES = 10.0
"""Time of a training where nothing else is given, but for plackett-luce."""


@dataclass(frozen=True)
class Args(Machines):
    """Train a query policy."""

    env: tuple[str, ...] = ("dptse_env:dptse/PrivateHighway-v1",)
    """Environments, each an id or 'id {JSON}' with keywords; plackett-luce takes several."""
    keywords: str = "{}"
    """Keywords of all environments as JSON, beside their own."""
    algorithm: str = "ppo"
    """ppo, maskable-ppo, recurrent-ppo, dqn, qr-dqn or plackett-luce, or 'name {JSON}' with
    settings that differ, such as 'ppo {"policy": "mlp"}'."""
    minutes: float | None = None
    """Time of the processor to train for, 10 by default; plackett-luce has a number of rounds."""
    steps: int | None = None
    """Seconds of traffic to train for, all episodes together, in place of minutes."""
    initial: str | None = None
    """Saved policy for ppo to begin with, such as one by plackett-luce."""
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
        FileNotFoundError: There is no such policy to begin with.
        ValueError: An argument is out of range.
    """
    seeds, more = parse_seeds(args.seeds), parse_json(args.keywords, "keywords")
    require(isinstance(more, dict), "keywords", "a JSON object", args.keywords)
    envs = [(env, {**more, **own}) for env, own in map(parse_env, args.env)]
    n_segments = make_config(*envs[0]).corridor.geometry.n_mainline if envs else 0
    algorithm, minutes = parse_algorithm(args.algorithm, n_segments), args.minutes
    if minutes is None and args.steps is None and not isinstance(algorithm, PlackettLuceSettings):
        minutes = MINUTES
    return {
        args.output if len(seeds) == 1 else args.output / str(seed): TrainingPlan(
            tuple(f"{env} {json.dumps(keywords)}" if keywords else env for env, keywords in envs),
            algorithm,
            seed,
            parse_seeds(args.traffic, "traffic"),
            parse_seeds(args.validation, "validation"),
            minutes,
            args.steps,
            args.initial,
        )
        for seed in seeds
    }


def main(args: Args) -> None:
    """Record missing traffic, train, and print the errors of the best policies in validation."""
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
        with shown(args.output) as reporters:
            train(plan, args.output, records=args.records, **reporters)
    for folder in plans:
        print(f"{folder / BEST}: {summary(read_progress(folder), best_rule(folder))}")
    if len(plan.envs) == 1:
        policies = [str(folder / BEST) for folder in plans]
        words = ["dptse", "evaluate", "--env", plan.envs[0], "--policies", *policies]
        print(f"compare with rules on unseen traffic: {shlex.join(words)}")


@contextlib.contextmanager
def shown(folder: Path) -> Iterator[dict[str, Any]]:
    """Show a progress bar with the error on validation traffic beside the best rule's.

    Yields the arguments of `train` by which it is told.
    """
    errors: dict[str, str] = {}
    with tqdm(
        total=100,
        desc="training",
        unit="%",
        bar_format="{l_bar}{bar}| {elapsed}<{remaining}{postfix}",
    ) as bar:

        def add(row: Row) -> None:
            rule, error = best_rule(folder)
            errors.update(validation=f"{1000 * least(row):.1f}", **{rule: f"{1000 * error:.1f}"})

        def progress(fraction: float, stage: str) -> None:
            done = round(100 * fraction)
            if not bar.n:  # what was done before says nothing of the pace
                bar.initial = done
            bar.n = done
            bar.set_postfix({**errors, **({"now": stage} if stage else {})})

        yield {"watchers": (add,), "progress": progress}


def best_rule(folder: Path) -> tuple[str, float]:
    """Return the rule of least error in the folder of a training, with its error."""
    rules: dict[str, float] = read_json(folder / RULES_FILE)
    return min(rules.items(), key=lambda each: each[1])


def summary(rows: list[Row], best: tuple[str, float]) -> str:
    """Return the least error in validation of a learning curve, beside that of a rule, in words."""
    error, (rule, other) = min(map(least, rows)), best
    share = 100.0 * (1.0 - error / other)
    return (
        f"error x 1000 in validation {1000 * error:.1f}, {abs(share):.1f} % "
        f"{'below' if share >= 0 else 'above'} the best rule, {rule} ({1000 * other:.1f})"
    )
