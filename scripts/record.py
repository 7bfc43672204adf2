"""Record traffic with SUMO into the library, so that environments only replay it.

Example: python scripts/record.py --corridor paper-highway --seeds 0:64
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dptse_env.config import parse_seeds
from dptse_env.traffic import CORRIDORS, RecordLibrary, mean_dwell, randomised
from scripts.cli import run


@dataclass(frozen=True)
class Args:
    """What to record, and where to."""

    corridor: str = "paper-highway"
    """Name of the corridor: paper-highway or short-highway."""
    seeds: str = "0:16"
    """Traffic seeds, first:stop."""
    random: bool = False
    """Draw demand level and incident anew for every seed instead of taking the corridor's own."""
    workers: int | None = None
    """Number of processes; all usable cores if not given."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""


def main(args: Args) -> None:
    """Record, then say what is there."""
    if args.corridor not in CORRIDORS:
        raise ValueError(f"corridor must be one of {sorted(CORRIDORS)}, got {args.corridor!r}")
    corridor = CORRIDORS[args.corridor]
    if args.random:
        corridor = randomised(corridor)
    seeds = parse_seeds(args.seeds)
    library = RecordLibrary(args.records)
    library.ensure(corridor, seeds, workers=args.workers, progress=True)
    dwell = mean_dwell((library.get(corridor, seed) for seed in seeds), corridor.n_mainline)
    print(f"{corridor.name}: {len(seeds)} record(s) in {library.path}")
    print(f"mean dwell on a mainline segment (T_avg): {dwell:.2f} s")


if __name__ == "__main__":
    run(main, Args, __doc__)
