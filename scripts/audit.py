"""Attack the privacy of an environment, and bound from below what its releases reveal.

dptse audit --env dptse_env:dptse/ShortHighway-v0 --runs 100
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.audit.report import audit_environment, audit_one_run, check_target
from agents.environments import make_config, make_vector, parse_env, quietly
from dptse_env.parts import privacy_report
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import inside, integer, positive, require
from scripts.cli import Environment, Machines


@dataclass(frozen=True)
class Args(Machines, Environment):
    """Audit the privacy of an environment."""

    env: str = "dptse_env:dptse/PrivateHighway-v1"
    """Environment: an id, or an id and keywords as JSON, 'ID {"privacy": {"cap": 16}}'."""
    target: str = "worst-case"
    """Vehicle that differs: worst-case, opposite, replaced or deleted; or climbed, the worst
    one that a search from random trips and queries finds."""
    policy: str = "hunter"
    """Queries: hunter, or a public schedule (shift-ahead, static, round-robin)."""
    runs: int = 5000
    """Runs in each of the two worlds."""
    rounds: int = 100
    """Rounds of the search for the target climbed."""
    one_run: bool = False
    """One episode with many vehicles that differ; target, policy and runs are its own."""
    noise_factor: float = 1.0
    """Factor on the real noise, not the declared one; below 1 is to be rejected."""
    traffic_seed: int = 0
    """Traffic seed of the record."""
    confidence: float = 0.95
    """Confidence of the lower bounds."""
    seed: int = 0
    """Seeds the noise."""
    output: Path = Path("results/audit")
    """Folder for the result, a JSON file."""
    force: bool = False
    """Replace the file of an earlier audit."""
    json: bool = False
    """Print the result as JSON in place of a table."""


def main(args: Args) -> None:
    """Attack, and write table and file."""
    # Everything is checked before anything is recorded.
    integer("runs", args.runs, 2)
    integer("rounds", args.rounds, 0)
    integer("traffic_seed", args.traffic_seed, 0)
    integer("seed", args.seed, 0)
    positive("noise_factor", args.noise_factor)
    inside("confidence", args.confidence, 0.0, 1.0)
    env, keywords = parse_env(args.env)
    with quietly():
        make_vector(env, 1, keywords).process  # noqa: B018 (an estimator may refuse the road)
    config = make_config(env, keywords)
    if args.one_run:
        for name in ("target", "policy", "runs"):
            given = getattr(args, name)
            require(given == getattr(Args, name), name, "left out with --one-run", given)
    check_target(config, args.target, args.policy)
    preset = re.sub(r"\W+", "-", privacy_report(config).preset)
    noise = "" if args.noise_factor == 1.0 else f"-noise-{args.noise_factor:g}"
    attack = "one-run" if args.one_run else f"{args.target}-{args.policy}"
    path = args.output / f"{preset}-{attack}{noise}.json"
    require_output(args.output, [path.name], force=args.force)

    executor = args.start_executor()
    library = args.library(config.corridor, [args.traffic_seed])
    record = library.get(config.corridor, args.traffic_seed).vehicles_for("an audit")
    options: dict[str, Any] = {
        name: getattr(args, name) for name in ("noise_factor", "confidence", "seed")
    }
    if args.one_run:
        finding = audit_one_run(config, record, **options)
    else:
        options |= {"n_runs": args.runs, "rounds": args.rounds, "executor": executor}
        finding = audit_environment(config, record, args.target, args.policy, **options)
    finding = dataclasses.replace(finding, title=f"{env.rpartition('/')[2]}, {finding.title}")
    finding.write(path, dataclasses.asdict(args))
    if args.json:
        print(path.read_text(encoding="utf-8"), end="")
        return
    finding.print()
    print(f"the result is in {path}")
