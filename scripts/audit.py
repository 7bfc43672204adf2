"""Attack the privacy of an environment, and bound from below what its releases reveal.

dptse audit --env dptse_env:dptse/ShortHighway-v0 --runs 100
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

from agents.audit.planner import Planner
from agents.audit.report import audit_environment
from agents.environments import make_config, parse_env
from agents.files import refuse_to_replace
from agents.play import Cell
from dptse_env.parts import privacy_report
from dptse_env.utils.fields import inside, integer, positive
from scripts.cli import Environment, Machines


@dataclass(frozen=True)
class Args(Environment, Machines):
    """Audit the privacy of an environment."""

    env: str = "dptse_env:dptse/PrivateHighway-v1"
    """Environment: an id, or an id and keywords as JSON, 'ID {"privacy": {"cap": 16}}'."""
    target: str = "worst-case"
    """Vehicle that differs: worst-case, opposite, replaced, deleted, runs-out, jam or late."""
    policy: str = "hunter"
    """Queries: hunter, adaptive, or a public schedule (paper, static, round-robin)."""
    runs: int = 5000
    """Runs in each of the two worlds."""
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
    """Attack, and leave table and file."""
    # Everything is checked before anything is recorded.
    integer("runs", args.runs, 2)
    integer("traffic_seed", args.traffic_seed, 0)
    integer("seed", args.seed, 0)
    positive("noise_factor", args.noise_factor)
    inside("confidence", args.confidence, 0.0, 1.0)
    env, keywords = parse_env(args.env)
    Cell(env, "none", keywords).check()
    config = make_config(env, keywords)
    Planner(config, args.policy).require_kind(args.target)
    preset = re.sub(r"\W+", "-", privacy_report(config).preset)
    noise = "" if args.noise_factor == 1.0 else f"-noise-{args.noise_factor:g}"
    path = args.output / f"{preset}-{args.target}-{args.policy}{noise}.json"
    refuse_to_replace([path], args.force)

    executor = args.start_executor()
    library = args.library(config.corridor, [args.traffic_seed])
    finding = audit_environment(
        config,
        library.get(config.corridor, args.traffic_seed).vehicles_for("an audit"),
        args.target,
        args.policy,
        n_runs=args.runs,
        noise_factor=args.noise_factor,
        confidence=args.confidence,
        seed=args.seed,
        executor=executor,
    )
    finding = dataclasses.replace(finding, title=f"{env.rpartition('/')[2]}, {finding.title}")
    finding.write(path, dataclasses.asdict(args))
    if args.json:
        print(path.read_text(encoding="utf-8"), end="")
        return
    finding.print()
    print(f"the result is in {path}")
