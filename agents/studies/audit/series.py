"""Public numbers of an episode: the queries, and the terms of the releases."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agents.studies.audit.attack import attacked_form
from agents.studies.audit.releases import Overheard, Terms, attacked
from agents.studies.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.config import EnvConfig
from dptse_env.parts import make_parts, make_release
from dptse_env.process import QueryProcess
from dptse_env.release import TrafficTable
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray


class PublicSeries(NamedTuple):
    """Public numbers of the seconds 1 to T of an episode.

    Attributes:
        observed: Observed columns, shape (T, C).
        terms: Terms of the releases, with T rows.
    """

    observed: BoolArray
    terms: Terms

    def at(self, step: int, copies: int) -> tuple[BoolArray, Terms]:
        """Return the numbers of a step, a row for each of so many copies of the episode."""
        rows = np.full(copies, step)
        return self.observed[rows], Terms(*(array[rows] for array in self.terms))


def play_series(config: EnvConfig, record: Record, plan: BoolArray, seed: int = 0) -> PublicSeries:
    """Play an episode over a record, and return what is public of it.

    Args:
        config: The configuration.
        record: The traffic.
        plan: Queries, shape (horizon, n_mainline).
        seed: Seeds noise and estimator.
    """
    config = attacked_form(config)
    library = AdjacentWorlds(record, (Trajectory.absent(), Trajectory.absent()))
    traffic, one = TrafficTable(config.corridor, (0, 1), library), np.arange(1)
    release = Overheard(make_release(config, 1, traffic))
    process = QueryProcess(make_parts(config, 1, traffic=traffic, release=release))
    played = attacked(release.model)
    process.reset(one, [np.random.default_rng(seed)], {"traffic_seed": 0, "start": 0})
    observed, terms = [], []
    for queried in plan:
        process.step(one, queried[None].astype(np.int8))
        observed.append(release.setup.observed(queried[None]))
        terms.append(played.terms(release.last))
    joined = (np.concatenate(rows) for rows in zip(*terms, strict=True))
    return PublicSeries(np.concatenate(observed), Terms(*joined))
