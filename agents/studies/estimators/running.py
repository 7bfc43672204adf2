"""Running cells of the study of estimators: all traffic seeds of a cell at once."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import run_episodes
from agents.evaluation.honesty import EstimateWatcher, EstimatorScore
from agents.experiments.ledger import Ledger
from agents.experiments.runner import Workplace, make_batch
from agents.experiments.tasks import run_all
from agents.policies import find_policy
from agents.studies.estimators.cell import EstimatorCell
from agents.studies.estimators.linear_stack import fit_stack, write_fits
from agents.studies.estimators.plan import EstimatorDesign
from agents.studies.estimators.tampering import tamper
from agents.studies.estimators.worlds import WORLDS
from dptse_env.config import parse_seeds
from dptse_env.policies import TRANSFERABLE
from dptse_env.traffic import Records

POLICY_SEED = 0
"""Seeds the draws of a schedule."""
FITS = "stack.json"
FIT_SCHEDULES = ("paper", "round-robin", "oldest-first")
"""Schedules on which linear stacks are fitted."""


@dataclass(frozen=True)
class EstimatorTask:
    """A cell on traffic seeds, with everything that a worker needs.

    Attributes:
        keywords: Keywords of ``gym.make`` that make it.
        records: Library of records, or its folder; None for the user's cache.
        threads: Threads that estimate; None for one per core.
    """

    cell: EstimatorCell
    keywords: Mapping[str, Any]
    seeds: tuple[int, ...]
    records: Records
    threads: int | None


def run_missing(
    design: EstimatorDesign, place: Workplace, ledger: Ledger[EstimatorCell, EstimatorScore]
) -> None:
    """Record what traffic is missing, fit the stacks that are missing, and run what is missing."""
    lacking = [cell for cell in design.cells() if ledger.lacking(cell, design.seeds_of(cell))]
    for corridor, seeds in {
        design.config(cell).corridor: design.seeds_of(cell) for cell in lacking
    }.items():
        place.record(corridor, seeds)
    fit_missing(design, place)
    fit = str(place.folder / FITS)
    tasks = [
        EstimatorTask(
            cell, design.keywords(cell, fit), design.seeds_of(cell), place.records, place.threads
        )
        for cell in lacking
    ]
    run_all(tasks, ledger, place.engine, run_cell)


def fit_missing(design: EstimatorDesign, place: Workplace) -> None:
    """Fit the linear stacks that the folder lacks, on training traffic."""
    path, seeds = place.folder / FITS, parse_seeds(design.fit_seeds, "fit_seeds")
    fits = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    worlds = [name for name in design.fitted_worlds if name not in fits]
    for corridor in {design.config(design.cell(name)).corridor for name in worlds}:
        place.record(corridor, seeds)
    for name in worlds:
        fits[name] = fit_stack(WORLDS[name].on(design.road), seeds, FIT_SCHEDULES, place.records)
        write_fits(Path(path), fits)


def run_cell(task: EstimatorTask) -> list[EstimatorScore]:
    """Run a cell on its seeds; a seed gives the traffic and the noise, so cells are paired."""
    cell = task.cell
    with warnings.catch_warnings():
        # Roads and drivers off the training are the point here.
        warnings.filterwarnings("ignore", message=".*values measured or tuned on")
        env = make_batch(cell.place.env, task.keywords, task.seeds, task.records, task.threads)
    policy = find_policy(cell.schedule).load(
        env, allow=TRANSFERABLE if cell.is_learned_policy else (), seed=POLICY_SEED
    )
    if cell.place.tampering:
        tamper(env.process, cell.place.tampering)
    watcher = EstimateWatcher(env.process)
    scores = run_episodes(
        env, policy, traffic_seeds=task.seeds, seeds=task.seeds, on_second=watcher
    )
    return watcher.scores(scores)


def worlds_of(cells: Iterable[EstimatorCell]) -> list[str]:
    """Return the worlds of some cells, each once."""
    return list(dict.fromkeys(cell.world for cell in cells))
