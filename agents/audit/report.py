"""An audit from the record to its finding, which is a table and a file."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from rich.table import Table

from agents.audit.attack import attack
from agents.audit.one_run import KINDS, attack_in_one_run
from agents.audit.planner import Planner
from agents.audit.residuals import NoiseTest, examine, residuals_of
from agents.audit.statistics import AuditResult, Claim, audit, audit_coins
from agents.executors import Executor, this_process
from agents.terminal import make_table
from dptse_env.config import EnvConfig
from dptse_env.parts import privacy_report
from dptse_env.privacy import mu_of, rounded_up
from dptse_env.release import PrivacyReport
from dptse_env.traffic import Record


class Attack(NamedTuple):
    """An attack that was made.

    Attributes:
        target: The difference of the two worlds, or of all canaries, in words.
        distance: Largest distance between the worlds' true sums, in units of the noise: the
            largest mu that this attack can show. For one run, the distance at which equal canaries
            would expect as many errors.
        result: The statistical test.
    """

    target: str
    distance: float
    result: AuditResult


@dataclass(frozen=True)
class Finding:
    """The finding of one audit.

    Attributes:
        attack: The attack and what it says.
        noise: The test of the noise of some other episodes.
        noise_factor: What the real noise was multiplied by.
        privacy: What the release model states.
        seconds: The time that it took.
    """

    attack: Attack
    noise: NoiseTest
    noise_factor: float
    privacy: PrivacyReport
    seconds: float

    @property
    def verdict(self) -> Literal["rejected", "not rejected"]:
        """``rejected`` if a bound lies above the claim, or the noise is not as stated."""
        return "rejected" if self.noise.is_rejected else self.attack.result.verdict

    def report(self, title: str) -> list[str | Table]:
        """Return the bounds and what they rest on; the verdict is the last line."""
        columns = "claimed", "lower\nbound", "threshold", "false +", "false -"
        table = make_table(title, "", *columns)
        target, distance, result = self.attack
        claim = result.claim
        rows = [("mu", claim.mu, result.mu)]
        if result.epsilon is not None:
            rows.append((f"epsilon at delta {claim.delta:g}", claim.epsilon, result.epsilon))
        for name, claimed, bound in rows:
            rates = f"<= {bound.false_positives:.4f}", f"<= {bound.false_negatives:.4f}"
            row = rounded_up(claimed, ".3f"), f"{bound.value:.3f}", f"{bound.threshold:.2f}", *rates
            table.add_row(name, *row)
        trials = f"at most, in {result.n} runs per world"
        if result.is_one_run:
            trials = f"by the expected errors at {result.n} canaries of one run"
        most = f"without any error, so many show a mu of {result.most:.3f}"
        if result.most <= claim.mu:
            most += ": too few to reject this claim, however much leaks"
        lines = [
            f"worlds: {target}; noise x {self.noise_factor:g}",
            f"distance: {distance:.3f} standard deviations {trials} ({self.seconds:.0f} s), "
            f"{distance / claim.mu:.4f} times the claim",
            most,
            f"noise: {'rejected' if self.noise.is_rejected else 'not rejected'} by "
            f"{self.noise.n} residuals of other episodes, p = {self.noise.p_value:.2g}; "
            f"most suspect: {self.noise.suspect}",
        ]
        if "boundary_inputs" in self.privacy.void_reasons:
            lines.append(
                'only the releases were attacked: boundary_inputs is "true", so the estimates use '
                "the true traffic at the boundary, and their epsilon is infinite"
            )
        if "loops" in self.privacy.details:
            lines.append(
                "only reports were replaced or left out: loops count the other vehicles alone, in "
                "both worlds alike; what they show is public, and no guarantee covers it"
            )
        verdict = f"verdict: {self.verdict}, at confidence {result.confidence:.0%}"
        return [table, *lines, verdict]

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as plain JSON."""
        return {
            "verdict": self.verdict,
            **self.attack._asdict(),
            "result": dataclasses.asdict(self.attack.result),
            "most": self.attack.result.most,
            "noise": dataclasses.asdict(self.noise),
            "noise_factor": self.noise_factor,
            "privacy": self.privacy.to_dict(),
            "seconds": self.seconds,
        }


def audit_environment(
    config: EnvConfig,
    record: Record,
    target: str = "worst-case",
    *,
    trials: int = 5000,
    noise_factor: float = 1.0,
    seed: int = 0,
    executor: Executor = this_process,
) -> Finding:
    """Test the noise, choose two worlds, play both, and test the claim to users.

    Args:
        config: The configuration under attack, of `agents.environments.make_config`.
        record: The traffic, whose vehicles are known.
        target: Kind of the vehicle that differs, in `agents.audit.planner.KINDS`.
        trials: Runs in each of the two worlds, >= 2.
        noise_factor: Multiplies the real noise, not the declared one.
        seed: Seeds the noise, >= 0.
        executor: Plays the runs.

    Raises:
        ValueError: The kind is unknown or does not suit the environment, the record has too few
            vehicles, or the release model cannot be checked (`residuals_of`).
    """
    planner = Planner(config)
    planner.require_kind(target)

    def attacked(claim: Claim) -> Attack:
        worlds = planner.choose(record, target)
        options: dict[str, Any] = {"noise_factor": noise_factor, "seed": seed, "executor": executor}
        runs = attack(config, worlds, planner.plan(worlds), trials, **options)
        result = audit(runs.scores[0], runs.scores[1], claim)
        return Attack(worlds.description, float(runs.distances.max()), result)

    return _finding(config, record, attacked, noise_factor, seed)


def audit_one_run(
    config: EnvConfig,
    record: Record,
    *,
    noise_factor: float = 1.0,
    seed: int = 0,
) -> Finding:
    """Test the noise, and the claim to users on one episode with many canaries.

    `agents.audit.statistics` has what the bound rests on: the noise of different numbers is
    independent by the claim.

    Args:
        config: The configuration under attack, of `agents.environments.make_config`.
        record: The other vehicles.
        noise_factor: Multiplies the real noise, not the declared one.
        seed: Seeds coins and noise, >= 0.

    Raises:
        ValueError: The release model cannot be checked (`residuals_of`).
    """

    def attacked(claim: Claim) -> Attack:
        run = attack_in_one_run(config, record, noise_factor=noise_factor, seed=seed)
        target = f"each added vehicle {KINDS[run.design.kind]}, for {run.design.slot} s"
        result = audit_coins(run.scores, run.coins, claim)
        return Attack(target, run.distance, result)

    return _finding(config, record, attacked, noise_factor, seed)


def _finding(
    config: EnvConfig,
    record: Record,
    attacked: Callable[[Claim], Attack],
    noise_factor: float,
    seed: int,
) -> Finding:
    """Test the noise, and attack the claim to users."""
    report, start = privacy_report(config), time.perf_counter()
    noise = examine(residuals_of(config, record, noise_factor=noise_factor, seed=seed))
    attack = attacked(claim_of(report))
    return Finding(attack, noise, noise_factor, report, time.perf_counter() - start)


def claim_of(report: PrivacyReport) -> Claim:
    """Return what users are told: the account of a guarantee, or else the requested parameters."""
    epsilon, delta = report.claimed_epsilon, report.claimed_delta
    mu = mu_of(epsilon, delta) if report.guarantee == "none" else report.mu
    return Claim(mu, epsilon, delta)
