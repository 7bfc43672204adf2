"""Tune an estimator's settings on training traffic with Optuna, in a journal that can be resumed.

One process proposes trials and writes the journal; episodes run on an executor.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from filelock import FileLock, Timeout
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock, JournalStorage
from optuna.trial import FrozenTrial, TrialState

from agents.executors import AnyExecutor
from agents.files import first_difference
from agents.search.space import DEMAND_START, at_bound, holds, nested, rounded, values_of
from agents.search.tuning_task import TuningTask, score_episodes
from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.settings import write_settings
from dptse_env.evaluation import Row
from dptse_env.utils.fields import from_mapping
from dptse_env.utils.files import replacing

_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
_COUNTED = (*_FINISHED, TrialState.RUNNING)

logger = logging.getLogger(__name__)

Score = Callable[[TuningTask, EstimatorSettings, Sequence[int]], list[Row]]
"""Plays settings on traffic seeds; a function of a module, so that workers can import it."""

BATCH = 8
"""Episodes that run at once; a trial may stop early after each batch."""


@dataclass
class _Running:
    """A trial under way over the traffic seeds."""

    trial: optuna.Trial
    settings: EstimatorSettings
    rows: list[Row] = field(default_factory=list)


class TuningStudy:
    """The trials of one task, kept in ``<folder>/<name>.journal``.

    The first trials are the defaults and the set that the environment takes by default; both run
    to the end. Later trials stop early once they fall behind the median.

    Attributes:
        task: The task.
        study: Optuna's study; its values are mean rewards, to be maximised.
    """

    def __init__(
        self, task: TuningTask, folder: Path, seed: int = 0, score: Score = score_episodes
    ) -> None:
        """Begin or go on; use `locked_study`, which keeps other processes out."""
        self.task, self.seed, self._score = task, seed, score
        self.space = task.space
        self.path = journal_path(task, folder)
        backend = JournalFileBackend(str(self.path), JournalFileOpenLock(str(self.path)))
        self.study = optuna.create_study(
            storage=JournalStorage(backend),
            study_name=task.name,
            direction="maximize",
            pruner=optuna.pruners.MedianPruner(n_startup_trials=8, n_warmup_steps=1),
            load_if_exists=True,
        )
        self._identify({**task.identity(), "sampler_seed": seed, "batch": BATCH})
        # No other process has the journal, so running trials belong to a run that was killed.
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            self.study.tell(trial.number, state=TrialState.FAIL)
        self._enqueue("defaults", DEMAND_START if task.with_demand else EstimatorSettings())
        self._enqueue("shipped", task.config().settings())

    def _identify(self, identity: dict[str, Any]) -> None:
        identity = json.loads(json.dumps(identity))
        kept = self.study.user_attrs.get("identity")
        if kept is None:
            self.study.set_user_attr("identity", identity)
            return
        difference = first_difference(kept, identity)
        if difference is not None:
            raise ValueError(
                f"{self.path} has the trials of another search: {difference}. Choose another "
                "--output"
            )

    def _enqueue(self, label: str, settings: EstimatorSettings) -> None:
        """Queue a labelled trial, unless one with its label was run or waits."""
        if self.task.with_demand and settings.demand is None:
            return
        values = values_of(settings, self.space)
        states = (*_FINISHED, TrialState.WAITING)
        for trial in self.study.get_trials(deepcopy=False, states=states):
            if label == trial.user_attrs.get("label"):
                return
        if label == "shipped" and settings == EstimatorSettings():
            return
        if not all(holds(knob, values[path]) for path, knob in self.space.items()):
            logger.warning("the %s settings lie outside of the search: %s", label, values)
            return
        self.study.enqueue_trial(values, user_attrs={"label": label})

    def n_finished(self) -> int:
        """Return the number of trials that ran to their end or were stopped early."""
        return len(self.study.get_trials(deepcopy=False, states=_FINISHED))

    def labelled(self, label: str) -> FrozenTrial | None:
        """Return the finished trial of the ``defaults`` or of the ``shipped`` set, if any."""
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            if trial.user_attrs.get("label") == label:
                return trial
        return None

    def best(self) -> FrozenTrial | None:
        """Return the best trial that ran to its end, if any."""
        trials = self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        return max(trials, key=_value, default=None)

    def run(
        self,
        n_trials: int,
        executor: AnyExecutor,
        n_parallel: int = 1,
        on_trial: Callable[[], None] | None = None,
    ) -> None:
        """Run trials until ``n_trials`` are finished, those of earlier runs included.

        With one trial at a time, a study that was interrupted comes out as one that was not.
        ``on_trial`` is called after every finished trial.
        """
        running: dict[Future[list[Row]], _Running] = {}
        try:
            while True:
                while len(running) < n_parallel and self._n_counted() < n_trials:
                    self._submit(self._propose(), executor, running)
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    trial = running[future]
                    trial.rows.extend(future.result())
                    finished = self._tell(trial)
                    del running[future]
                    if not finished:
                        self._submit(trial, executor, running)
                    elif on_trial is not None:
                        on_trial()
        except BaseException:
            executor.shutdown(cancel_futures=True)
            for trial in running.values():
                self.study.tell(trial.trial, state=TrialState.FAIL, skip_if_finished=True)
            raise

    def _n_counted(self) -> int:
        return len(self.study.get_trials(deepcopy=False, states=_COUNTED))

    def _propose(self) -> _Running:
        # A new sampler for each trial: resuming must not draw the first numbers again.
        seed = np.random.SeedSequence([self.seed, self._n_counted()]).generate_state(1)[0]
        self.study.sampler = optuna.samplers.TPESampler(seed=int(seed), multivariate=True)
        trial = self.study.ask({**self.space})
        settings = nested({path: rounded(trial.params[path]) for path in self.space})
        trial.set_user_attr("settings", settings)
        return _Running(trial, from_mapping(EstimatorSettings, settings, "estimator_settings"))

    def _submit(
        self,
        trial: _Running,
        executor: AnyExecutor,
        running: dict[Future[list[Row]], _Running],
    ) -> None:
        done = len(trial.rows)
        seeds = self.task.traffic_seeds[done : done + BATCH]
        running[executor.submit(self._score, self.task, trial.settings, seeds)] = trial

    def _tell(self, running: _Running) -> bool:
        """Report the latest batch; return whether the trial is finished."""
        trial, rows = running.trial, running.rows
        reward = float(np.mean([row["reward"] for row in rows]))
        if not math.isfinite(reward):
            bad = [row["traffic_seed"] for row in rows if not math.isfinite(row["reward"])]
            trial.set_user_attr("not_finite", bad)
            self.study.tell(trial, state=TrialState.PRUNED)
            return True
        trial.report(reward, len(rows))
        if len(rows) == len(self.task.traffic_seeds):
            for key, value in _summary(rows).items():
                trial.set_user_attr(key, value)
            self.study.tell(trial, reward)
            return True
        if "label" not in trial.user_attrs and trial.should_prune():
            self.study.tell(trial, state=TrialState.PRUNED)
            return True
        return False

    def write(self, path: Path) -> None:
        """Write the best settings with their provenance.

        Raises:
            ValueError: No trial ran to its end.
        """
        best = self.best()
        if best is None:
            raise ValueError(f"{self.task.name}: no trial ran to its end with a finite score")
        with replacing(path) as temporary:
            write_settings(
                temporary,
                estimator=self.task.estimator,
                parameters=self.task.parameters_name,
                privacy=self.task.privacy,
                settings=best.user_attrs["settings"],
                provenance=self._provenance(best),
                variant=self.task.variant,
            )

    def _provenance(self, best: FrozenTrial) -> dict[str, Any]:
        task, config = self.task, self.task.config()
        settings = from_mapping(EstimatorSettings, best.user_attrs["settings"], "settings")
        values = values_of(settings, self.space)
        return {
            "corridor": config.corridor.name,
            "schedule": task.schedule,
            "bandwidth": config.bandwidth,
            "epsilon": config.privacy.epsilon,
            "delta": config.privacy.delta,
            "seeds": task.seeds,
            "n_trials": self.n_finished(),
            "rmse_density": round(best.user_attrs["rmse_density"], 2),
            "rmse_speed": round(best.user_attrs["rmse_speed"], 2),
            "at_bounds": [
                path for path, knob in self.space.items() if at_bound(knob, values[path])
            ],
            "date": date.today().isoformat(),
            "version": version("dptse-env"),
        }


@contextmanager
def locked_study(
    task: TuningTask, folder: Path, seed: int = 0, score: Score = score_episodes
) -> Iterator[TuningStudy]:
    """Begin a study or go on with it, and keep other processes out of it meanwhile.

    Raises:
        ValueError: The journal is of a study with other arguments.
        BlockingIOError: Another process has the study open.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = journal_path(task, folder)
    lock = FileLock(folder / f".{path.name}.lock")
    try:
        lock.acquire(timeout=0.0)
    except Timeout as problem:
        raise BlockingIOError(f"another run is writing {path}") from problem
    try:
        path.touch()
        _mend(path)
        yield TuningStudy(task, folder, seed, score)
    finally:
        lock.release()


def journal_path(task: TuningTask, folder: Path) -> Path:
    """Return the path of the journal of a task."""
    return folder / f"{task.name}.journal"


def scores_of(trial: FrozenTrial) -> dict[str, float]:
    """Return the mean reward (``score``), errors and divergences of a finished trial."""
    keys = ("rmse_density", "rmse_speed", "n_diverged")
    return {"score": _value(trial), **{key: trial.user_attrs[key] for key in keys}}


def _value(trial: FrozenTrial) -> float:
    if trial.value is None:
        raise ValueError(f"trial {trial.number} has no score")
    return trial.value


def _summary(rows: list[Row]) -> dict[str, float]:
    """Return errors as means over traffic seeds, divergences as sums."""
    return {
        "rmse_density": float(np.mean([row["rmse_density"] for row in rows])),
        "rmse_speed": float(np.mean([row["rmse_speed"] for row in rows])),
        "n_diverged": float(sum(row["n_diverged"] for row in rows)),
    }


def _mend(path: Path) -> None:
    """Undo the incomplete write of a killed run, half a line and a lock that Optuna cannot read."""
    content = path.read_bytes()
    complete = content.rfind(b"\n") + 1
    if complete < len(content):
        with path.open("r+b") as file:
            file.truncate(complete)
    Path(f"{path}.lock").unlink(missing_ok=True)
