"""Targets for a learned policy, stated before any test, and their verdicts."""

from __future__ import annotations

from dataclasses import dataclass

from agents.statistics import Interval
from agents.studies.policies.plan import REFERENCE, Learner
from agents.studies.policies.results import PolicyResults

LEAST_RUNS, LEAST_TRAFFIC = 5, 64
"""Least training seeds and test seeds for a target to be met."""


@dataclass(frozen=True)
class PolicyTarget:
    """A percentage that a policy must lie below a reference.

    Attributes:
        percent: Least percentage below the reference.
        baseline: The reference; empty for the best baseline of the validation traffic.
    """

    description: str
    percent: float
    baseline: str = ""


POLICY_TARGETS = (
    PolicyTarget("below the best baseline that needs no training", 8.0),
    PolicyTarget("below the paper's schedule", 15.0, REFERENCE),
)


@dataclass(frozen=True)
class TargetVerdict:
    """Measurement and verdict of a target.

    Attributes:
        overall: Percent below, all training seeds together.
        worst: Percent below of the worst training seed.
        enough: Whether there were enough training seeds and test seeds.
    """

    target: PolicyTarget
    reference: str
    overall: Interval
    worst: Interval
    worst_seed: int
    enough: bool

    @property
    def parts(self) -> dict[str, bool]:
        """Conditions of the target, and whether they hold."""
        percent = self.target.percent
        return {
            f"mean at least {percent:g} %": self.overall.mean >= percent,
            "its interval above zero": self.overall.low > 0.0,
            f"worst training seed at least {percent:g} %": self.worst.mean >= percent,
            "its interval above zero too": self.worst.low > 0.0,
            f"{LEAST_RUNS} training seeds and {LEAST_TRAFFIC} test seeds": self.enough,
        }

    @property
    def is_met(self) -> bool:
        """True if all conditions hold."""
        return all(self.parts.values())


def judge(results: PolicyResults, learner: Learner, target: PolicyTarget) -> TargetVerdict:
    """Judge a learned policy of the primary cell by the rules of the report."""
    reference = target.baseline or results.choice(learner.cell).baseline
    errors, other = results.learned(learner), results.schedule(learner.cell, reference)
    place = results.worst(learner)
    return TargetVerdict(
        target=target,
        reference=reference,
        overall=results.below(errors, other),
        worst=results.below(errors[place], other),
        worst_seed=results.manifest.runs(learner)[place],
        enough=len(errors) >= LEAST_RUNS and errors.shape[1] >= LEAST_TRAFFIC,
    )
