"""Running a policy in a cell: all traffic seeds at once."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass

import numpy as np

from agents.evaluation.contributions import LedgerWatcher, of_queries
from agents.evaluation.episodes import EpisodeScore, run_episodes
from agents.evaluation.honesty import EstimateWatcher
from agents.experiments.runner import make_batch
from agents.policies import PolicySource
from agents.suite.card import DONE, FAILED, CellResult
from agents.suite.cells import SuiteCell
from agents.suite.guard import Guarded, PolicyError, foreign_code
from dptse_env.parts import privacy_report
from dptse_env.policies import TRANSFERABLE
from dptse_env.release import Capped
from dptse_env.release.paced import Paced
from dptse_env.traffic import Records
from dptse_env.vector_env import SensorQueryVectorEnv

POLICY_SEED = 0
"""Seeds the draws of a schedule."""


@dataclass(frozen=True)
class SuiteTask:
    """A policy in a cell, with everything that a worker needs.

    Attributes:
        records: Library of records, or its folder; None for the user's cache.
    """

    policy: PolicySource
    cell: SuiteCell
    records: Records


def run_cell(task: SuiteTask) -> CellResult:
    """Run a policy on the traffic of a cell; a policy that fails is a result, too."""
    cell, reason = task.cell, ""
    try:
        return _score(task)
    except PolicyError as failure:
        reason = str(failure)
    return CellResult(cell.name, cell.digest, FAILED, reason)


def _score(task: SuiteTask) -> CellResult:
    cell, seeds = task.cell, task.cell.traffic_seeds
    with foreign_code():
        encoding = task.policy.keywords
    with warnings.catch_warnings():
        # Other drivers are the point of a cell.
        warnings.filterwarnings("ignore", message=".*values measured or tuned on")
        env = make_batch(cell.env, {**cell.keywords, **encoding}, seeds, task.records)
        env.process  # noqa: B018 (made here, so that an error below is the policy's)
    with foreign_code():
        # Another road or bandwidth may do; observations and actions must be the same all the same.
        policy = task.policy.load(env, allow=TRANSFERABLE, seed=POLICY_SEED)
    guarded, watch = Guarded(policy, env), _Watchers(env, seeds)
    started = time.perf_counter()
    scores = run_episodes(
        env, guarded, traffic_seeds=seeds, seeds=cell.noise_seeds, on_second=watch
    )
    seconds = time.perf_counter() - started
    report = privacy_report(cell.config)
    chi2 = watch.chi2(scores)
    return CellResult(
        cell.name, cell.digest, DONE, "",
        traffic_seeds=seeds,
        error=tuple(-1000.0 * score.reward for score in scores),
        density=tuple(score.rmse_density for score in scores),
        speed=tuple(score.rmse_speed for score in scores),
        chi2_density=chi2[0],
        chi2_speed=chi2[1],
        epsilon=report.epsilon if math.isfinite(report.epsilon) else None,
        delta=report.claimed_delta,
        is_guaranteed=not report.void_reasons,
        percent_refused=watch.percent_refused(scores),
        queries_a_second=watch.n_queries / max(watch.n_seconds, 1) / len(seeds),
        policy_ms=1000.0 * guarded.seconds / max(guarded.n_decisions, 1),
        step_ms=1000.0 * seconds / max(watch.n_seconds, 1) / len(seeds),
    )  # fmt: skip


class _Watchers:
    """Follows estimates, contributions and the number of queries."""

    def __init__(self, env: SensorQueryVectorEnv, seeds: tuple[int, ...]) -> None:
        self._process = env.process
        self._estimates = EstimateWatcher(env.process)
        has_accounts = isinstance(of_queries(env.process.release), Capped | Paced)
        self._ledgers = LedgerWatcher(env.process, seeds) if has_accounts else None
        self.n_queries, self.n_seconds = 0, -1  # the first call is that after the reset

    def __call__(self) -> None:
        self._estimates()
        if self._ledgers is not None:
            self._ledgers()
        self.n_seconds += 1
        if self.n_seconds:
            self.n_queries += int(self._process.queried.sum())

    def chi2(self, episodes: list[EpisodeScore]) -> tuple[float, float]:
        """Return the mean chi-square of densities and of speeds."""
        watched = self._estimates.scores(episodes)
        density, speed = (
            [score.chi2_density for score in watched],
            [s.chi2_speed for s in watched],
        )
        return float(np.mean(density)), float(np.mean(speed))

    def percent_refused(self, episodes: list[EpisodeScore]) -> float | None:
        """Return the share of contributions that a budget refused [%], if any is kept."""
        if self._ledgers is None:
            return None
        watched = self._ledgers.scores(episodes)
        met = sum(score.n_met for score in watched)
        return 100.0 * sum(score.n_refused for score in watched) / max(met, 1)
