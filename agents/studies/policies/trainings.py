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
    SETTINGS,
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


class Training(NamedTuple):
    """A training of the study."""

    setting: str
    learner: str
    seed: int

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


def plan_of(training: Training, minutes: float) -> TrainingPlan:
    """Return the plan of a training of some minutes."""
    setting, (name, own) = SETTINGS[training.setting], LEARNERS[training.learner]
    n_segments = config_of(training.setting).corridor.geometry.n_mainline
    given = {**setting.changes.get(name, {}), **own}
    return TrainingPlan(
        (f"{setting.env} {json.dumps(setting.keywords)}",),
        parse_algorithm(f"{name} {json.dumps(given)}", n_segments),
        training.seed,
        setting.traffic.training,
        setting.traffic.validation,
        minutes,
    )


def _train_missing(trainings: Sequence[Training], place: Place, minutes: float) -> None:
    study = place.folder.absolute()
    plans = {each.folder(study): plan_of(each, minutes) for each in trainings}
    for folder, plan in plans.items():
        check_plan(folder, plan.content())
    # A training that has come to its end has drawn its curve.
    missing = {folder: plan for folder, plan in plans.items() if not (folder / CURVE).exists()}
    train_all(missing, place.executor, records=place.records)
    keep_curves(study)


def keep_curves(study: Path) -> None:
    """Write the learning curves of the trainings that are finished."""
    parts = []
    for curve in sorted(study.glob(f"trainings/*/*/*/{CURVE}")):
        setting, learner, seed = curve.parts[-4:-1]
        origin = {
            "setting": setting,
            "policy": learner,
            "training_seed": int(seed),
            "digest": read_policy(curve.with_name(BEST)).identity,
        }
        measured = ("steps", "seconds", "validation", "validation_drawn")
        parts += [
            origin | {name: row[name] for name in measured} for row in read_progress(curve.parent)
        ]
    if parts:
        write_table(study / CURVES, pl.DataFrame(parts))
