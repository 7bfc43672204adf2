"""Normalised scores: the paper's schedule has 0, the error oracle 1."""

from __future__ import annotations

import numpy as np
from scipy import stats

from agents.statistics import Interval
from agents.suite.card import DONE, Card, CellResult
from agents.suite.cells import Suite


def normalised_score(result: CellResult, zero: CellResult, one: CellResult) -> Interval:
    """Return a normalised score with its 95 % interval over traffic seeds.

    With mean errors E, it is (E_zero - E) / (E_zero - E_one), above 1 for a policy that is better
    than the oracle. The interval is that of a ratio of means of paired values, by linearisation.

    Raises:
        ValueError: The results are not of the same traffic, or the oracle is no better than the
            paper's schedule, so that there is no scale.
    """
    if not result.traffic_seeds == zero.traffic_seeds == one.traffic_seeds:
        raise ValueError(f"results of cell {result.cell!r} must be of the same traffic seeds")
    base, reached, best = (np.array(each.error) for each in (zero, result, one))
    span = float((base - best).mean())
    if span <= 0.0:
        raise ValueError(f"in cell {result.cell!r} the error oracle is no better than the schedule")
    score = float((base - reached).mean()) / span
    residual = (base - reached) - score * (base - best)
    spread = float(stats.t.ppf(0.975, len(base) - 1)) * float(stats.sem(residual)) / span
    return Interval(score, score - spread, score + spread, len(base))


def scores(card: Card, zero: Card, one: Card, suite: Suite) -> dict[str, Interval]:
    """Return the normalised scores of the cells that a card and both references have done."""
    found = {}
    for cell in suite.cells:
        results = [each.results.get(cell.name) for each in (card, zero, one)]
        done = [each for each in results if each is not None and each.status == DONE]
        if len(done) == 3:
            found[cell.name] = normalised_score(*done)
    return found


def suite_score(by_cell: dict[str, Interval], suite: Suite) -> float | None:
    """Return the mean score over the cells; None where one is missing or has failed."""
    if set(by_cell) != {cell.name for cell in suite.cells}:
        return None
    return float(np.mean([each.mean for each in by_cell.values()]))
