"""Tune the estimators' settings on training traffic, one set per configuration.

python scripts/tune.py --estimators ekf ukf --privacy paper corrected --seeds 0:8 --trials-at-once 2

Each set is left in <output>/<estimator>-<ARZ parameters>-<privacy preset>.json, a file that
estimator_settings takes, as a keyword or in the table environment of a road file.

Trials are kept in a journal beside it. After an interruption, or a kill, the same command goes on
where it stopped, and with more --trials it searches on; other arguments need another folder.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path

import optuna
from rich.table import Table
from tqdm import tqdm

from agents.environments import parse_env
from agents.executors import AnyExecutor
from agents.files import refuse_to_replace
from agents.search.space import SPACE
from agents.search.tuning import TuningStudy, journal_path, locked_study, scores_of
from agents.search.tuning_task import TuningTask
from agents.seeds import TUNING
from agents.terminal import make_table, print_table
from dptse_env.model import ARZParameters
from dptse_env.model.parameters import read_parameters
from dptse_env.utils.fields import integer
from scripts.cli import Environment, Machines


@dataclass(frozen=True)
class Args(Environment, Machines):
    """Tune the estimators' settings."""

    estimators: tuple[str, ...] = tuple(SPACE)
    """State estimators."""
    parameters: tuple[str, ...] = ("w99-3lane", "paper")
    """ARZ parameters: names of sets, or JSON files as scripts/calibrate.py writes them."""
    privacy: tuple[str, ...] = ("paper",)
    """Privacy presets."""
    seeds: str = "0:8"
    """Traffic seeds, first:stop; training seeds only."""
    trials: int = 60
    """Trials per configuration, those of earlier runs included."""
    trials_at_once: int = 1
    """Trials that run at once; results depend on the number."""
    schedule: str = "paper"
    """Query schedule, or a saved policy: its .safetensors file or shipped name."""
    bandwidth: int | None = None
    """Most segments to query a second; the environment's own if not given."""
    epsilon: float = 1.0
    """Privacy parameter epsilon."""
    delta: float = 0.05
    """Privacy parameter delta."""
    noise_seed: int = TUNING.start
    """Noise and estimators are seeded with this plus the traffic seed."""
    noise_scale: bool = False
    """Search the scale of the noise of flows or speeds, too, although the mechanism's is known."""
    demand: bool = False
    """Search demand states, too, and the noise that goes with them."""
    speed_cap: bool = False
    """Search the cap of reported speeds, too."""
    variant: str = ""
    """Ending of the names of the sets; empty for default sets."""
    sampler_seed: int = 0
    """Seeds the search."""
    output: Path = Path("results/tuning")
    """Folder for the sets and the journals."""
    force: bool = False
    """Replace sets in the folder that have no journal there."""


def make_tasks(args: Args) -> list[TuningTask]:
    """Return one task per configuration, all of them checked.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: An argument is out of range.
    """
    env, keywords = parse_env(args.env)
    keywords |= {"epsilon": args.epsilon, "delta": args.delta}
    if args.bandwidth is not None:
        keywords["bandwidth"] = args.bandwidth
    integer("trials", args.trials, 1)
    integer("trials_at_once", args.trials_at_once, 1)
    tasks: dict[str, TuningTask] = {}
    for estimator, source, privacy in itertools.product(
        args.estimators, args.parameters, args.privacy
    ):
        parameters: str | ARZParameters = source
        if source.endswith(".json"):
            parameters = read_parameters(source)
        task = TuningTask(
            env=env,
            estimator=estimator,
            parameters=parameters,
            privacy=privacy,
            seeds=args.seeds,
            schedule=args.schedule,
            noise_seed=args.noise_seed,
            with_noise_scale=args.noise_scale,
            with_demand=args.demand,
            with_speed_cap=args.speed_cap,
            variant=args.variant,
            keywords=keywords,
        )
        task.cell().check()
        if task.name in tasks:
            raise ValueError(f"{task.name} must be given once")
        tasks[task.name] = task
    if not tasks:
        raise ValueError("estimators, parameters and privacy must not be empty")
    return list(tasks.values())


def tune(study: TuningStudy, args: Args, executor: AnyExecutor) -> None:
    """Run the trials that a study lacks, with a progress bar."""
    done = study.n_finished()
    with tqdm(
        total=max(args.trials, done), initial=done, desc=study.task.name, unit="trial"
    ) as bar:

        def show() -> None:
            best = study.best()
            if best is not None:
                bar.set_postfix_str(f"best reward {best.value:.5f}", refresh=False)
            bar.update(study.n_finished() - bar.n)

        show()
        study.run(args.trials, executor, args.trials_at_once, show)


def add_rows(table: Table, study: TuningStudy) -> None:
    """Add the scores of a study's default, shipped and tuned settings to the table."""
    best = study.best()
    if best is None:
        raise ValueError(f"{study.task.name}: no trial ran to its end with a finite score")
    trials = {"defaults": study.labelled("defaults"), "shipped": study.labelled("shipped")}
    for label, trial in {**trials, "tuned": best}.items():
        if trial is not None:
            score = scores_of(trial)
            numbers = f"{score['score']:.5f}", f"{score['rmse_density']:.2f}"
            name = study.task.name if label == "defaults" else ""
            table.add_row(name, label, *numbers, f"{score['rmse_speed']:.2f}")
    table.add_section()


def main(args: Args) -> None:
    """Record what is missing, tune every configuration, and leave the sets."""
    tasks = make_tasks(args)
    foreign = [task for task in tasks if not journal_path(task, args.output).exists()]
    refuse_to_replace([args.output / f"{task.name}.json" for task in foreign], args.force)
    executor = args.start_executor()
    args.library(tasks[0].config().corridor, tasks[0].traffic_seeds)
    tasks = [dataclasses.replace(task, records=args.records) for task in tasks]
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    errors = "density RMSE\n[veh/km]", "speed RMSE\n[km/h]"
    table = make_table("scores on the tuning traffic", "set", "settings", "reward", *errors, left=2)
    for task in tasks:
        with locked_study(task, args.output, args.sampler_seed) as study:
            tune(study, args, executor)
            study.write(args.output / f"{task.name}.json")
            add_rows(table, study)
    print_table(table)
    print(
        f"tuned sets are in {args.output}/: take one as estimator_settings, or name it in the "
        "table environment of a road file"
    )
