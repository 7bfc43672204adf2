"""Train a query policy in a folder.

python scripts/train.py --seed 0 --output results/training/pl-0
python scripts/train.py --seeds 0:5 --workers 2 --output results/training/pl
python scripts/train.py --steps 2000000 --output results/training/maskable-0 recipe:maskable

The folder gets run.json (the settings), progress.csv (the learning curve), checkpoint.pt,
best.zip and policy.zip (the policy best in validation, and the last). After an interruption, or a
kill, the same command continues from the last checkpoint to the same numbers; other arguments
need another folder.
"""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tqdm import tqdm

from agents.experiments.provenance import check_folder
from agents.experiments.runner import Workplace
from agents.training.plan import TrainingPlan
from agents.training.recipes import MaskablePPORecipe, MaskRecipe, PlackettLuceRecipe, ScoresRecipe
from agents.training.run_files import Row, read_progress
from agents.training.several_seeds import train_all
from agents.training.training import BEST, POLICY, Training
from dptse_env.command_line import TOOLS
from dptse_env.config import parse_seeds
from dptse_env.utils.validation import integer
from scripts.cli import Road, resumable, run
from scripts.training_bar import Bar, watched

AnyRecipe = (
    Annotated[PlackettLuceRecipe, tyro.conf.subcommand("plackett-luce")]
    | Annotated[MaskablePPORecipe, tyro.conf.subcommand("maskable")]
    | Annotated[ScoresRecipe, tyro.conf.subcommand("scores")]
    | Annotated[MaskRecipe, tyro.conf.subcommand("mask")]
)


@dataclass(frozen=True)
class Args(Road):
    """Train a query policy."""

    env: str = "dptse_env:dptse/PrivateHighway-v0"
    """Environment id."""
    seed: int = 0
    """Training seed."""
    seeds: str | None = None
    """Training seeds, first:stop, in place of one: trainings run at once on the engine, each in a
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
        ValueError: An argument is out of range, or ``keywords`` is no JSON object.
    """
    return TrainingPlan(
        env=args.env,
        recipe=args.recipe,
        seed=seed,
        steps=args.recipe.default_steps if args.steps is None else args.steps,
        traffic_seeds=parse_seeds(args.traffic, "traffic"),
        validation_seeds=parse_seeds(args.validation, "validation"),
        keywords=args.given_keywords(),
        also=args.also,
        validate_every=args.validate_every,
        checkpoint_every=args.checkpoint_every,
    )


def commit() -> str | None:
    """Return the git commit of the sources, with "+" appended where files differ; None if none."""
    sources = Path(__file__).parent
    if TOOLS in sources.parents:
        return None  # a repository around an installation is somebody else's
    try:
        head = subprocess.run(
            ["git", "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"],
            cwd=sources, capture_output=True, text=True, check=False,
        )  # fmt: skip
    except FileNotFoundError:
        return None
    return head.stdout.strip() or None


def train_several(args: Args, seeds: Sequence[int], place: Workplace) -> None:
    """Train with several seeds at once, with one bar over all of them."""
    plans = {args.output / str(seed): make_plan(args, seed) for seed in seeds}
    plan = plans[args.output / str(seeds[0])]
    done = dict.fromkeys(plans, 0)
    total = len(plans) * plan.steps_at(plan.n_updates)
    with tqdm(total=total, desc="training", unit="step", unit_scale=True) as bar:

        def on_rows(folder: Path, rows: list[Row]) -> None:
            steps = int(rows[-1]["steps"])
            bar.update(steps - done[folder])
            done[folder] = steps

        train_all(
            plans,
            place.engine,
            records=place.records,
            commit=commit(),
            threads=args.threads,
            on_rows=on_rows,
        )
    for folder in plans:
        print(f"{folder}: {summary(read_progress(folder)[-1])}")


def summary(row: Row) -> str:
    """Return the errors in validation of a row of the learning curve, in words."""
    errors = row["validation"], row["validation_drawn"]
    return "error in validation {:.4f} deterministic, {:.4f} drawn".format(*errors)


@resumable()
def main(args: Args) -> None:
    """Record missing traffic, train, and leave the policy."""
    seeds = (args.seed,) if args.seeds is None else parse_seeds(args.seeds)
    plan = make_plan(args, seeds[0])
    torch.set_num_threads(integer("threads", args.threads, 1))
    place = args.workplace(args.output)
    folders = [args.output] if args.seeds is None else [args.output / str(each) for each in seeds]
    for folder, each in zip(folders, seeds, strict=True):
        check_folder(folder, make_plan(args, each).provenance(None))
    for world in plan.worlds:
        place.record(world.config.corridor, (*plan.traffic_seeds, *plan.validation_seeds))
    if args.seeds is not None:
        train_several(args, seeds, place)
        return
    bar = Bar(
        "steps",
        ("error", "validation"),
        plan.steps_at(plan.n_updates),
        unit="step",
        unit_scale=True,
    )
    with watched(bar, args.output, args.tensorboard) as watchers:
        training = Training(
            plan,
            args.output,
            records=place.records,
            commit=commit(),
            engine=place.engine,
            watchers=watchers,
            progress=bar.show,
        )
        training.run()
    print(f"{summary(training.rows[-1])}; {args.output}/{POLICY} and {BEST}")


if __name__ == "__main__":
    run(main, Args, __doc__)
