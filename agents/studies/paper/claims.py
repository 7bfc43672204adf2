"""What a claim is, and the one rule by which it holds or does not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from agents.evaluation.statistics import Interval
from agents.studies.paper.plan import Setting
from agents.studies.paper.results import Measured, UnmeasuredError

Verdict = Literal["holds", "does not hold", "undecided", "not measured"]

RULE = """\
Every claim is split into parts. A part is one number for each traffic seed, mostly a difference of
two errors on the same traffic and the same noise; its mean over the seeds has a 95 % interval
(Student's t). The claim says beforehand in which range the number should lie.

- A part **holds** if its whole interval lies inside the range.
- A part **does not hold** if its whole interval lies outside the range.
- A part is **undecided** otherwise: the interval includes an end of the range, mostly zero.

A claim **holds** if all its parts hold, and **does not hold** if at least one part does not.
Otherwise it is **undecided**. Intervals are not widened for the number of parts: of a hundred parts
whose true value lies at an end of the range, about five will be decided by chance."""


@dataclass(frozen=True)
class Range:
    """An open range of values.

    Attributes:
        low: Lower end.
        high: Upper end.
    """

    low: float = -math.inf
    high: float = math.inf

    def __str__(self) -> str:
        """Say it in words."""
        if self.low == -math.inf:
            return f"below {self.high:g}"
        if self.high == math.inf:
            return f"above {self.low:g}"
        return f"between {self.low:g} and {self.high:g}"


BELOW_ZERO = Range(high=0.0)
ABOVE_ZERO = Range(low=0.0)


@dataclass(frozen=True)
class Claim:
    """Something that measurements can support or refute.

    Attributes:
        key: Short name.
        says: The claim.
        measured: What the numbers are.
        unit: Their unit.
        expected: Where they should lie.
        measure: Returns the interval of each part by its name.
    """

    key: str
    says: str
    measured: str
    unit: str
    expected: Range
    measure: Callable[[Measured, Setting], Mapping[str, Interval]]


@dataclass(frozen=True)
class Outcome:
    """What became of a claim under one setting.

    Attributes:
        claim: The claim.
        setting: The setting.
        parts: Interval and verdict by the name of the part; empty if not measured.
        verdict: That of the whole claim.
    """

    claim: Claim
    setting: Setting
    parts: dict[str, tuple[Interval, Verdict]]
    verdict: Verdict


def judge_part(interval: Interval, expected: Range) -> Verdict:
    """Return whether an interval lies inside a range, outside of it, or across an end."""
    if expected.low < interval.low and interval.high < expected.high:
        return "holds"
    if interval.high < expected.low or interval.low > expected.high:
        return "does not hold"
    return "undecided"


def combine(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the verdict of a claim from those of its parts.

    Raises:
        ValueError: There are no parts.
    """
    verdicts = set(verdicts)
    if not verdicts:
        raise ValueError("a claim needs at least one part")
    if "does not hold" in verdicts:
        return "does not hold"
    return "holds" if verdicts == {"holds"} else "undecided"


def judge(claim: Claim, measured: Measured, setting: Setting) -> Outcome:
    """Measure a claim under a setting and judge it by `RULE`."""
    try:
        intervals = claim.measure(measured, setting)
    except UnmeasuredError:
        return Outcome(claim, setting, {}, "not measured")
    parts = {name: (own, judge_part(own, claim.expected)) for name, own in intervals.items()}
    return Outcome(claim, setting, parts, combine(verdict for _, verdict in parts.values()))
