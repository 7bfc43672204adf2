"""Attack the privacy of an environment, and bound from below what its releases reveal.

python scripts/audit.py --env dptse_env:dptse/PrivateHighway-v1 --runs 5000
python scripts/audit.py --env dptse_env:dptse/PaperHighway-v0 --target replaced
python scripts/audit.py --env dptse_env:dptse/PrivateHighway-v0 --noise-factor 0.709
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

from agents.audit.attack import attack
from agents.audit.planner import TARGET_KINDS, choose_target, make_planner, make_policy
from agents.audit.report import Finding
from agents.audit.statistics import Claim, audit
from agents.audit.strategies import STRATEGIES
from agents.environments import make_config, parse_env
from agents.files import refuse_to_replace
from agents.play import Cell
from dptse_env.config import EnvConfig
from dptse_env.parts import privacy_report
from dptse_env.privacy import mu_of
from dptse_env.release import PrivacyReport
from dptse_env.utils.fields import inside, integer, positive, require
from scripts.cli import Environment, Machines


@dataclass(frozen=True)
class Args(Environment, Machines):
    """Audit the privacy of an environment."""

    env: str = "dptse_env:dptse/PrivateHighway-v1"
    """Environment id."""
    target: str = "worst-case"
    """Vehicle that differs: 'worst-case', an added one; 'replaced' or 'deleted', of the record;
    for preset 'paced' also 'opposite', two added ones that deviate in opposite directions, and of
    the record 'runs-out', which is refused most, 'jam', which stands longest, and 'late', which
    enters in the second half."""
    policy: str = "hunter"
    """Queries: 'hunter', 'adaptive', or a public schedule: 'paper', 'static', 'round-robin'."""
    runs: int = 5000
    """Runs in each of the two worlds."""
    noise_factor: float = 1.0
    """Multiplies the real noise, not the declared one; below 1 shows that the audit can reject."""
    traffic_seed: int = 0
    """Traffic seed of the record."""
    estimator: str | None = None
    """Estimator that the prices of 'paced' follow; the environment's own if not given, as all
    below."""
    privacy: str | None = None
    """Privacy preset."""
    epsilon: float | None = None
    """Privacy parameter epsilon."""
    delta: float | None = None
    """Privacy parameter delta."""
    unit: str | None = None
    """Protected unit: 'trip', 'horizon' or 'event'."""
    cap: int | None = None
    """Queried steps in which a vehicle counts, for 'capped'."""
    pace: float | None = None
    """Part of the budget that should be spent at the end of a trip, for 'paced'."""
    clip: float | None = None
    """Largest deviation of a speed that is released [km/h], for 'paced'."""
    ratio: float | None = None
    """Ratio of the charges for the largest deviation and for being counted, for 'paced'."""
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
    output: Path = Path("results/audit")
    """Folder for the result, a JSON file."""
    force: bool = False
    """Replace the file of an earlier audit."""
    json: bool = False
    """Print the result as JSON, for a program, in place of a table."""


PRIVACY = (
    "epsilon", "delta", "unit", "cap", "pace", "clip", "ratio", "adjacency", "boundary_inputs",
)  # fmt: skip
"""Arguments that are settings of the release model."""


def attacked_config(args: Args) -> EnvConfig:
    """Return the configuration of the environment under attack.

    Raises:
        ValueError: A setting of the release model is given twice, another value is bad, or the
            estimator does not suit the road.
    """
    env, keywords = parse_env(args.env)
    privacy = {name: getattr(args, name) for name in PRIVACY} | {"preset": args.privacy}
    privacy = {name: value for name, value in privacy.items() if value is not None}
    if privacy:
        if "privacy" in keywords:
            raise ValueError(
                f"privacy must be given once, as arguments or among the keywords, got {privacy} "
                "as well"
            )
        keywords["privacy"] = privacy
    for name in ("bandwidth", "estimator"):
        if getattr(args, name) is not None:
            keywords[name] = getattr(args, name)
    Cell(env, "none", keywords).check()
    return make_config(env, keywords)


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
    kinds = list(TARGET_KINDS)
    require(args.target in kinds, "target", f"one of {kinds}", args.target)
    require(args.policy in STRATEGIES, "policy", f"one of {list(STRATEGIES)}", args.policy)
    integer("runs", args.runs, 2)
    integer("traffic_seed", args.traffic_seed, 0)
    integer("seed", args.seed, 0)
    positive("noise_factor", args.noise_factor)
    inside("confidence", args.confidence, 0.0, 1.0)


def make_title(args: Args, config: EnvConfig) -> str:
    """Return the environment and its claim in words."""
    privacy = config.privacy
    claim = f"({privacy.epsilon:g}, {privacy.delta:g})"
    return f"{parse_env(args.env)[0].rpartition('/')[2]}, preset {privacy.preset} at {claim}"


def run_audit(args: Args, config: EnvConfig) -> Finding:
    """Choose two worlds, play them, and test the claim."""
    executor = args.start_executor()
    library = args.library(config.corridor, [args.traffic_seed])
    record = library.get(config.corridor, args.traffic_seed).vehicles_for("an audit")
    worlds = choose_target(config, record, args.target, args.policy)
    policy = make_policy(config, args.policy, worlds)
    start = time.perf_counter()
    runs = attack(
        config,
        worlds,
        policy,
        args.runs,
        noise_factor=args.noise_factor,
        seed=args.seed,
        executor=executor,
    )
    seconds = time.perf_counter() - start
    report = privacy_report(config)
    return Finding(
        title=make_title(args, config),
        target=worlds.description,
        policy=args.policy,
        n_runs=args.runs,
        noise_factor=args.noise_factor,
        distance=float(runs.distances.max()),
        result=audit(runs.scores[0], runs.scores[1], make_claim(report), args.confidence),
        privacy=report,
        seconds=seconds,
    )


def result_path(args: Args, config: EnvConfig) -> Path:
    """Return the file of the result."""
    noise = args.noise_factor
    ending = "" if noise == 1.0 else f"-noise-{noise:g}"
    return args.output / f"{config.privacy.preset}-{args.target}-{args.policy}{ending}.json"


def main(args: Args) -> None:
    """Attack, and leave table and file."""
    check(args)
    config = attacked_config(args)
    make_planner(config, args.policy).require_kind(args.target)
    path = result_path(args, config)
    refuse_to_replace([path], args.force)
    finding = run_audit(args, config)
    finding.write(path, dataclasses.asdict(args))
    if args.json:
        print(path.read_text(encoding="utf-8"), end="")
        return
    finding.print()
    print(f"the result is in {path}")
