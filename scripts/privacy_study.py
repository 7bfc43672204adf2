"""Price a guarantee of privacy on held-out traffic, and say what noise as printed gives.

python scripts/privacy_study.py            # some 2,000 episodes
python scripts/privacy_study.py --quick    # minutes

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
from agents.studies.privacy.account import account_of, trip_lengths
from agents.studies.privacy.plan import Cell, Design, quick
from agents.studies.privacy.report import draw, write_report
from agents.studies.privacy.results import Measured
from dptse_env.config import EnvConfig, parse_seeds
from dptse_env.traffic import RecordLibrary
from dptse_env.validation import integer
from scripts.cli import command, resumable, run

FULL, QUICK = Path("results/privacy"), Path("results/privacy-quick")


@dataclass(frozen=True)
class Args:
    """Price a guarantee of privacy."""

    quick: bool = False
    """Three traffic seeds and fewer points of each curve."""
    seeds: str = "2000:2020"
    """Held-out traffic seeds, first:stop, within 2000:3000."""
    estimators: tuple[str, ...] = Design.estimators
    """Estimators; the open loop is always run."""
    epsilons: tuple[float, ...] = Design.epsilons
    """Values of epsilon asked for; the base value is added."""
    caps: tuple[int, ...] = Design.caps
    """Caps of the unit trip; the base value is added."""
    bandwidths: tuple[int, ...] = Design.bandwidths
    """Segments queried a second; the base value is added."""
    epsilon: float = Design.epsilon
    """Base value of epsilon, at which boundary modes and bandwidths are compared."""
    delta: float = Design.delta
    """The delta of every configuration."""
    cap: int = Design.cap
    """Base value of the cap."""
    bandwidth: int = Design.bandwidth
    """Base value of the bandwidth."""
    schedule: str = Design.schedule
    """Query schedule of every episode."""
    env: str = Design.env
    """Environment id."""
    workers: int = os.cpu_count() or 1
    """Processes that record missing traffic and run episodes."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""
    output: Path | None = None
    """Folder for everything; results/privacy or results/privacy-quick if not given."""


def design_of(args: Args) -> Design:
    """Return what the arguments ask to run."""
    design = Design(
        seeds=parse_seeds(args.seeds),
        estimators=args.estimators,
        epsilons=args.epsilons,
        caps=args.caps,
        bandwidths=args.bandwidths,
        epsilon=args.epsilon,
        delta=args.delta,
        cap=args.cap,
        bandwidth=args.bandwidth,
        schedule=args.schedule,
        env=args.env,
    )
    return quick(design) if args.quick else design


def main(args: Args) -> None:
    """Run what is missing, then draw and report."""
    design = design_of(args)
    integer("workers", args.workers, 1)
    output = args.output or (QUICK if args.quick else FULL)
    records = None if args.records is None else str(args.records)
    # This makes every environment: bad input shows before anything is run.
    origin = take_folder(output, provenance(design))
    config = make_env(design.env, design.cells()[0], design.seeds, None).unwrapped.config  # type: ignore[attr-defined]
    episodes = Ledger(output / "episodes.csv", Cell, EpisodeScore)
    with resumable():
        RecordLibrary(args.records).ensure(
            config.corridor, design.seeds, args.workers, progress=True
        )
        run_all(missing(design, episodes, records), episodes, args.workers)
    episodes.sort()
    measured = measure(design, episodes, config, records)
    draw(output, measured)
    write_report(output / "REPORT.md", measured, origin, command("privacy_study", args))
    print(f"report, figures and scores are in {output}/")


def measure(
    design: Design, episodes: Ledger[Cell, EpisodeScore], config: EnvConfig, records: str | None
) -> Measured:
    """Put scores together with what the noise behind them is worth."""
    trips = trip_lengths(config.corridor, design.seeds, records)
    horizon = config.horizon_steps
    meetings = (min(design.cap, horizon), int(trips.max()), horizon)
    accounts = {
        protection: [
            account_of(design.env, cell, design.seeds, meetings)
            for cell in design.along_epsilon(design.estimators[0], protection)
        ]
        for protection in (*design.guaranteed, *design.printed)
    }
    return Measured(design, episodes.rows, accounts, trips, horizon)


if __name__ == "__main__":
    run(main, Args, __doc__)
