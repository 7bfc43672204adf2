"""Search of an estimator's settings on training traffic by Optuna, in a journal.

The score is the mean reward of a second after the warm-up, as the environment gives it. Trials are
Optuna's own; one that was interrupted stays in the journal as running, and does not count.

With one worker, the same seed gives the same trials, however often the search was interrupted.
With several, each proposes by what has ended when it asks: the first trials, the defaults and those
drawn at random, are the same ones, and later ones depend on the order in which trials end.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.pruners import MedianPruner
from optuna.samplers import TPESampler
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock, JournalStorage
from optuna.trial import FrozenTrial, TrialState

from agents.executors import Executor, run_shown
from agents.play import Cell, play
from agents.search.space import (
    DEMAND_START,
    Extra,
    Knob,
    at_bound,
    holds,
    nested,
    search_space,
    values_of,
)
from dptse_env.config import EnvConfig
from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.tuned import settings_name, write_settings
from dptse_env.evaluation import Row
from dptse_env.traffic import Records
from dptse_env.utils.files import json_digest, replacing
from dptse_env.utils.validation import from_mapping
from dptse_env.versions import code_version

logger = logging.getLogger(__name__)

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
"""States of trials that ran to their end, or were stopped early."""

BATCH = 8
"""Episodes that are played at once; a trial may stop early after each batch."""

SCORES = ("reward", "rmse_density", "rmse_speed")
"""Columns of rows whose means are kept of a trial; the first one is maximised."""


@dataclass(frozen=True)
class Search:
    """The search for one set of settings.

    Attributes:
        cell: What a trial plays, but for the settings; its traffic seeds are neighbours.
        also: Further settings to search, names in `agents.search.space.EXTRAS`.
        seed: Seeds the proposals.
        records: Library of records, or its folder; None for the user's cache.
    """

    cell: Cell
    also: tuple[Extra, ...] = ()
    seed: int = 0
    records: Records = None

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        return str(self.cell.keywords["estimator"])

    @property
    def space(self) -> dict[str, Knob]:
        """The search space, by path into the settings."""
        return search_space(self.estimator, self.also)

    @property
    def seeds(self) -> tuple[int, ...]:
        """The traffic seeds."""
        return self.cell.seeds or ()

    @cached_property
    def config(self) -> EnvConfig:
        """Configuration of the environment, with the settings that it has without a search."""
        return self.cell.config

    @property
    def name(self) -> str:
        """Name of the set, and of its file."""
        config = self.config
        name = settings_name(self.estimator, config.parameters.name, str(config.privacy.preset))
        return name.replace(":", ".")  # Windows has no files with a colon

    @property
    def study_name(self) -> str:
        """Name of the set with a digest of all that makes scores comparable."""
        content = {
            "cell": self.cell.id,
            "corridor": self.config.corridor.digest,
            "parameters": dataclasses.asdict(self.config.parameters),
            "seeds": self.seeds,
            "seed": self.seed,
            "dptse-env": code_version(),
            "also": self.also,
        }
        return f"{self.name} {json_digest(content)[:12]}"

    def is_begun(self, journal: Path) -> bool:
        """Return whether a journal has trials of this search."""
        there = os.path.lexists(journal)  # its name may be too long
        names = optuna.get_all_study_names(_storage(journal)) if there else []
        return self.study_name in names

    def starts(self) -> list[tuple[str, dict[str, Any]]]:
        """Return labels and values of the first trials: ``defaults`` and ``present`` settings."""
        has_demand = "demand" in self.also
        starts = {
            "defaults": DEMAND_START if has_demand else EstimatorSettings(),
            "present": self.config.settings(),
        }
        found: list[tuple[str, dict[str, Any]]] = []
        for label, settings in starts.items():
            if has_demand and settings.demand is None:
                continue
            values = values_of(settings, self.space)
            if not all(holds(knob, values[path]) for path, knob in self.space.items()):
                logger.warning("the %s settings lie outside of the search: %s", label, values)
            elif values not in [each for _, each in found]:
                found.append((label, values))
        return found

    def play(self, settings: EstimatorSettings, seeds: Sequence[int]) -> list[Row]:
        """Play an episode on each traffic seed with given settings, as one batch."""
        keywords = {**self.cell.keywords, "estimator_settings": dataclasses.asdict(settings)}
        return play(dataclasses.replace(self.cell, keywords=keywords), seeds, self.records)


def tune(search: Search, journal: Path, n_trials: int, executor: Executor) -> optuna.Study:
    """Run trials until ``n_trials`` are finished, those of earlier runs included.

    The first ones are the defaults and the settings that the environment has without a search;
    both run to the end. Later ones stop early once they fall behind the median.

    Args:
        search: What is tuned.
        journal: File of the trials of all searches in a folder; made if it is missing.
        n_trials: Number of trials.
        executor: Its workers run whole trials, and share the journal.
    """
    journal.parent.mkdir(parents=True, exist_ok=True)
    _mend(journal)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        storage=_storage(journal), study_name=search.study_name, direction="maximize",
        load_if_exists=True,
    )  # fmt: skip
    starts = dict(enumerate(search.starts()))
    tasks = [(index, starts.get(index)) for index in range(n_finished(study), n_trials)]
    work = partial(_run_trial, search, journal)
    run_shown(executor, work, tasks, lambda *done: None, desc=search.name, unit="trial")
    return study


def n_finished(study: optuna.Study) -> int:
    """Return the number of trials that ran to their end or were stopped early."""
    return len(study.get_trials(deepcopy=False, states=FINISHED))


def chosen(study: optuna.Study) -> dict[str, FrozenTrial]:
    """Return the trials of the ``defaults`` and the ``present`` settings, if any, and the best.

    Raises:
        ValueError: No trial ran to its end.
    """
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not trials:
        raise ValueError(f"{study.study_name}: no trial ran to its end with a finite score")
    found = {t.user_attrs["label"]: t for t in trials if "label" in t.user_attrs}
    return {**found, "tuned": study.best_trial}


def write_set(search: Search, study: optuna.Study, path: Path) -> dict[str, Any]:
    """Write the best settings with their provenance, and return them.

    Raises:
        ValueError: No trial ran to its end.
    """
    best, config = chosen(study)["tuned"], search.config
    provenance = {
        "corridor": config.corridor.name,
        "schedule": search.cell.policy,
        "bandwidth": config.bandwidth,
        "epsilon": config.privacy.epsilon,
        "delta": config.privacy.delta,
        "seeds": f"{search.seeds[0]}:{search.seeds[-1] + 1}",
        "n_trials": n_finished(study),
        **{key: round(best.user_attrs[key], 2) for key in SCORES[1:]},
        "at_bounds": [at for at, knob in search.space.items() if at_bound(knob, best.params[at])],
        "date": date.today().isoformat(),
        "version": code_version(),
    }
    settings = nested(best.params)
    with replacing(path) as temporary:
        write_settings(
            temporary, estimator=search.estimator, parameters=config.parameters.name,
            privacy=str(config.privacy.preset), settings=settings, provenance=provenance,
        )  # fmt: skip
    return settings


def _storage(journal: Path) -> JournalStorage:
    path = str(journal)
    return JournalStorage(JournalFileBackend(path, JournalFileOpenLock(path)))


def _run_trial(
    search: Search, journal: Path, task: tuple[int, tuple[str, dict[str, Any]] | None]
) -> None:
    """Run a trial to its end, or until it falls behind.

    Args:
        search: The search.
        journal: File of the trials.
        task: The number of trials before this one, and label and values of a start.
    """
    index, start = task
    # A new sampler for each trial: resuming must not draw the first numbers again. Without a liar:
    # trials that were interrupted, which stay as running, must not count as bad ones.
    seed = np.random.SeedSequence([search.seed, index]).generate_state(1)[0]
    study = optuna.load_study(
        study_name=search.study_name,
        storage=_storage(journal),
        sampler=TPESampler(seed=int(seed), multivariate=True, constant_liar=False),
        pruner=MedianPruner(n_startup_trials=8),
    )
    if start is not None:
        study.enqueue_trial(start[1], user_attrs={"label": start[0]})
    trial = study.ask({**search.space})
    settings = from_mapping(EstimatorSettings, nested(trial.params), "estimator_settings")
    rows = list[Row]()
    for first in range(0, len(search.seeds), BATCH):
        rows += search.play(settings, search.seeds[first : first + BATCH])
        means = {key: float(np.mean([row[key] for row in rows])) for key in SCORES}
        score = means.pop("reward")
        if math.isfinite(score):
            trial.report(score, len(rows))
        if not math.isfinite(score) or (len(rows) < len(search.seeds) and trial.should_prune()):
            study.tell(trial, state=TrialState.PRUNED)
            return
    for key, value in means.items():
        trial.set_user_attr(key, value)
    study.tell(trial, score)


def _mend(journal: Path) -> None:
    """Cut off half a line that a killed run left, after which Optuna could not read on."""
    lock = JournalFileOpenLock(str(journal))
    lock.acquire()
    try:
        content = journal.read_bytes() if journal.exists() else b""
        if content and not content.endswith(b"\n"):
            os.truncate(journal, content.rfind(b"\n") + 1)
    finally:
        lock.release()
