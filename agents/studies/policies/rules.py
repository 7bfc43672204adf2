"""What a learned policy must reach, as rules that were stated beforehand, and the verdicts."""

from __future__ import annotations

from dataclasses import dataclass

from agents.evaluation.statistics import Interval
from agents.studies.policies.plan import REFERENCE, Learner
from agents.studies.policies.results import Measured

LEAST_RUNS, LEAST_TRAFFIC = 5, 64
"""Training seeds and test seeds without which nothing counts as reached."""

RULES = f"""\
The error of an episode is the mean over its seconds from 60 on of the normalised RMSE: density in
units of the jam density and speed in units of the speed scale, pooled over the mainline segments;
it is minus the environment's reward, and shown × 1000. *Percent below* is 100 (1 − mean error of
the policy / mean error of the reference), over all training seeds and test seeds.

- **Best baseline**: of all schedules that need no training, the one of least mean error on
  validation traffic. Which is best on test traffic is told beside it, and decides nothing.
- **Learned policy**: of all recipes, each acting deterministically and by drawing, the one of least
  mean error on validation traffic, all its training seeds together.
- **Intervals**: 95 %, percentile, two-level bootstrap: training seeds and traffic seeds are drawn
  with replacement, crossed, the same traffic for both policies. For the worst training seed, the
  one of largest mean error on test traffic, over traffic seeds alone; that it was picked in
  hindsight makes this the stricter.
- A target is **met** if for the mean over training seeds and for the worst training seed alike the
  percentage is at least the target's and its interval lies above zero, with at least
  {LEAST_RUNS} training seeds and {LEAST_TRAFFIC} test seeds. Otherwise it is **missed**.
- **Secondary cells** have no target. Baseline minus learned is tested against zero by Student's t
  for crossed random effects (with one training seed the paired t test), and Holm's procedure keeps
  the error over all secondary comparisons together at 5 %."""


@dataclass(frozen=True)
class Target:
    """What must be reached against one reference.

    Attributes:
        says: The target in words.
        percent: Least percentage below the reference.
        baseline: The reference; empty for the best baseline of the validation traffic.
    """

    says: str
    percent: float
    baseline: str = ""


TARGETS = (
    Target("below the best baseline that needs no training", 8.0),
    Target("below the paper's schedule", 15.0, REFERENCE),
)


@dataclass(frozen=True)
class Verdict:
    """What became of a target.

    Attributes:
        target: The target.
        reference: The schedule that it was held against.
        overall: Percent below, all training seeds together.
        worst: Percent below of the worst training seed.
        worst_seed: Which that is.
        enough: Whether there were enough training seeds and test seeds.
    """

    target: Target
    reference: str
    overall: Interval
    worst: Interval
    worst_seed: int
    enough: bool

    @property
    def parts(self) -> dict[str, bool]:
        """What a target needs, and whether it is so."""
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
        """Whether all of it is so."""
        return all(self.parts.values())


def judge(measured: Measured, learner: Learner, target: Target) -> Verdict:
    """Hold a learned policy of the primary cell against a target, by `RULES`."""
    reference = target.baseline or measured.choice(learner.cell).baseline
    own, other = measured.learned(learner), measured.schedule(learner.cell, reference)
    place = measured.worst(learner)
    return Verdict(
        target=target,
        reference=reference,
        overall=measured.below(own, other),
        worst=measured.below(own[place], other),
        worst_seed=measured.manifest.runs(learner)[place],
        enough=len(own) >= LEAST_RUNS and own.shape[1] >= LEAST_TRAFFIC,
    )
