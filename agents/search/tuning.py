"""Tune an estimator's settings on training traffic by Optuna, in a journal that several may share.

The score is the mean reward of a second after the warm-up, as the environment gives it. Trials are
Optuna's own, in its journal; one that was interrupted stays there as running, and does not count.

With one worker, the same seed gives the same trials, however often the search was interrupted.
With several, each proposes by what has ended when it asks: the first trials, the defaults and those
drawn at random, are the same ones, and later ones depend on the order in which trials end.
"""

from __future__ import annotations

import dataclasses
import json
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

from agents.environments import make_config, parse_env, quietly
from agents.executors import Executor, run_shown
from agents.files import first_difference
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
from agents.seeds import TUNING, require_seeds
from dptse_env.config import TRAINING_SEEDS, EnvConfig, parse_seeds
from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.tuned import settings_name, write_settings
from dptse_env.evaluation import Row
from dptse_env.traffic import Records
from dptse_env.utils.files import replacing
from dptse_env.utils.validation import from_mapping, require
from dptse_env.versions import code_version

logger = logging.getLogger(__name__)

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
"""States of trials that ran to their end, or were stopped early."""

BATCH = 8
"""Episodes that are played at once; a trial may stop early after each batch."""


@dataclass(frozen=True)
class Search:
    """The search for one set of settings.

    Attributes:
        env: The environment, an id or an id and keywords as JSON (`agents.environments.parse_env`).
        estimator: Name of the estimator.
        seeds: Traffic seeds, ``"first:stop"``, within `TRAINING_SEEDS`.
        schedule: Query schedule, or a saved policy: its ``.safetensors`` file or shipped name.
        also: Further settings to search, names in `agents.search.space.EXTRAS`.
        variant: Ending of the set's name; empty for one that is the default of its privacy preset.
        seed: Seeds the proposals.
        records: Library of records, or its folder; None for the user's cache.
    """

    env: str
    estimator: str
    seeds: str
    schedule: str = "shift-ahead"
    also: tuple[Extra, ...] = ()
    variant: str = ""
    seed: int = 0
    records: Records = None

    @property
    def space(self) -> dict[str, Knob]:
        """The search space, by path into the settings."""
        return search_space(self.estimator, self.also)

    @property
    def traffic_seeds(self) -> tuple[int, ...]:
        """The traffic seeds one by one."""
        return parse_seeds(self.seeds)

    @cached_property
    def config(self) -> EnvConfig:
        """Configuration of the environment, with the settings that it has without a search."""
        cell = self.cell()
        with quietly():
            return make_config(cell.env, cell.all_keywords)

    @property
    def name(self) -> str:
        """Name of the set, which names its files: of a class with a dot in place of the colon."""
        config = self.config
        parameters, preset = config.parameters.name, str(config.privacy.preset)
        name = settings_name(self.estimator, parameters, preset, self.variant)
        return name.replace(":", ".")  # Windows has no files with a colon

    def cell(self, settings: EstimatorSettings | None = None) -> Cell:
        """Return what a trial plays; with the environment's own settings if None."""
        env, keywords = parse_env(self.env)
        keywords["estimator"] = self.estimator
        if settings is not None:
            keywords["estimator_settings"] = dataclasses.asdict(settings)
        return Cell(env, self.schedule, keywords, noise_seed=TUNING.start)

    def check(self) -> None:
        """Check everything without playing or recording.

        Raises:
            FileNotFoundError: There is no such saved policy.
            ValueError: A value is out of range, or there is nothing to tune.
        """
        _ = self.space
        require_seeds("seeds", self.traffic_seeds, TRAINING_SEEDS)
        keywords = parse_env(self.env)[1]
        for key in ("estimator", "traffic_seeds", "records", "action"):
            require(key not in keywords, f"env.{key}", "left out", keywords.get(key))
        self.cell().check()
        name = self.name
        require(Path(name).name == name, "name of the set", "part of the name of a file", name)

    def starts(self) -> dict[str, dict[str, Any]]:
        """Return the values from which the search begins: ``defaults`` and ``present`` ones."""
        has_demand = "demand" in self.also
        found: dict[str, dict[str, Any]] = {}
        for label, settings in (
            ("defaults", DEMAND_START if has_demand else EstimatorSettings()),
            ("present", self.config.settings()),
        ):
            if has_demand and settings.demand is None:
                continue
            values = values_of(settings, self.space)
            if not all(holds(knob, values[path]) for path, knob in self.space.items()):
                logger.warning("the %s settings lie outside of the search: %s", label, values)
            elif values not in found.values():
                found[label] = values
        return found

    def play(self, settings: EstimatorSettings, seeds: Sequence[int]) -> list[Row]:
        """Play an episode on each traffic seed with given settings, as one batch."""
        return play(self.cell(settings), seeds, self.records)

    def identity(self) -> dict[str, Any]:
        """Return everything that two searches must share for their scores to be comparable."""
        config = self.config
        return {
            **json.loads(self.cell().id),
            "corridor": config.corridor.digest,
            "parameters": dataclasses.asdict(config.parameters),
            "seeds": self.seeds,
            "seed": self.seed,
            "dptse-env": code_version(),
            "also": self.also,
        }


def tune(search: Search, folder: Path, n_trials: int, executor: Executor) -> optuna.Study:
    """Run trials until ``n_trials`` are finished, those of earlier runs included.

    The first ones are the defaults and the settings that the environment has without a search;
    both run to the end. Later ones stop early once they fall behind the median.

    Args:
        search: What is tuned.
        folder: Gets the journal; made if it is missing.
        n_trials: Number of trials.
        executor: Its workers run whole trials, and share the journal.

    Raises:
        ValueError: The journal is of another search.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = journal_path(search, folder)
    _mend(path)
    study = optuna.create_study(
        storage=_storage(path), study_name=search.name, direction="maximize", load_if_exists=True
    )
    identity = json.loads(json.dumps(search.identity()))
    difference = first_difference(study.user_attrs.get("identity", identity), identity)
    if difference is not None:
        raise ValueError(
            f"{path} has the trials of another search: {difference}. Choose another --output"
        )
    study.set_user_attr("identity", identity)
    starts = dict(enumerate(search.starts().items()))
    tasks = [(index, starts.get(index)) for index in range(n_finished(study), n_trials)]
    work = partial(_run_trial, search, folder)
    run_shown(executor, work, tasks, lambda *done: None, desc=search.name, unit="trial")
    return study


def journal_path(search: Search, folder: Path) -> Path:
    """Return the path of the journal of a search."""
    return folder / f"{search.name}.journal"


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


def write(search: Search, study: optuna.Study, path: Path) -> dict[str, Any]:
    """Write the best settings with their provenance, and return them.

    Raises:
        ValueError: No trial ran to its end.
    """
    best, config, space = chosen(study)["tuned"], search.config, search.space
    provenance = {
        "corridor": config.corridor.name,
        "schedule": search.schedule,
        "bandwidth": config.bandwidth,
        "epsilon": config.privacy.epsilon,
        "delta": config.privacy.delta,
        "seeds": search.seeds,
        "n_trials": n_finished(study),
        "rmse_density": round(best.user_attrs["rmse_density"], 2),
        "rmse_speed": round(best.user_attrs["rmse_speed"], 2),
        "at_bounds": [path for path, knob in space.items() if at_bound(knob, best.params[path])],
        "date": date.today().isoformat(),
        "version": code_version(),
    }
    settings = nested(best.params)
    with replacing(path) as temporary:
        write_settings(
            temporary,
            estimator=search.estimator,
            parameters=config.parameters.name,
            privacy=str(config.privacy.preset),
            settings=settings,
            provenance=provenance,
            variant=search.variant,
        )
    return settings


def _storage(journal: Path) -> JournalStorage:
    path = str(journal)
    return JournalStorage(JournalFileBackend(path, JournalFileOpenLock(path)))


def _run_trial(
    search: Search, folder: Path, task: tuple[int, tuple[str, dict[str, Any]] | None]
) -> None:
    """Run a trial to its end, or until it falls behind.

    Args:
        search: The search.
        folder: Has the journal.
        task: The number of trials before this one, and label and values of a start.
    """
    index, start = task
    # A new sampler for each trial: resuming must not draw the first numbers again. Without a liar:
    # trials that were interrupted, which stay as running, must not count as bad ones.
    seed = np.random.SeedSequence([search.seed, index]).generate_state(1)[0]
    study = optuna.load_study(
        study_name=search.name,
        storage=_storage(journal_path(search, folder)),
        sampler=TPESampler(seed=int(seed), multivariate=True, constant_liar=False),
        pruner=MedianPruner(n_startup_trials=8),
    )
    if start is not None:
        study.enqueue_trial(start[1], user_attrs={"label": start[0]})
    trial = study.ask({**search.space})
    settings = from_mapping(EstimatorSettings, nested(trial.params), "estimator_settings")
    seeds, rows = search.traffic_seeds, list[Row]()
    for first in range(0, len(seeds), BATCH):
        rows += search.play(settings, seeds[first : first + BATCH])
        means = {
            key: float(np.mean([row[key] for row in rows]))
            for key in ("reward", "rmse_density", "rmse_speed")
        }
        if not math.isfinite(means["reward"]):
            study.tell(trial, state=TrialState.PRUNED)
            return
        trial.report(means["reward"], len(rows))
        if len(rows) < len(seeds) and trial.should_prune():
            study.tell(trial, state=TrialState.PRUNED)
            return
    trial.set_user_attr("rmse_density", means["rmse_density"])
    trial.set_user_attr("rmse_speed", means["rmse_speed"])
    study.tell(trial, means["reward"])


def _mend(path: Path) -> None:
    """Cut off half a line that a killed run left, after which Optuna could not read on."""
    lock = JournalFileOpenLock(str(path))
    lock.acquire()
    try:
        content = path.read_bytes() if path.exists() else b""
        if content and not content.endswith(b"\n"):
            os.truncate(path, content.rfind(b"\n") + 1)
    finally:
        lock.release()
