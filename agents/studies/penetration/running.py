"""Running cells of the study of penetration: all traffic seeds of a cell at once."""

from __future__ import annotations

import warnings

from agents.evaluation.episodes import EpisodeScore, run_episodes
from agents.experiments.ledger import Ledger
from agents.experiments.runner import EpisodeTask, Workplace, make_batch, missing_tasks
from agents.experiments.tasks import run_all
from agents.studies.penetration.cell import PenetrationCell
from agents.studies.penetration.plan import PenetrationDesign
from dptse_env.schedules import make_schedule

SLOW = "mhe"


def run_missing(
    design: PenetrationDesign, place: Workplace, ledger: Ledger[PenetrationCell, EpisodeScore]
) -> None:
    """Record what traffic is missing, and run what is missing, slow estimators first."""
    place.record(design.configs[0].corridor, design.traffic_seeds)
    tasks = missing_tasks(design, ledger, place.records)
    tasks.sort(key=lambda task: task.cell.estimator != SLOW)
    run_all(tasks, ledger, place.engine, run_cell)


def run_cell(task: EpisodeTask[PenetrationCell]) -> list[EpisodeScore]:
    """Run a cell on its seeds; a seed gives the traffic and the noise, so cells are paired."""
    with warnings.catch_warnings():
        # Detectors stand elsewhere than where settings were tuned.
        warnings.filterwarnings("ignore", message=".*values measured or tuned on")
        env = make_batch(task.env, task.keywords, task.seeds, task.records)
    schedule = make_schedule(task.cell.policy, env)
    return run_episodes(env, schedule, traffic_seeds=task.seeds, seeds=task.seeds)
