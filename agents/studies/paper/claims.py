"""Claims about measurements, and the rule by which they hold or do not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from agents.experiments.cells import UnmeasuredError
from agents.statistics import Interval
from agents.studies.paper.plan import SETTINGS, Setting
from agents.studies.paper.results import PaperResults

Verdict = Literal["holds", "does not hold", "undecided", "not measured"]


@dataclass(frozen=True)
class ExpectedRange:
    """An open range of values."""

    low: float = -math.inf
    high: float = math.inf

    def __str__(self) -> str:
        """Return the range in words."""
        if self.low == -math.inf:
            return f"below {self.high:g}"
        if self.high == math.inf:
            return f"above {self.low:g}"
        return f"between {self.low:g} and {self.high:g}"


BELOW_ZERO = ExpectedRange(high=0.0)
ABOVE_ZERO = ExpectedRange(low=0.0)


@dataclass(frozen=True)
class Claim:
    """A statement that measurements can support or refute.

    Attributes:
        expected: Range in which the quantity should lie.
        measure: Returns the interval of each part by its name.
    """

    key: str
    statement: str
    quantity: str
    unit: str
    expected: ExpectedRange
    measure: Callable[[PaperResults, Setting], Mapping[str, Interval]]


@dataclass(frozen=True)
class Outcome:
    """Measurement and verdict of a claim under one setting.

    Attributes:
        parts: Interval and verdict by the name of the part; empty if not measured.
    """

    claim: Claim
    setting: Setting
    parts: dict[str, tuple[Interval, Verdict]]
    verdict: Verdict


def judge_part(interval: Interval, expected: ExpectedRange) -> Verdict:
    """Judge a part by whether its interval lies inside a range, outside of it, or across an end."""
    if expected.low < interval.low and interval.high < expected.high:
        return "holds"
    if interval.high < expected.low or interval.low > expected.high:
        return "does not hold"
    return "undecided"


def combine(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the verdict of a claim from the verdicts of its parts.

    Raises:
        ValueError: There are no parts.
    """
    verdicts = set(verdicts)
    if not verdicts:
        raise ValueError("a claim needs at least one part")
    if "does not hold" in verdicts:
        return "does not hold"
    return "holds" if verdicts == {"holds"} else "undecided"


def judge(claim: Claim, results: PaperResults, setting: Setting) -> Outcome:
    """Measure a claim under a setting and judge it by the rule of the report."""
    try:
        intervals = claim.measure(results, setting)
    except UnmeasuredError:
        return Outcome(claim, setting, {}, "not measured")
    parts = {
        name: (interval, judge_part(interval, claim.expected))
        for name, interval in intervals.items()
    }
    return Outcome(claim, setting, parts, combine(verdict for _, verdict in parts.values()))


def judge_all(claims: Iterable[Claim], results: PaperResults) -> list[list[Outcome]]:
    """Judge each claim under every setting."""
    return [[judge(claim, results, setting) for setting in SETTINGS] for claim in claims]
