"""Record traffic with SUMO into the library, so that environments only replay it.

python scripts/record.py --seeds 0:64
python scripts/record.py --corridor short-highway --seeds 0:16
python scripts/record.py --env dptse_env:dptse/PrivateHighway-v0 --keywords '{"incident": "none"}'
"""

from __future__ import annotations

import json
from dataclasses import dataclass

from dptse_env.config import parse_seeds
from dptse_env.traffic import average_dwell
from scripts.cli import Recording, Road, make_corridor, run


@dataclass(frozen=True)
class Args(Road, Recording):
    """Record traffic."""

    seeds: str = "0:16"
    """Traffic seeds, first:stop."""
    random: bool = False
    """Draw demand level and incident anew for every seed instead of taking the corridor's own."""
    json: bool = False
    """Print the result as JSON, for a program, in place of a table."""


def main(args: Args) -> None:
    """Record, and print the number of records and their mean dwell."""
    keywords = args.given_keywords()
    if args.random:
        keywords |= {"demand": "random", "incident": "random"}
    corridor, seeds = make_corridor(args.env, keywords), parse_seeds(args.seeds)
    library = args.library(corridor, seeds)
    dwell = average_dwell(corridor, (library.get(corridor, seed) for seed in seeds))
    if args.json:
        folder = library.record_path(corridor, seeds[0]).parent
        found = {"corridor": corridor.name, "seeds": seeds, "folder": str(folder), "dwell": dwell}
        print(json.dumps(found, indent=2))
        return
    print(f"{corridor.name}: {len(seeds)} record(s) in {library.path}")
    print(f"mean dwell on a mainline segment (T_avg): {dwell:.2f} s")


if __name__ == "__main__":
    run(main, Args, __doc__)
