"""Several trainings at once on an executor, each in a folder of its own.

A worker trains in the folder itself. Where it is lost, the executor runs its task again, and the
training goes on from its last checkpoint.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch

from agents.executors import AnyExecutor, ExecutorError, run_shown
from agents.play import record
from agents.training.plan import TrainingPlan
from agents.training.run_files import check_plan, read_checkpoint
from agents.training.training import POLICY, Training
from dptse_env.traffic import Records


class TrainingTask(NamedTuple):
    """A training, with everything that a worker needs.

    Attributes:
        threads: Threads of torch.
    """

    plan: TrainingPlan
    folder: Path
    records: Records
    threads: int


def run_training(task: TrainingTask) -> None:
    """Train to the end of the plan, from the checkpoint in the folder if there is one."""
    torch.set_num_threads(task.threads)
    plan = task.plan
    for world in plan.worlds:
        seeds = (*plan.traffic_seeds, *plan.validation_seeds)
        record(world.config.corridor, seeds, task.records)
    Training(task.plan, task.folder, records=task.records).run()


def train_all(
    plans: Mapping[Path, TrainingPlan],
    executor: AnyExecutor,
    *,
    records: Records,
    threads: int = 1,
    progress: bool = True,
) -> None:
    """Train every plan in its folder to the end; what the folders have is gone on with.

    Args:
        plans: Plans by folder; folders are made where they are missing. Nodes of a cluster have to
            share them.
        executor: Runs the trainings.
        records: Library of records, or its folder; None for the user's cache.
        threads: Threads of torch in each training; numbers depend on it in the last digits.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: A folder belongs to another plan, or its checkpoint is damaged.
        OSError: A folder cannot be written.
        ExecutorError: Workers died again and again, or write to other disks than this machine's.
    """
    for folder, plan in plans.items():
        read_checkpoint(folder)
        check_plan(folder, plan.content())
    tasks = [
        TrainingTask(plan, folder.absolute(), records, threads) for folder, plan in plans.items()
    ]

    def take(task: TrainingTask, _: None) -> None:
        if not (task.folder / POLICY).exists():
            raise ExecutorError(
                f"a worker has trained in {task.folder}, which is not on a disk that it shares "
                "with this machine: choose an --output that all nodes have"
            )

    run_shown(
        executor, run_training, tasks, take, progress=progress, desc="training", unit="training"
    )
