"""Trainings of the study of policies: every learner for the same time, in folders that go on."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl
import torch

from agents.environments import make_config, quietly
from agents.executors import run_shown
from agents.files import write_json
from agents.play import record
from agents.studies.policies import (
    CURVES,
    LEARNERS,
    PLACKETT_LUCE,
    RULES,
    SETTINGS,
    STARTED,
    ranked_learners,
    read_curves,
    training_folder,
    validation_error,
)
from agents.study import Place, write_table
from agents.training.plan import TrainingPlan
from agents.training.run import BEST, CURVE, RULES_FILE
from agents.training.run_files import PLAN, check_plan, keep_plan, read_progress
from agents.training.settings import parse_algorithm
from agents.training.training import require_trained, train
from dptse_env.policies import read_policy
from dptse_env.traffic import Records

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

    @property
    def stages(self) -> tuple[Training, ...]:
        """It, after what it starts from."""
        return (self.start, self) if self.learner == STARTED else (self,)

    def is_finished(self, study: Path) -> bool:
        """Return whether it has come to its end, where it draws its curve."""
        return (self.folder(study) / CURVE).exists()

    def folder(self, study: Path) -> Path:
        """Return its folder in that of the study."""
        return training_folder(study, *self)


def train_ladder(rows: pl.DataFrame, place: Place, minutes: float, seeds: Sequence[int]) -> None:
    """Train what is missing, and keep the learning curves in the folder of the study.

    Every learner is trained with the first seed, the best of each setting with the others, too.

    Args:
        rows: Rows of the rules on validation traffic.
        place: Folder of the study, and what runs the trainings, side by side.
        minutes: Time of each training.
        seeds: Training seeds.

    Raises:
        ValueError: An argument is out of range, or a folder has a training of another plan.
        OSError: A folder cannot be written.
        ExecutorError: Workers died again and again, or write to other disks than this machine's.
    """
    rules = {
        name: {rule: validation_error(rows, name, rule) / 1000.0 for rule in RULES}
        for name in SETTINGS
    }
    for setting in SETTINGS.values():
        with quietly():
            corridor = make_config(setting.env, setting.keywords).corridor
        record(corridor, setting.traffic.training, place.records, progress=True)
    first = [
        Training(name, learner, seeds[0])
        for name in SETTINGS
        for learner in LEARNERS
        if fits(name, learner)
    ]
    _train_missing(first, place, minutes, rules)
    curves = read_curves(place.folder)
    further = [
        Training(name, learner, seed)
        for name in SETTINGS
        for learner in ranked_learners(curves, name, seeds[0])[:BEST_LEARNERS]
        for seed in seeds[1:]
    ]
    _train_missing(further, place, minutes, rules)


def fits(setting: str, learner: str) -> bool:
    """Return whether a learner can choose the queries of a setting."""
    env, keywords = SETTINGS[setting].env, SETTINGS[setting].keywords
    with quietly():
        config = make_config(env, keywords)
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
    with quietly():
        n_segments = make_config(setting.env, setting.keywords).corridor.geometry.n_mainline
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


def _train_missing(
    trainings: Sequence[Training], place: Place, minutes: float, rules: Mapping[str, Any]
) -> None:
    study = place.folder.absolute()
    for each in chain.from_iterable(training.stages for training in trainings):
        if (each.folder(study) / PLAN).exists():
            check_plan(each.folder(study), plan_of(each, study, minutes).content())
    missing = [(each, rules[each.setting]) for each in trainings if not each.is_finished(study)]

    def take(index: int, _: None) -> None:
        require_trained(missing[index][0].folder(study), CURVE)
        keep_curves(study)

    work = partial(_train_there, study=study, minutes=minutes, records=place.records)
    run_shown(place.executor, work, missing, take, desc="training", unit="training")
    keep_curves(study)


def _train_there(
    task: tuple[Training, dict[str, float]], study: Path, minutes: float, records: Records
) -> None:
    """Train, after what the training starts from; rules have their errors on validation traffic."""
    training, rules = task
    torch.set_num_threads(1)
    for each in training.stages:
        if not each.is_finished(study):
            folder, plan = each.folder(study), plan_of(each, study, minutes)
            keep_plan(folder, plan.content())
            write_json(folder / RULES_FILE, rules)
            corridor = plan.worlds[0].config.corridor
            record(corridor, (*plan.traffic_seeds, *plan.validation_seeds), records)
            train(plan, folder, records=records)


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
        earlier = [read_progress(each.folder(study))[-1] for each in training.stages[:-1]]
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
