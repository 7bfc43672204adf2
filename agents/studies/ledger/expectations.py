"""Expectations of paced ledgers from an earlier trial, and the verdicts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from agents.experiments.cells import DENSITY
from agents.statistics import Interval
from agents.studies.ledger.cell import CAPPED, DEMAND, EXACT, PACED, PLAIN, REFERENCE
from agents.studies.ledger.results import REFUSED, LedgerResults


@dataclass(frozen=True)
class Expectation:
    """A density error, a difference or a share that was expected to be at most a limit.

    Attributes:
        statement: What is measured, with places for values of the ``design``.
        measure: Returns the number with its interval.
        limit: The limit.
        unit: Unit of both.
        needs_pairs: Whether it is about sums over neighbours.
    """

    statement: str
    measure: Callable[[LedgerResults], Interval]
    limit: float
    unit: str = "veh/km"
    needs_pairs: bool = False

    def verdict(self, interval: Interval) -> str:
        """Return ``met``, ``missed`` or, if the limit lies within the interval, ``undecided``."""
        if interval.high <= self.limit:
            return "met"
        return "missed" if interval.low > self.limit else "undecided"


def _alone(results: LedgerResults) -> Interval:
    design = results.design
    paced = design.cell(PACED, PLAIN, schedule=REFERENCE)
    return results.difference(paced, design.shipped, DENSITY)


def _same_filter(results: LedgerResults) -> Interval:
    design = results.design
    capped, paced = (design.cell(each, DEMAND, schedule=REFERENCE) for each in (CAPPED, PACED))
    return results.difference(paced, capped, DENSITY)


def _against_shipped(results: LedgerResults) -> Interval:
    return results.percent(results.design.cell(), results.design.shipped)


def _sums(results: LedgerResults) -> Interval:
    return results.difference(results.design.sums(), results.design.cell(), DENSITY)


def _low_epsilon(results: LedgerResults) -> Interval:
    design = results.design
    low = (design.cell if design.single_only else design.sums)(epsilon=design.low_epsilon)
    return results.difference(low, design.shipped, DENSITY)


def _to_floor(results: LedgerResults) -> Interval:
    design = results.design
    return results.percent(design.cell(), design.cell(EXACT))


def _refused(results: LedgerResults) -> Interval:
    return results.mean(results.design.cell(), REFUSED)


EXPECTATIONS = (
    Expectation("`paced` − `capped` with the shipped EKF, schedule `paper`", _alone, 0.0),
    Expectation(
        "`paced` − `capped` where both have demand states, schedule `paper`", _same_filter, 0.0
    ),
    Expectation(
        "`paced` with demand states and the base schedule, against `capped` as shipped",
        _against_shipped, -30.0, "%",
    ),
    Expectation(
        "Sums over two neighbours − as many single segments", _sums, 0.0,
        needs_pairs=True,
    ),
    Expectation(
        "`paced` at ε = {design.low_epsilon:g} − `capped` as shipped at ε = {design.epsilon:g}",
        _low_epsilon, 0.0,
    ),
    Expectation("`paced`, over the floor without noise", _to_floor, 40.0, "%"),
    Expectation("Contributions refused by `paced`", _refused, 0.3, "%"),
)  # fmt: skip
"""The limits are what a trial with another EKF reached, rounded."""


@dataclass(frozen=True)
class Judgement:
    """An expectation and its measurement.

    Attributes:
        statement: What is measured.
        limit: What it was expected to be at most, with its unit.
        measured: Mean and interval.
        unit: Unit of the mean.
        verdict: ``met``, ``missed`` or ``undecided``.
    """

    statement: str
    limit: str
    measured: Interval
    unit: str
    verdict: str


def judge_all(results: LedgerResults) -> list[Judgement]:
    """Return the expectations about what was run, with what was measured and the verdicts."""
    design, found = results.design, []
    for each in EXPECTATIONS:
        if each.needs_pairs and design.single_only:
            continue
        measured = each.measure(results)
        statement, limit = each.statement.format(design=design), f"{each.limit:g} {each.unit}"
        found.append(Judgement(statement, limit, measured, each.unit, each.verdict(measured)))
    return found
