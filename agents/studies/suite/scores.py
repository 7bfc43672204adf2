"""Scores: per cent below the rule of each task, which validation traffic has chosen."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy import stats

from agents.play import Cell
from agents.statistics import Interval, percent_below
from agents.studies.suite.tasks import ADVISED, ROUND_ROBIN, RULES, TASKS, VALIDATION, make_cell
from agents.tables import ERROR, UnmeasuredError, values_of
from dptse_env.utils.arrays import FloatArray

Errors = Mapping[str, FloatArray]
"""Errors x 1000 by task, of training seeds and the task's traffic seeds, (S, T) each."""

RESAMPLES = 4_000
"""Resamples of an interval."""

SEEN, POWER = 2.0, 0.9
"""A difference that a task has to show [%], and the chance of showing it."""


class Scores(NamedTuple):
    """Per cent below the rule of each task, and their mean over all tasks.

    Attributes:
        tasks: By task.
        mean: None where a task is missing.
    """

    tasks: Mapping[str, Interval]
    mean: Interval | None


def errors_of(rows: pl.DataFrame, *cells: Cell) -> FloatArray:
    """Return the errors x 1000 of cells on the same traffic seeds, shape (n_cells, T).

    Args:
        rows: Rows of equal numbers.
        *cells: The cells.

    Raises:
        UnmeasuredError: One was not played on all of its traffic seeds.
    """
    found = []
    for cell in cells:
        own = rows.filter(pl.col("traffic_seed").is_in(cell.seeds or ()), cell=cell.id)
        if len(own) != len(cell.seeds or ()):
            raise UnmeasuredError(cell.labels)
        found.append(values_of(own.sort("traffic_seed"), ERROR))
    return np.stack(found)


def choose_rules(rows: pl.DataFrame) -> dict[str, str]:
    """Return the rule of least error on validation traffic, of the tasks where all were played."""
    rules = {}
    for task in TASKS:
        try:
            table = errors_of(rows, *(make_cell(task, rule, part=VALIDATION) for rule in RULES))
        except UnmeasuredError:
            continue
        rules[task] = RULES[int(table.mean(axis=1).argmin())]
    return rules


def score(errors: Errors, references: Errors, seed: int = 0) -> Scores:
    """Return by how much errors lie below those of references [%], with 95 % intervals.

    A score is that of `agents.statistics.percent_below`. Its interval is that of a bootstrap over
    training seeds crossed with traffic seeds, which are paired with the reference's. Traffic seeds
    are weighted at random (Rubin, "The Bayesian Bootstrap", 1981), so that all tasks of a resample
    share weights and trainings though some have more seeds: the mean knows that they do.

    Args:
        errors: Of an entry.
        references: Of the rules, (1, T) each, on the same traffic seeds and maybe more.
        seed: Seeds the resampling.
    """
    generator = np.random.default_rng(seed)
    most = max((table.shape[1] for table in errors.values()), default=0)
    drawn = generator.random((RESAMPLES, max(map(len, errors.values()), default=0)))
    weights = generator.exponential(size=(RESAMPLES, most))
    found, resampled = {}, []
    for name, table in errors.items():
        n = table.shape[1]
        reference, own = references[name][:, :n], weights[:, :n]
        own = own / own.sum(axis=1, keepdims=True)
        picked = (drawn[:, : len(table)] * len(table)).astype(int)
        means = np.take_along_axis(own @ table.T, picked, axis=1)[..., None]
        resampled.append(percent_below(means, (own @ reference.T)[..., None]))
        found[name] = _interval(float(percent_below(table, reference)), resampled[-1], n)
    if found.keys() != TASKS.keys():
        return Scores(found, None)
    mean = float(np.mean([each.mean for each in found.values()]))
    return Scores(found, _interval(mean, np.mean(resampled, axis=0), most))


def _interval(value: float, resampled: FloatArray, n: int) -> Interval:
    low, high = np.percentile(resampled, [2.5, 97.5])
    return Interval(value, float(low), float(high), n)


def spread(rows: pl.DataFrame, task: str, rule: str) -> float:
    """Return the standard deviation over validation seeds of a difference to a rule [%].

    It is that of the round robin, which is paired no better than an entry.

    Raises:
        UnmeasuredError: One of them was not played.
    """
    other = ROUND_ROBIN if rule != ROUND_ROBIN else ADVISED[0]
    pair = (make_cell(task, each, part=VALIDATION) for each in (rule, other))
    own, theirs = errors_of(rows, *pair)
    return float(100.0 * np.std(theirs - own, ddof=1) / own.mean())


def seeds_to_see(deviation: float) -> int:
    """Return the number of traffic seeds that show `SEEN` per cent with the chance `POWER`.

    For paired differences with a standard deviation s [%] it is ((z_0.975 + z_0.9) s / 2)^2.
    """
    quantiles = float(stats.norm.ppf(0.975) + stats.norm.ppf(POWER))
    return math.ceil((quantiles * deviation / SEEN) ** 2)
