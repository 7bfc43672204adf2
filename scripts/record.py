"""Record traffic with SUMO into the library, so that environments only replay it.

python scripts/record.py --seeds 0:64
python scripts/record.py --corridor short-highway --seeds 0:16
python scripts/record.py --env dptse_env:dptse/PrivateHighway-v0 --keywords '{"incident": "none"}'
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dptse_env.config import parse_seeds
from dptse_env.traffic import RecordLibrary, mean_dwell
from scripts.cli import make_corridor, parse_keywords, run


@dataclass(frozen=True)
class Args:
    """Record traffic."""

    corridor: str | None = None
    """Corridor: the name of a shipped one, or a JSON object of fields that replace those of the
    environment's corridor; the environment's own if not given."""
    env: str = "dptse_env:dptse/PaperHighway-v0"
    """Environment id."""
    keywords: str = "{}"
    """Keywords of the environment as JSON; those about the corridor, its demand and its incident
    matter."""
    seeds: str = "0:16"
    """Traffic seeds, first:stop."""
    random: bool = False
    """Draw demand level and incident anew for every seed instead of taking the corridor's own."""
    workers: int | None = None
    """Number of processes; all usable cores if not given."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""


def main(args: Args) -> None:
    """Record, and print what the library has."""
    keywords = parse_keywords(args.keywords)
    if args.random:
        keywords |= {"demand": "random", "incident": "random"}
    corridor, seeds = make_corridor(args.corridor, args.env, keywords), parse_seeds(args.seeds)
    library = RecordLibrary(args.records)
    library.ensure(corridor, seeds, workers=args.workers, progress=True)
    dwell = mean_dwell((library.get(corridor, seed) for seed in seeds), corridor.n_mainline)
    print(f"{corridor.name}: {len(seeds)} record(s) in {library.path}")
    print(f"mean dwell on a mainline segment (T_avg): {dwell:.2f} s")


if __name__ == "__main__":
    run(main, Args, __doc__)
