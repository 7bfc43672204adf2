r"""Train recurrent networks as an estimator, for releases of flows and of speeds.

dptse train-estimator --env dptse_env:dptse/ShortHighway-v0 --seed 0 --rounds own:2:4 \
    --validation-env dptse_env:dptse/ShortHighway-v0 --train-seeds 0:2 --validation-seeds 1000 \
    --plan '{"ranges": {"highways": [0, 2]}, "validation_highways": [1000, 1001]}'

Each kind and seed is a training in a folder of its own, with progress.csv (the learning curve),
plan.json (the settings) and checkpoint.pt. Where several begin with the same weights, the mean of
their ends is one more. The best weights on validation traffic become weights-flows.safetensors and
weights-speeds.safetensors, a pair that the printed keywords take. The same command goes on.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from agents.environments import make_config, parse_env, quietly
from agents.executors import Executor, run_in_order, this_process
from agents.files import PLAN, check_plan
from agents.filters.highways import Kind as HighwayKind
from agents.filters.highways import draw_highway
from agents.filters.plan import FilterPlan, Round, played_by
from agents.filters.scenarios import Kind, ScenarioRanges
from agents.filters.training import WEIGHTS, FilterTraining, write_mean
from agents.play import record
from agents.terminal import make_table
from agents.training.run_files import Row
from dptse_env.config import parse_seeds
from dptse_env.estimators.recurrent import member_for, read_weights
from dptse_env.utils.files import replacing, require_output
from dptse_env.utils.validation import from_mapping, parse_json, require, within
from scripts.cli import Command, Environments, Machines, Output, TrainSeeds, ValidationSeeds

NAME, MEAN = "weights", "mean"
"""Names of the pair of weights in the output folder, and of the mean in place of a seed."""
CONTINUED: dict[str, Any] = {"learning_rate": 1e-3, "teacher": 0.5, "checkpoint_every": 160}
"""Fields of a plan that begins with trained weights."""
TEACHER = "highway"
"""Pair of weights that teaches where `roads` are the initial ones."""


@dataclass(frozen=True, kw_only=True)
class Args(Output, Machines, ValidationSeeds, TrainSeeds, Environments, Command):
    """Train recurrent networks as an estimator."""

    kinds: tuple[Kind, ...] = ("flows", "speeds")
    """Kinds of releases: flows (capped, paced), or speeds (printed, corrected)."""
    env: tuple[str, ...] = ()
    """Environments to train in, each an id or 'ID {JSON}' with keywords, beside sections of
    random highways; nine roads if not given."""
    validation_env: tuple[str, ...] = ()
    """Environments to validate in, with a round robin, beside sections of other highways."""
    rounds: tuple[str, ...] = ("own:96:80",) * 4
    """Rounds as estimator:scenarios:passes; 'own' is the network that is trained."""
    initial: str | None = "roads"
    """Pair of weights to begin with, which also teaches; None for random ones."""
    plan: str = "{}"
    """Further fields of the plan (agents/filters/plan.py) as JSON."""
    seed: str = "0:4"
    """Training seeds, first:stop."""
    train_seeds: str = "0:32"
    validation_seeds: str = "1000:1008"
    output: Path = Path("results/weights")


Task = tuple[FilterPlan, Path]
"""A training and its folder."""


def parse_round(text: str) -> Round:
    """Return a round, given as estimator:scenarios:passes.

    Raises:
        ValueError: The text has another form, or a number is out of range.
    """
    parts = text.split(":")
    if len(parts) != 3 or not all(part.isdecimal() for part in parts[1:]):
        raise ValueError(f"rounds must be like 'ekf:72:200', got {text!r}")
    return Round(parts[0], int(parts[1]), int(parts[2]))


def make_plan(args: Args, kind: Kind, seed: int) -> FilterPlan:
    """Return the plan that the arguments describe.

    Raises:
        ValueError: An argument is out of range.
    """
    traffic, initial = parse_seeds(args.train_seeds, "train_seeds"), None
    width, continued = FilterPlan.width, {}
    if args.initial is not None:
        initial, continued = member_for(args.initial, kind == "flows"), {**CONTINUED}
        if args.initial == Args.initial:
            continued["teacher_weights"] = member_for(TEACHER, kind == "flows")
        with within("initial: "):
            width = read_weights(initial).weights.width
    ranges = ScenarioRanges(envs=args.env) if args.env else ScenarioRanges()
    with quietly():
        roads = [make_config(*parse_env(each)).corridor for each in ranges.envs]
    plan = FilterPlan(
        kind=kind,
        seed=seed,
        traffic_seeds=traffic,
        validation_seeds=parse_seeds(args.validation_seeds, "validation_seeds"),
        validation_envs=args.validation_env,
        ranges=ranges,
        rounds=tuple(parse_round(each) for each in args.rounds),
        width=width,
        windows=min(FilterPlan.windows, len(traffic)),
        seconds=min(FilterPlan.seconds, *(road.conditions.duration for road in roads)),
        initial=initial,
        **continued,
    )
    return from_mapping(FilterPlan, parse_json(args.plan, "plan"), "plan", plan)


def main(args: Args) -> None:
    """Record missing traffic, train, and print the keywords that take the weights."""
    seeds = parse_seeds(args.seed, "seed")
    require(bool(args.kinds), "kinds", "one or more", args.kinds)
    plans = {kind: make_plan(args, kind, seeds[0]) for kind in args.kinds}
    tasks = [
        (replace(plan, seed=seed), args.output / f"{kind}-{seed}")
        for kind, plan in plans.items()
        for seed in seeds
    ]
    for plan in plans.values():
        plan.check()
    for plan, folder in tasks:
        check_plan(folder, plan.settings())
    own = [f"{folder.name}/{PLAN}" for _, folder in tasks]
    require_output(args.output, [f"{NAME}-{kind}.safetensors" for kind in plans], own=own)
    executor = args.start_executor()
    record_all(args, plans.values(), executor)
    if len(tasks) == 1:  # the workers then play its scenarios
        last = [train(tasks[0], args.records, executor)]
    else:
        work = partial(train, records=args.records)
        last = run_in_order(executor, work, tasks, desc="trainings", unit="training")
    columns = ("validation", "sections", "chi2")
    trainings = {
        folder.name: {name: row[name] for name in columns if name in row}
        for (_, folder), row in zip(tasks, last, strict=True)
    }
    for kind, plan in plans.items():
        if plan.initial is not None and len(seeds) > 1:
            folders = [args.output / f"{kind}-{seed}" for seed in seeds]
            trainings[f"{kind}-{MEAN}"] = average(plan, folders, args.records)
    table = make_table("on validation traffic", "training", "error x 1000", "on sections", "chi2")
    for training, row in trainings.items():
        errors = [f"{1000 * row[name]:.1f}" if name in row else "" for name in columns[:2]]
        table.add_row(training, *errors, f"{row['chi2']:.2f}")
    for kind in plans:
        names = [name for name in trainings if name.startswith(f"{kind}-")]
        best = min(names, key=lambda name: trainings[name]["validation"])
        with replacing(args.output / f"{NAME}-{kind}.safetensors") as temporary:
            shutil.copyfile(args.output / best / WEIGHTS, temporary)
    keywords = played_by(args.output / NAME)
    args.answer(
        {"trainings": trainings, "keywords": keywords},
        table, "as keywords of an environment:", json.dumps(keywords),
    )  # fmt: skip


def train(task: Task, records: Path | None, executor: Executor = this_process) -> Row:
    """Run a training to its end, and return the last row of its learning curve."""
    plan, folder = task
    torch.set_num_threads(1)
    training = FilterTraining(plan, folder, records=records, executor=executor)
    training.run()
    return training.rows[-1]


def average(plan: FilterPlan, folders: Sequence[Path], records: Path | None) -> Row:
    """Write the mean of trainings to a folder beside theirs, and return its validation."""
    folder = folders[0].with_name(f"{plan.kind}-{MEAN}")
    folder.mkdir(exist_ok=True)
    write_mean(folder / WEIGHTS, folders)
    return FilterTraining(plan, folders[0], records=records).validate(folder / WEIGHTS)


def record_all(args: Args, plans: Iterable[FilterPlan], executor: Executor) -> None:
    """Record the traffic of the environments and highways of plans that is missing."""
    highways: set[tuple[HighwayKind, int]] = set()
    for plan in plans:
        highways.update(plan.highways())
        trained = plan.ranges.envs, plan.traffic_seeds
        for envs, seeds in (trained, (plan.validation_envs, plan.validation_seeds)):
            for env in envs:
                with quietly():
                    corridor = make_config(*parse_env(env)).corridor
                args.library(corridor, seeds)
    work = partial(record_highway, records=args.records)
    run_in_order(executor, work, sorted(highways), desc="highways", unit="record")


def record_highway(highway: tuple[HighwayKind, int], records: Path | None) -> None:
    """Record a highway if it is missing."""
    kind, number = highway
    record(draw_highway(number, kind).corridor, [0], records, workers=1)
