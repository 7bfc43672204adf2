"""Running cells of the study of choices: all traffic seeds of a cell at once."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agents.evaluation.episodes import EpisodeScore, run_episodes
from agents.experiments.ledger import Ledger
from agents.experiments.runner import Workplace, make_batch
from agents.experiments.tasks import run_all
from agents.policies import find_policy
from agents.studies.choices.cell import ChoiceCell
from agents.studies.choices.plan import ChoiceDesign
from dptse_env.policies import TRANSFERABLE
from dptse_env.traffic import Records

POLICY_SEED = 0
"""Seeds the draws of a schedule."""


@dataclass(frozen=True)
class ChoiceTask:
    """A cell on traffic seeds, with everything that a worker needs.

    Attributes:
        keywords: Keywords of ``gym.make`` that make it.
        records: Library of records, or its folder; None for the user's cache.
    """

    cell: ChoiceCell
    keywords: Mapping[str, Any]
    seeds: tuple[int, ...]
    records: Records


def run_missing(
    design: ChoiceDesign, place: Workplace, ledger: Ledger[ChoiceCell, EpisodeScore]
) -> None:
    """Record what traffic is missing, and run what is missing, the long road first."""
    lacking = [cell for cell in design.cells() if ledger.lacking(cell, design.seeds_of(cell))]
    for corridor, seeds in {
        design.config(cell).corridor: design.seeds_of(cell) for cell in lacking
    }.items():
        place.record(corridor, seeds)
    tasks = [
        ChoiceTask(cell, cell.keywords, design.seeds_of(cell), place.records) for cell in lacking
    ]
    tasks.sort(key=lambda task: task.cell.share)  # a small share of the road: a long one
    run_all(tasks, ledger, place.engine, run_cell)


def run_cell(task: ChoiceTask) -> list[EpisodeScore]:
    """Run a cell on its seeds; a seed gives the traffic and the noise, so cells are paired."""
    with warnings.catch_warnings():
        # Other drivers are the point of some cells.
        warnings.filterwarnings("ignore", message=".*values measured or tuned on")
        env = make_batch(task.cell.env, task.keywords, task.seeds, task.records)
    policy = find_policy(task.cell.policy).load(env, allow=TRANSFERABLE, seed=POLICY_SEED)
    return run_episodes(env, policy, traffic_seeds=task.seeds, seeds=task.seeds)
