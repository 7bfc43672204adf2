"""Attack the privacy of an environment, and bound from below what its releases reveal.

python scripts/audit.py --env dptse_env:dptse/PrivateHighway-v0 --runs 5000
python scripts/audit.py --env dptse_env:dptse/PaperHighway-v0 --target replaced
python scripts/audit.py --env dptse_env:dptse/PrivateHighway-v0 --noise-factor 0.709
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import make_config
from agents.studies.audit.attack import attack
from agents.studies.audit.report import Finding
from agents.studies.audit.strategies import STRATEGIES, make_policy
from agents.studies.audit.targets import TARGET_KINDS, choose_target
from dptse_env.config import EnvConfig
from dptse_env.parts import privacy_report
from dptse_env.privacy import mu_of
from dptse_env.privacy.audit_statistics import Claim, audit
from dptse_env.release import PrivacyReport
from dptse_env.utils.validation import inside, integer, positive, require
from scripts.cli import Recording, run


@dataclass(frozen=True)
class Args:
    """Audit the privacy of an environment."""

    env: str = "dptse_env:dptse/PrivateHighway-v0"
    """Environment id."""
    target: str = "worst-case"
    """Vehicle that differs: 'worst-case', an added one; 'replaced' or 'deleted', of the record."""
    policy: str = "hunter"
    """Queries: 'hunter', 'adaptive', or a public schedule: 'paper', 'static', 'round-robin'."""
    runs: int = 5000
    """Runs in each of the two worlds."""
    noise_factor: float = 1.0
    """Multiplies the declared noise; below 1 shows that the audit can reject."""
    traffic_seed: int = 0
    """Traffic seed of the record."""
    privacy: str | None = None
    """Privacy preset; the environment's own if not given, as all below."""
    epsilon: float | None = None
    """Privacy parameter epsilon."""
    delta: float | None = None
    """Privacy parameter delta."""
    unit: str | None = None
    """Protected unit: 'trip', 'horizon' or 'event'."""
    cap: int | None = None
    """Queried steps in which a vehicle counts."""
    adjacency: str | None = None
    """'replace' or 'add_remove'."""
    boundary_inputs: str | None = None
    """'true', 'nominal' or 'private'."""
    bandwidth: int | None = None
    """Most segments to query a second."""
    confidence: float = 0.95
    """Confidence of the lower bounds."""
    seed: int = 0
    """Seeds the noise."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""
    output: Path = Path("results/audit")
    """Folder for the result, a JSON file."""


def attacked_config(args: Args) -> EnvConfig:
    """Return the configuration of the environment under attack."""
    names = ("epsilon", "delta", "unit", "cap", "adjacency", "boundary_inputs")
    privacy = {name: getattr(args, name) for name in names} | {"preset": args.privacy}
    keywords: dict[str, Any] = {
        "privacy": {name: value for name, value in privacy.items() if value is not None}
    }
    if args.bandwidth is not None:
        keywords["bandwidth"] = args.bandwidth
    return make_config(args.env, keywords)


def make_claim(report: PrivacyReport) -> Claim:
    """Return the claim to users: the account of a guarantee, or else the requested parameters."""
    epsilon, delta = report.claimed_epsilon, report.claimed_delta
    mu = mu_of(epsilon, delta) if report.guarantee == "none" else report.mu
    return Claim(mu, epsilon, delta)


def check(args: Args) -> None:
    """Check the arguments before anything is recorded.

    Raises:
        ValueError: An argument is out of range.
    """
    require(args.target in TARGET_KINDS, "target", f"one of {list(TARGET_KINDS)}", args.target)
    require(args.policy in STRATEGIES, "policy", f"one of {list(STRATEGIES)}", args.policy)
    integer("runs", args.runs, 2)
    integer("traffic_seed", args.traffic_seed, 0)
    integer("seed", args.seed, 0)
    positive("noise_factor", args.noise_factor)
    inside("confidence", args.confidence, 0.0, 1.0)


def run_audit(args: Args) -> Finding:
    """Choose two worlds, play them, and test the claim."""
    check(args)
    config = attacked_config(args)
    library = Recording(records=args.records).library(config.corridor, [args.traffic_seed])
    record = library.get(config.corridor, args.traffic_seed)
    worlds = choose_target(config, record, args.target, args.policy)
    policy = make_policy(config, args.policy, worlds)
    start = time.perf_counter()
    runs = attack(config, worlds, policy, args.runs, noise_factor=args.noise_factor, seed=args.seed)
    seconds = time.perf_counter() - start
    privacy, report = config.privacy, privacy_report(config)
    claim = f"({privacy.epsilon:g}, {privacy.delta:g})"
    return Finding(
        title=f"{args.env.rpartition('/')[2]}, preset {privacy.preset} at {claim}",
        target=worlds.description,
        policy=args.policy,
        n_runs=args.runs,
        noise_factor=args.noise_factor,
        distance=float(runs.distances.max()),
        result=audit(runs.scores[0], runs.scores[1], make_claim(report), args.confidence),
        privacy=report,
        seconds=seconds,
    )


def main(args: Args) -> None:
    """Attack, and leave table and file."""
    finding = run_audit(args)
    finding.print()
    noise = "" if args.noise_factor == 1.0 else f"-noise-{args.noise_factor:g}"
    preset = finding.privacy.preset
    path = args.output / f"{preset}-{args.target}-{args.policy}{noise}.json"
    finding.write(path, dataclasses.asdict(args))
    print(f"the result is in {path}")


if __name__ == "__main__":
    run(main, Args, __doc__)
