"""An audit from the record to its finding, which is a table and a file."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from agents.audit.attack import attack
from agents.audit.one_run import KINDS, attack_in_one_run
from agents.audit.planner import Planner
from agents.audit.residuals import NoiseTest, examine, residuals_of
from agents.audit.search import CLIMBED, climb
from agents.audit.statistics import (
    AuditResult,
    Claim,
    audit,
    audit_coins,
    detectable_mu,
    rejection_probability,
)
from agents.executors import Executor, this_process
from agents.files import write_json
from agents.terminal import make_table, print_table, print_text
from dptse_env.config import EnvConfig
from dptse_env.parts import privacy_report
from dptse_env.privacy import epsilon_of, mu_of, rounded_up
from dptse_env.release import PrivacyReport
from dptse_env.traffic import Record
from dptse_env.utils.validation import require
from dptse_env.versions import versions_with

VIOLATION = math.sqrt(2.0)
"""Ratio of a true mu to the claimed one for which power is reported: noise divided by 1.41."""


@dataclass(frozen=True)
class Finding:
    """The finding of one audit.

    Attributes:
        target: The difference of the two worlds, or of all canaries, in words.
        distance: Largest distance between the worlds' true sums, in units of the noise: the
            largest mu that this attack can show. For one run, the distance at which equal canaries
            would expect as many errors.
        noise: The test of the noise of some other episodes.
    """

    title: str
    target: str
    policy: str
    noise_factor: float
    distance: float
    result: AuditResult
    noise: NoiseTest
    privacy: PrivacyReport
    seconds: float

    @property
    def verdict(self) -> Literal["rejected", "not rejected"]:
        """``rejected`` if a bound lies above the claim, or the noise is not as stated."""
        return "rejected" if self.noise.is_rejected else self.result.verdict

    @property
    def gaussian_epsilon(self) -> float:
        """The epsilon, at the claim's delta, of a Gaussian release with the bound on mu."""
        mu = self.result.mu.value
        return epsilon_of(mu, self.result.claim.delta) if mu > 0.0 else 0.0

    @property
    def power(self) -> float:
        """Probability of rejecting a mechanism with a mu of `VIOLATION` times the claim."""
        result, mu = self.result, self.result.claim.mu
        return rejection_probability(
            VIOLATION * mu, mu, result.n, result.confidence, is_one_run=result.is_one_run
        )

    @property
    def detectable(self) -> float:
        """Least mu for which a claim is rejected with probability 95 %, or infinity."""
        result = self.result
        return detectable_mu(
            result.claim.mu, result.n, result.confidence, is_one_run=result.is_one_run
        )

    def print(self) -> None:
        """Print the bounds and what they rest on; the verdict is the last line."""
        columns = "claimed", "lower\nbound", "threshold", "false +", "false -"
        table = make_table(self.title, "", *columns)
        result, claim = self.result, self.result.claim
        rows = [("mu", claim.mu, result.mu)]
        if result.epsilon is not None:
            rows.append((f"epsilon at delta {claim.delta:g}", claim.epsilon, result.epsilon))
        for name, claimed, bound in rows:
            rates = f"<= {bound.false_positives:.4f}", f"<= {bound.false_negatives:.4f}"
            row = rounded_up(claimed, ".3f"), f"{bound.value:.3f}", f"{bound.threshold:.2f}", *rates
            table.add_row(name, *row)
        print_table(table)
        trials = f"at most, in {result.n} runs per world"
        if result.is_one_run:
            trials = f"by the expected errors at {result.n} canaries of one run"
        print_text(
            f"worlds: {self.target}; queries: {self.policy}; noise x {self.noise_factor:g}\n"
            f"distance: {self.distance:.3f} standard deviations {trials} ({self.seconds:.0f} s), "
            f"{self.distance / claim.mu:.4f} times the claim\n"
            f"lower bound on mu, as epsilon at delta {claim.delta:g}: {self.gaussian_epsilon:.3f}\n"
            f"power, the probability of rejecting a mu of {VIOLATION:.2f} times the claim: "
            f"{self.power:.4f}"
        )
        if math.isfinite(self.detectable):
            factor = self.noise_factor * self.distance / self.detectable
            print_text(
                f"sensitivity: it rejects a mu of {self.detectable:.3f} with probability 95 %; "
                f"this target has it if the noise is {factor:.3f} times the declared one"
            )
        else:
            few = "canaries" if result.is_one_run else "runs"
            print_text(f"too few {few} to reject this claim, however much leaks")
        print_text(
            f"noise: {'rejected' if self.noise.is_rejected else 'not rejected'} by "
            f"{self.noise.n} residuals of other episodes, p = {self.noise.p_value:.2g}; "
            f"most suspect: {self.noise.suspect}"
        )
        if "boundary_inputs" in self.privacy.void_reasons:
            print_text(
                'only the releases were attacked: boundary_inputs is "true", so the estimates use '
                "the true traffic at the boundary, and their epsilon is infinite"
            )
        print_text(f"verdict: {self.verdict}, at confidence {result.confidence:.0%}")

    def write(self, path: Path, arguments: Mapping[str, Any]) -> None:
        """Write the finding to a JSON file, with its origin."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        content = fields | {
            "verdict": self.verdict,
            "noise": dataclasses.asdict(self.noise),
            "result": dataclasses.asdict(self.result),
            "gaussian_epsilon": self.gaussian_epsilon,
            "power": self.power,
            "detectable_mu": self.detectable if math.isfinite(self.detectable) else None,
            "privacy": self.privacy.to_dict(),
            "arguments": {key: str(value) for key, value in arguments.items()},
            "versions": versions_with("numpy", "scipy"),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, content)


def audit_environment(
    config: EnvConfig,
    record: Record,
    target: str = "worst-case",
    policy: str = "hunter",
    *,
    n_runs: int = 5000,
    rounds: int = 100,
    noise_factor: float = 1.0,
    confidence: float = 0.95,
    seed: int = 0,
    executor: Executor = this_process,
) -> Finding:
    """Test the noise, choose two worlds, play both, and test the claim to users.

    Args:
        config: The configuration under attack, of `agents.environments.make_config`.
        record: The traffic, whose vehicles are known.
        target: Kind of the vehicle that differs, in `agents.audit.planner.KINDS`, or ``climbed``,
            the worst one that a search from random trips and queries finds.
        policy: Queries, in `agents.audit.planner.POLICIES`; what is searched for takes the place of
            a hunter's.
        n_runs: Runs in each of the two worlds, >= 2.
        rounds: Rounds of the search.
        noise_factor: Multiplies the real noise, not the declared one.
        confidence: Confidence of the lower bounds.
        seed: Seeds the noise, >= 0.
        executor: Plays the runs.

    Raises:
        ValueError: A kind or policy is unknown or does not suit the environment, the record has too
            few vehicles, or the release model cannot be checked (`residuals_of`).
    """
    check_target(config, target, policy)
    report, start = privacy_report(config), time.perf_counter()
    noise = examine(residuals_of(config, record, noise_factor=noise_factor, seed=seed))
    if target == CLIMBED:
        options: dict[str, Any] = {"policy": policy, "seed": seed, "executor": executor}
        worlds, plan = climb(config, record, rounds, **options)
    else:
        planner = Planner(config, policy)
        worlds = planner.choose(record, target)
        plan = planner.plan(worlds)
    runs = attack(
        config,
        worlds,
        plan,
        n_runs,
        noise_factor=noise_factor,
        seed=seed,
        executor=executor,
    )
    claim = claim_of(report)
    return Finding(
        title=_title(report),
        target=worlds.description,
        policy=policy,
        noise_factor=noise_factor,
        distance=float(runs.distances.max()),
        result=audit(runs.scores[0], runs.scores[1], claim, confidence),
        noise=noise,
        privacy=report,
        seconds=time.perf_counter() - start,
    )


def audit_one_run(
    config: EnvConfig,
    record: Record,
    *,
    noise_factor: float = 1.0,
    confidence: float = 0.95,
    seed: int = 0,
) -> Finding:
    """Test the noise, and the claim to users on one episode with many canaries.

    `agents.audit.statistics` has what the bound rests on: the noise of different numbers is
    independent by the claim.

    Args:
        config: The configuration under attack, of `agents.environments.make_config`.
        record: The other vehicles.
        noise_factor: Multiplies the real noise, not the declared one.
        confidence: Confidence of the lower bound on mu.
        seed: Seeds coins and noise, >= 0.

    Raises:
        ValueError: The release model cannot be checked (`residuals_of`).
    """
    report, start = privacy_report(config), time.perf_counter()
    noise = examine(residuals_of(config, record, noise_factor=noise_factor, seed=seed))
    run = attack_in_one_run(config, record, noise_factor=noise_factor, seed=seed)
    return Finding(
        title=_title(report),
        target=f"each added vehicle {KINDS[run.design.kind]}, for {run.design.slot} s",
        policy="where they are",
        noise_factor=noise_factor,
        distance=run.distance,
        result=audit_coins(run.scores, run.coins, claim_of(report), confidence),
        noise=noise,
        privacy=report,
        seconds=time.perf_counter() - start,
    )


def check_target(config: EnvConfig, target: str, policy: str) -> None:
    """Refuse a target or a policy that there is not.

    Raises:
        ValueError: See above.
    """
    targets = [*Planner(config, policy).kinds, CLIMBED]
    require(target in targets, "target", f"one of {targets} here", target)


def claim_of(report: PrivacyReport) -> Claim:
    """Return what users are told: the account of a guarantee, or else the requested parameters."""
    epsilon, delta = report.claimed_epsilon, report.claimed_delta
    mu = mu_of(epsilon, delta) if report.guarantee == "none" else report.mu
    return Claim(mu, epsilon, delta)


def _title(report: PrivacyReport) -> str:
    return f"preset {report.preset} at ({report.claimed_epsilon:g}, {report.claimed_delta:g})"
