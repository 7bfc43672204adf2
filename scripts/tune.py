r"""Tune settings of estimators on training traffic, one set per environment and estimator.

dptse tune --env dptse_env:dptse/ShortHighway-v0 --estimators random_walk \
    --seeds 0:2 --trials 4

It writes each set to <output>/<estimator>-<ARZ parameters>-<privacy preset>.json, a file for the
keyword estimator_settings, in Python, after --env or in the table environment of a road file.
A journal beside it keeps the trials: the same command goes on where it stopped, and searches on
with more --trials. With one worker a seed always gives the same trials; with several, later trials
depend on the order in which earlier ones end.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import optuna

from agents.executors import make_executor
from agents.search.space import SPACE, Extra
from agents.search.tuning import Search, chosen, journal_path, tune, write
from agents.terminal import make_table, print_table
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import integer
from scripts.cli import Recording


@dataclass(frozen=True)
class Args(Recording):
    """Tune settings of estimators."""

    env: tuple[str, ...] = ("dptse_env:dptse/PaperHighway-v0",)
    """Environments, each an id or 'id {keywords as JSON}'."""
    estimators: tuple[str, ...] = tuple(SPACE)
    """Estimators to tune."""
    seeds: str = "0:8"
    """Traffic seeds, first:stop; training seeds only."""
    trials: int = 60
    """Trials of each search, those of earlier runs included."""
    schedule: str = "shift-ahead"
    """Query schedule, or a saved policy: its .safetensors file or shipped name."""
    also: tuple[Extra, ...] = ()
    """Settings to search beside the usual ones; 'demand' are demand states with their noise."""
    variant: str = ""
    """Ending of the names of the sets; empty for default sets."""
    seed: int = 0
    """Seeds the search."""
    workers: int = 1
    """Processes that run trials, and record traffic."""
    output: Path = Path("results/tuning")
    """Folder for the sets and the journals."""
    force: bool = False
    """Replace sets in the folder that have no journal there."""


def make_searches(args: Args) -> dict[str, Search]:
    """Return the searches by the names of their sets, all of them checked.

    Raises:
        FileNotFoundError: There is no such saved policy.
        ValueError: An argument is out of range.
    """
    integer("trials", args.trials, 1)
    integer("seed", args.seed, 0)
    searches: dict[str, Search] = {}
    for env, estimator in product(args.env, args.estimators):
        search = Search(
            env, estimator, args.seeds, args.schedule, args.also, args.variant, args.seed,
            args.records,
        )  # fmt: skip
        search.check()
        if search.name in searches:
            raise ValueError(f"{search.name} must be tuned once: give --variant, or run it apart")
        searches[search.name] = search
    if not searches:
        raise ValueError("env and estimators must not be empty")
    return searches


def main(args: Args) -> None:
    """Record what is missing, run the trials that are missing, and write the sets."""
    searches, executor = make_searches(args), make_executor("local", args.workers)
    foreign = [n for n, s in searches.items() if not os.path.lexists(journal_path(s, args.output))]
    require_output(args.output, [f"{name}.json" for name in foreign], force=args.force)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    columns = "set", "settings", "reward", "density RMSE\n[veh/km]", "speed RMSE\n[km/h]"
    table = make_table("scores on the tuning traffic", *columns, left=2)
    found = []
    for name, search in searches.items():
        args.library(search.config.corridor, search.traffic_seeds)
        study = tune(search, args.output, args.trials, executor)
        settings = write(search, study, args.output / f"{name}.json")
        found.append({"estimator": search.estimator, "estimator_settings": settings})
        for label, trial in chosen(study).items():
            errors = [f"{trial.user_attrs[key]:.2f}" for key in ("rmse_density", "rmse_speed")]
            table.add_row(name, label, f"{trial.value:.5f}", *errors)
        table.add_section()
    print_table(table)
    print(f"sets are in {args.output}/; as keywords of the environment:")
    for keywords in found:
        print(json.dumps(keywords))
