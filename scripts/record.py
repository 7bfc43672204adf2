"""Record traffic with SUMO, so that environments only replay it.

dptse record --env dptse_env:dptse/ShortHighway-v0 --test-seeds 2000:2004
"""

from __future__ import annotations

from dataclasses import dataclass

from agents.seeds import KINDS, require_seeds
from dptse_env.config import parse_seeds
from dptse_env.traffic import average_dwell
from scripts.cli import Command, Environment, Recording, TestSeeds, TrainSeeds, ValidationSeeds

OPTIONS = ("train_seeds", "validation_seeds", "test_seeds")
"""Options with the seeds of each of `KINDS`."""


@dataclass(frozen=True, kw_only=True)
class Args(TestSeeds, ValidationSeeds, TrainSeeds, Environment, Recording, Command):
    """Record traffic."""

    def seeds(self) -> list[int]:
        """Return the traffic seeds that are given.

        Raises:
            ValueError: There are none, or one is of another kind of traffic.
        """
        found: list[int] = []
        for name, allowed in zip(OPTIONS, KINDS.values(), strict=True):
            text = getattr(self, name)
            if text is not None:
                seeds = parse_seeds(text, name)
                require_seeds(name, seeds, allowed)
                found += seeds
        if not found:
            raise ValueError("seeds must be given: --train-seeds, --validation-seeds, --test-seeds")
        return found


def main(args: Args) -> None:
    """Record, and print the number of records and their mean dwell."""
    corridor, seeds = args.corridor(), args.seeds()
    library = args.library(corridor, seeds)
    dwell = average_dwell(corridor, (library.get(corridor, seed) for seed in seeds))
    folder = library.record_path(corridor, seeds[0]).parent
    args.answer(
        {"corridor": corridor.name, "seeds": seeds, "folder": str(folder), "dwell": dwell},
        f"{corridor.name}: {len(seeds)} record(s) in {library.path}",
        f"mean dwell on a mainline segment (T_avg): {dwell:.2f} s",
    )
