"""Score policies in the cells of a query suite, and leave a card for each; or verify a card.

python scripts/suite.py --policies round-robin my_package:MySchedule
python scripts/suite.py --verify results/suites/query-suite-v1/round-robin.json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scripts.cli import Machines, run
from scripts.evaluate_suite import evaluate_suite


@dataclass(frozen=True)
class Args(Machines):
    """Score policies in the cells of a query suite."""

    name: str = "query-suite-v2"
    """Name of the suite."""
    policies: tuple[str, ...] = ()
    """Schedules and policies: names, files of saved ones, "module:Class", and models of
    stable-baselines3 as "module:Class=file.zip", which are unpickled: load those that you trust."""
    verify: Path | None = None
    """Card of which a drawn cell is run again, to see whether its errors are right."""
    output: Path | None = None
    """Folder of the cards; results/suites/<name> if not given."""
    json: bool = False
    """Print the cards, or the verification, as JSON, for a program, in place of tables."""


def main(args: Args) -> None:
    """Score policies, or verify a card."""
    folder = args.output or Path("results/suites") / args.name
    evaluate_suite(args.name, args.policies, args.verify, folder, args, args.json)


if __name__ == "__main__":
    run(main, Args, __doc__)
