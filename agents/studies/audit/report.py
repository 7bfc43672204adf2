"""What an audit found: its numbers, a table and a file."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from dptse_env.privacy import PrivacyReport, epsilon_of
from dptse_env.privacy.audit import AuditResult, detectable_mu, rejection_probability

VIOLATION = math.sqrt(2.0)
"""How far beyond the claim the reported power looks: noise divided by 1.41."""

RAW_BOUNDARY = (
    "The estimator is fed the true traffic at the boundary besides: epsilon is infinite for what "
    "it publishes. This audit attacks the noisy releases alone."
)


@dataclass(frozen=True)
class Finding:
    """One audit.

    Attributes:
        title: Says what was attacked.
        target: The difference of the two worlds in words.
        policy: Name of the policy.
        n_runs: Runs per world.
        noise_factor: By which the declared noise was multiplied.
        distance: Largest distance between the worlds' true answers, in units of the noise: the mu
            that this attack can show at best.
        result: What the scores say about the claim.
        privacy: The configuration's own account.
        seconds: That the runs took.
    """

    title: str
    target: str
    policy: str
    n_runs: int
    noise_factor: float
    distance: float
    result: AuditResult
    privacy: PrivacyReport
    seconds: float

    @property
    def gaussian_epsilon(self) -> float:
        """The epsilon, at the claim's delta, of a Gaussian release with the bound on mu."""
        mu = self.result.mu.value
        return epsilon_of(mu, self.result.claim.delta) if mu > 0.0 else 0.0

    @property
    def power(self) -> float:
        """Probability of rejecting a mechanism that leaks `VIOLATION` times what is claimed."""
        result, claimed = self.result, self.result.claim.mu
        return rejection_probability(VIOLATION * claimed, claimed, self.n_runs, result.confidence)

    @property
    def detectable(self) -> float:
        """The mu from which on a claim is rejected with probability 95 %, or infinity."""
        return detectable_mu(self.result.claim.mu, self.n_runs, self.result.confidence)

    def print(self) -> None:
        """Print the table and the verdict."""
        console = Console()
        table = Table(box=box.SIMPLE_HEAD, title=self.title, title_justify="left")
        for column in ("", "claimed", "lower\nbound", "threshold", "false +", "false -"):
            table.add_column(column, justify="right" if column else "left", no_wrap=True)
        claim, bounds = self.result.claim, (self.result.mu, self.result.epsilon)
        names = "mu", f"epsilon at delta {claim.delta:g}"
        for name, claimed, bound in zip(names, (claim.mu, claim.epsilon), bounds, strict=True):
            rates = f"<= {bound.false_positives:.4f}", f"<= {bound.false_negatives:.4f}"
            row = f"{claimed:.3f}", f"{bound.value:.3f}", f"{bound.threshold:.2f}", *rates
            table.add_row(name, *row)
        console.print(table)
        for line in self.lines():
            console.print(line, highlight=False, soft_wrap=True)

    def lines(self) -> list[str]:
        """Return the rest in sentences, the verdict last."""
        mu, reach = self.detectable, self.noise_factor * self.distance
        reachable = (
            f"Rejects with probability 95 % from a mu of {mu:.3f} on, which this attack reaches "
            f"up to {reach / mu:.3f} times the declared noise."
            if math.isfinite(mu)
            else "With so few runs this claim cannot be rejected, however much leaks."
        )
        return [
            f"Worlds: {self.target}; queries: {self.policy}; noise x {self.noise_factor:g}.",
            f"Their distance is {self.distance:.3f} sigma at most. {self.n_runs} runs per world "
            f"in {self.seconds:.0f} s.",
            f"A Gaussian release of the bound on mu has epsilon {self.gaussian_epsilon:.3f}.",
            f"Power: a mu of {VIOLATION:.2f} times the claim would be rejected with probability "
            f"{self.power:.4f}. {reachable}",
            *([RAW_BOUNDARY] if "boundary_inputs" in self.privacy.void_reasons else []),
            f"Verdict: {self.result.verdict}, at confidence {self.result.confidence:.0%}.",
        ]

    def write(self, path: Path, arguments: Mapping[str, Any]) -> None:
        """Write all of it to a JSON file, with its origin."""
        own = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if field.name not in ("result", "privacy")
        }
        content = own | {
            "verdict": self.result.verdict,
            "result": dataclasses.asdict(self.result),
            "gaussian_epsilon": self.gaussian_epsilon,
            "power": self.power,
            "detectable_mu": self.detectable if math.isfinite(self.detectable) else None,
            "privacy": self.privacy.to_dict(),
            "arguments": {key: str(value) for key, value in arguments.items()},
            "versions": {name: version(name) for name in ("dptse-env", "numpy", "scipy")},
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
