"""Attack the privacy of an environment, and bound from below what its releases reveal.

dptse audit --env dptse_env:dptse/ShortHighway-v0 --trials 100

A rejected claim ends it with status 3.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.audit.planner import Planner
from agents.audit.report import audit_environment, audit_one_run
from agents.environments import heading, make_config, make_vector, parse_env, quietly
from agents.files import write_json
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import integer, positive
from dptse_env.versions import versions_with
from scripts.cli import Command, Environment, Machines, Replacing, Seed, require_open

RESULT = "audit.json"
REJECTED = 3
"""Status of an audit that rejects, unlike that of one that failed."""


@dataclass(frozen=True, kw_only=True)
class Args(Replacing, Seed, Environment, Machines, Command):
    """Audit the privacy of an environment."""

    env: str = "dptse_env:dptse/PrivateHighway-v1"
    target: str = "worst-case"
    """Vehicle that differs: worst-case, replaced or deleted."""
    trials: int = 5000
    """Runs in each of the two worlds."""
    one_run: bool = False
    """One episode with many vehicles that differ."""
    noise_factor: float = 1.0
    """Factor on the real noise, not the declared one; below 1 is to be rejected."""
    traffic_seed: int = 0
    """Traffic seed of the record."""
    output: Path = Path("results/audit")


def main(args: Args) -> None:
    """Attack, and write table and file."""
    # Everything is checked before anything is recorded.
    integer("trials", args.trials, 2)
    integer("traffic_seed", args.traffic_seed, 0)
    integer("seed", args.seed, 0)
    positive("noise_factor", args.noise_factor)
    env, keywords = parse_env(args.env)
    require_open(keywords)
    with quietly():
        make_vector(env, 1, keywords).process  # noqa: B018 (an estimator may refuse the road)
    config = make_config(env, keywords)
    if args.one_run:
        args.require_unset("with --one-run", "target", "trials", "executor", "address")
    Planner(config).require_kind(args.target)
    require_output(args.output, [RESULT], force=args.force)

    executor = args.start_executor()
    library = args.library(config.corridor, [args.traffic_seed])
    record = library.get(config.corridor, args.traffic_seed).vehicles_for("an audit")
    options: dict[str, Any] = {"noise_factor": args.noise_factor, "seed": args.seed}
    if args.one_run:
        finding = audit_one_run(config, record, **options)
    else:
        options |= {"trials": args.trials, "executor": executor}
        finding = audit_environment(config, record, args.target, **options)
    found = finding.to_dict() | {
        "arguments": {key: str(value) for key, value in dataclasses.asdict(args).items()},
        "versions": versions_with("numpy", "scipy"),
    }
    args.output.mkdir(parents=True, exist_ok=True)
    write_json(args.output / RESULT, found)
    said = f"the result is in {args.output / RESULT}"
    title = f"{heading(env, keywords)}, estimator {config.estimator}"
    args.answer(found, *finding.report(title), said)
    if finding.verdict == "rejected":
        raise SystemExit(REJECTED)
