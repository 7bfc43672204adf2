"""Trainings of the study of policies: every learner for the same time, in folders that go on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import polars as pl

from agents.files import check_plan
from agents.play import Cell, record
from agents.studies.policies import (
    CURVES,
    LEARNERS,
    PLACKETT_LUCE,
    SETTINGS,
    STARTED,
    ranked_learners,
    read_curves,
    training_folder,
)
from agents.study import Place, write_table
from agents.training.plan import TrainingPlan
from agents.training.run import BEST, CURVE
from agents.training.run_files import read_progress
from agents.training.settings import parse_algorithm
from agents.training.training import train_all
from dptse_env.config import EnvConfig
from dptse_env.policies import read_policy

BEST_LEARNERS = 2
"""Learners of each setting that are trained with every training seed."""

START = "start"
"""Folder, beside those of learners, of the Plackett-Luce trainings that `STARTED` starts from."""


class Training(NamedTuple):
    """A training of the study."""

    setting: str
    learner: str
    seed: int

    @property
    def start(self) -> Training:
        """The training that it starts from, if it is one of `STARTED`."""
        return self._replace(learner=START)

    def folder(self, study: Path) -> Path:
        """Return its folder in that of the study."""
        return training_folder(study, *self)


def train_ladder(place: Place, minutes: float, seeds: Sequence[int]) -> None:
    """Train what is missing, and keep the learning curves in the folder of the study.

    Every learner is trained with the first seed, the best of each setting with the others, too.

    Args:
        place: Folder of the study, and what runs the trainings, side by side.
        minutes: Time of each training.
        seeds: Training seeds.

    Raises:
        ValueError: An argument is out of range, or a folder has a training of another plan.
        OSError: A folder cannot be written.
        ExecutorError: Workers died again and again, or write to other disks than this machine's.
    """
    for name, setting in SETTINGS.items():
        corridor, seeds_to_train = config_of(name).corridor, setting.traffic.training
        record(corridor, seeds_to_train, place.records, progress=True)
    first = [
        Training(name, learner, seeds[0])
        for name in SETTINGS
        for learner in LEARNERS
        if fits(name, learner)
    ]
    _train_missing(first, place, minutes)
    curves = read_curves(place.folder)
    further = [
        Training(name, learner, seed)
        for name in SETTINGS
        for learner in ranked_learners(curves, name, seeds[0])[:BEST_LEARNERS]
        for seed in seeds[1:]
    ]
    _train_missing(further, place, minutes)


def config_of(setting: str) -> EnvConfig:
    """Return the configuration of a setting."""
    return Cell(SETTINGS[setting].env, keywords=SETTINGS[setting].keywords).config


def fits(setting: str, learner: str) -> bool:
    """Return whether a learner can choose the queries of a setting."""
    config = config_of(setting)
    return parse_algorithm(LEARNERS[learner][0], config.corridor.geometry.n_mainline).fits(config)


def plan_of(training: Training, study: Path, minutes: float) -> TrainingPlan:
    """Return the plan of a training.

    Args:
        training: The training. What it starts from is finished.
        study: Folder of the study.
        minutes: Time of the training with what it starts from.
    """
    setting, learner = SETTINGS[training.setting], training.learner
    name, own = LEARNERS[PLACKETT_LUCE if learner == START else learner]
    if learner in (START, STARTED):
        minutes /= 2
    n_segments = config_of(training.setting).corridor.geometry.n_mainline
    given = {**setting.changes.get(name, {}), **own}
    algorithm = parse_algorithm(f"{name} {json.dumps(given)}", n_segments)
    return TrainingPlan(
        (f"{setting.env} {json.dumps(setting.keywords)}",),
        algorithm,
        training.seed,
        setting.traffic.training,
        setting.traffic.validation,
        minutes,
        initial=str(training.start.folder(study) / BEST) if learner == STARTED else None,
    )


def _train_missing(trainings: Sequence[Training], place: Place, minutes: float) -> None:
    study = place.folder.absolute()
    for stage in ([each.start for each in trainings if each.learner == STARTED], trainings):
        plans = {each.folder(study): plan_of(each, study, minutes) for each in stage}
        for folder, plan in plans.items():
            check_plan(folder, plan.content())
        # A training that has come to its end has drawn its curve.
        missing = {folder: plan for folder, plan in plans.items() if not (folder / CURVE).exists()}
        train_all(missing, place.executor, records=place.records)
    keep_curves(study)


def keep_curves(study: Path) -> None:
    """Write the learning curves of the trainings that are finished.

    Steps and time of what a training starts from count, too.
    """
    parts = []
    for curve in sorted(study.glob(f"trainings/*/*/*/{CURVE}")):
        setting, learner, seed = curve.parts[-4:-1]
        training = Training(setting, learner, int(seed))
        if learner not in LEARNERS:
            continue
        starts = [training.start] if learner == STARTED else []
        earlier = [read_progress(each.folder(study))[-1] for each in starts]
        parts += [
            {
                "setting": setting,
                "policy": learner,
                "training_seed": training.seed,
                "digest": read_policy(training.folder(study) / BEST).identity,
                **{
                    name: row[name] + sum(last[name] for last in earlier)
                    for name in ("steps", "seconds")
                },
                **{name: row[name] for name in ("validation", "validation_drawn")},
            }
            for row in read_progress(training.folder(study))
        ]
    if parts:
        write_table(study / CURVES, pl.DataFrame(parts))
