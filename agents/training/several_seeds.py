"""Several trainings at once on an engine, each handed from worker to worker at its checkpoints.

A worker trains for some minutes in a folder of its own, and returns the folder's files at the next
checkpoint; whichever worker is free goes on from there. A worker or a machine that is lost
therefore costs a training what it had done since the last checkpoint, and nothing else.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from agents.engines.engine import Engine, Workers
from agents.experiments.provenance import PROVENANCE_FILE, check_folder
from agents.files import write_atomically
from agents.training.plan import TrainingPlan
from agents.training.run_files import CHECKPOINT, PROGRESS, Row, read_checkpoint, read_progress
from agents.training.training import BEST, POLICY, Training
from dptse_env.traffic import Records

STRETCH_SECONDS = 120.0
"""Time [s] after which a worker hands a training on, at the next checkpoint."""

_FILES = PROVENANCE_FILE, BEST, POLICY, PROGRESS, CHECKPOINT
"""Files of a training, in the order in which they are written: the checkpoint agrees with them."""


@dataclass(frozen=True)
class Stretch:
    """Some updates of a training, with everything that a worker needs to do them.

    Attributes:
        files: Content of the training's files so far, by name.
        commit: State of the sources, for the record.
        threads: Threads of torch.
        seconds: Time after which the training is handed on, at the next checkpoint.
    """

    plan: TrainingPlan
    files: Mapping[str, bytes]
    records: Records
    commit: str | None
    threads: int
    seconds: float = STRETCH_SECONDS


def run_stretch(stretch: Stretch) -> tuple[bool, dict[str, bytes]]:
    """Go on with a training; return whether it is finished, and its files."""
    torch.set_num_threads(stretch.threads)
    with tempfile.TemporaryDirectory(prefix="dptse-training-") as name:
        folder = Path(name)
        _write(folder, stretch.files)
        training = Training(stretch.plan, folder, records=stretch.records, commit=stretch.commit)
        is_finished = training.run(stretch.seconds)
        return is_finished, _read(folder)


def train_all(
    plans: Mapping[Path, TrainingPlan],
    engine: Engine,
    *,
    records: Records,
    commit: str | None = None,
    threads: int = 1,
    on_rows: Callable[[Path, list[Row]], None] = lambda folder, rows: None,
    seconds: float = STRETCH_SECONDS,
) -> None:
    """Train every plan in its folder to the end; what the folders have is gone on with.

    Args:
        plans: Plans by folder; folders are made where they are missing.
        engine: Runs the trainings.
        records: Library of records, as tasks take it along.
        commit: State of the sources, for the record.
        threads: Threads of torch in each training; numbers depend on it in the last digits.
        on_rows: Called with a folder and the learning curve in it, whenever it has grown.
        seconds: Time after which a worker hands a training on, at the next checkpoint.

    Raises:
        ValueError: A folder belongs to another plan, or its checkpoint is damaged.
        OSError: A folder cannot be written.
    """
    for folder, plan in plans.items():
        read_checkpoint(folder)
        check_folder(folder, plan.provenance(commit))
        folder.mkdir(parents=True, exist_ok=True)
    with engine.open() as workers:
        running = {}
        for folder, plan in plans.items():
            stretch = Stretch(plan, _read(folder), records, commit, threads, seconds)
            running[_begin(workers, stretch)] = folder, stretch
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                folder, stretch = running.pop(future)
                is_finished, files = future.result()
                _write(folder, files)
                on_rows(folder, read_progress(folder))
                if not is_finished:
                    stretch = replace(stretch, files=files)
                    running[_begin(workers, stretch)] = folder, stretch


def _begin(workers: Workers, stretch: Stretch) -> Future[tuple[bool, dict[str, bytes]]]:
    return workers.submit(run_stretch, stretch)


def _read(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in _FILES if (folder / name).exists()}


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    for name in _FILES:
        if name in files:
            write_atomically(folder / name, files[name])
