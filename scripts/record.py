"""Record traffic with SUMO, so that environments only replay it.

dptse record --env dptse_env:dptse/ShortHighway-v0 --seeds 0:4
"""

from __future__ import annotations

import json
from dataclasses import dataclass

from dptse_env.config import parse_seeds
from dptse_env.traffic import average_dwell
from scripts.cli import Environment, Recording


@dataclass(frozen=True)
class Args(Recording, Environment):
    """Record traffic."""

    seeds: str = "0:16"
    """Traffic seeds, first:stop."""
    json: bool = False
    """Print JSON, for a program, in place of text."""


def main(args: Args) -> None:
    """Record, and print the number of records and their mean dwell."""
    corridor, seeds = args.corridor(), parse_seeds(args.seeds)
    library = args.library(corridor, seeds)
    dwell = average_dwell(corridor, (library.get(corridor, seed) for seed in seeds))
    if args.json:
        folder = library.record_path(corridor, seeds[0]).parent
        found = {"corridor": corridor.name, "seeds": seeds, "folder": str(folder), "dwell": dwell}
        print(json.dumps(found, indent=2))
        return
    print(f"{corridor.name}: {len(seeds)} record(s) in {library.path}")
    print(f"mean dwell on a mainline segment (T_avg): {dwell:.2f} s")
