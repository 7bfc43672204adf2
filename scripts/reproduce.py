"""Reproduce the paper's five results on held-out traffic, and judge its claims.

python scripts/reproduce.py            # some 8,000 episodes
python scripts/reproduce.py --quick    # minutes

Interrupted, the same command goes on where it stopped.
"""

from __future__ import annotations

import os

# Read when numpy loads, here and in the workers: one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass
from pathlib import Path

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.experiments.provenance import provenance, take_folder
from agents.experiments.runner import make_env, missing, run_all
from agents.studies.paper.plan import ESTIMATORS, Cell, Design, quick
from agents.studies.paper.report import draw, write_report
from agents.studies.paper.results import Measured
from agents.studies.paper.timing import StepTime, time_all
from dptse_env.config import parse_seeds
from dptse_env.traffic import RecordLibrary
from dptse_env.validation import integer
from scripts.cli import command, resumable, run

FULL, QUICK = Path("results/paper"), Path("results/paper-quick")


@dataclass(frozen=True)
class Args:
    """Reproduce the paper's results."""

    quick: bool = False
    """Fewer traffic seeds and fewer points of each sweep."""
    seeds: str = "2000:2020"
    """Held-out traffic seeds, first:stop, within 2000:3000."""
    estimators: tuple[str, ...] = ESTIMATORS
    """Estimators of the paper; random walk and open loop are always run."""
    cv_segments: tuple[int, ...] = Design.cv_segments
    """Numbers of CV segments of result 1."""
    epsilons: tuple[float, ...] = Design.epsilons
    """Values of epsilon of result 3; 1 is added."""
    deltas: tuple[float, ...] = Design.deltas
    """Values of delta of result 4; 0.05 is added."""
    picture_segments: int = Design.picture_segments
    """CV segments of result 2."""
    privacy_segments: int = Design.privacy_segments
    """CV segments of results 3 to 5."""
    env: str = Design.env
    """Environment id."""
    workers: int = os.cpu_count() or 1
    """Processes that record missing traffic and run episodes."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""
    output: Path | None = None
    """Folder for figures, tables and report; results/paper or results/paper-quick if not given."""


def design_of(args: Args) -> Design:
    """Return what the arguments ask to run."""
    design = Design(
        seeds=parse_seeds(args.seeds),
        cv_segments=args.cv_segments,
        epsilons=args.epsilons,
        deltas=args.deltas,
        picture_segments=args.picture_segments,
        privacy_segments=args.privacy_segments,
        estimators=args.estimators,
        env=args.env,
    )
    return quick(design) if args.quick else design


def main(args: Args) -> None:
    """Run what is missing, then draw, judge and report."""
    design = design_of(args)
    integer("workers", args.workers, 1)
    output = args.output or (QUICK if args.quick else FULL)
    records = None if args.records is None else str(args.records)
    # This makes every environment: bad input shows before anything is run.
    origin = take_folder(output, provenance(design))
    episodes = Ledger(output / "episodes.csv", Cell, EpisodeScore)
    times = Ledger(output / "run_time.csv", Cell, StepTime)
    with resumable():
        record(design, args)
        run_all(missing(design, episodes, records), episodes, args.workers)
        time_all(design, times, records)
    episodes.sort()
    measured = Measured(design, episodes.rows, times.rows)
    draw(output, measured, records)
    write_report(output / "REPORT.md", measured, origin, command("reproduce", args))
    print(f"report, figures and scores are in {output}/")


def record(design: Design, args: Args) -> None:
    """Record the traffic that is missing."""
    env = make_env(design.env, design.cells()[0], design.seeds, None)
    corridor = env.unwrapped.config.corridor  # type: ignore[attr-defined]
    RecordLibrary(args.records).ensure(corridor, design.seeds, args.workers, progress=True)


if __name__ == "__main__":
    run(main, Args, __doc__)
